//! Training of the particle model on a GPU beside training on the CPU: the kernels run in the emulator.

use std::{collections::BTreeMap, sync::Arc};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    LossKind, NoiseConfig, OptimizerKind, TrainConfig, UnrollStage, cuda,
    cuda_tests::{named, relative_error},
    gradients::GradientTask,
    knots::ONE_SET,
    loss_weights::{CommonSums, LossScale},
    optimizer::Correction,
    schedule::Batches,
    state::{RunState, by_name, in_order},
    steps::Learner,
    window::{Sampler, Window},
};
use crate::model::DeviceKind;
use eddy_cuda::{
    device::Device,
    frame::Place,
    particle::{self, Training, TrainingConstants},
    training::InTraining as _,
};
use eddy_cuda_emulator::Emulator;
use eddy_dataset::{Stream, Trajectory};
use eddy_frames::{Domain, Material, Stamp, State};
use eddy_inference::{
    checkpoint::{
        Architecture, Checkpoint, Core, Description, Form, Weights, initial_weights,
        tensors_of_knots,
    },
    engine::{Ballistic, Surrogate},
};

/// Distance between particles at rest (domain lengths).
const SPACING: f32 = 0.03;
/// Of the weights at first. With this seed a unit of minGRU's encoder is at the bend of its ReLU in the third step.
const SEED: u64 = 11;

/// Streams of two blocks, a few particles each, of different materials and numbers: they fall, turn and spread a little, some
/// into a wall.
pub(super) fn streams() -> Vec<Trajectory> {
    streams_of([[4, 3], [3, 4]])
}

/// As [`streams`], with so many particles along the sides of each stream's blocks.
fn streams_of(sizes: [[usize; 2]; 2]) -> Vec<Trajectory> {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let kinds = [[Material::Jelly, Material::Liquid], [Material::Snow, Material::Rope]];
    let stream = |id: usize| {
        let mut places = Vec::new();
        let mut material = Vec::new();
        for block in 0..2 {
            let corner = [0.1 + 0.5 * block as f32, 0.06 + 0.3 * id as f32];
            let side = sizes[id][block];
            for number in 0..side * side {
                let along = [number % side, number / side].map(|step| step as f32 * SPACING);
                places.push([corner[0] + along[0], corner[1] + along[1]]);
                material.push(kinds[id][block]);
            }
        }
        let mut jitter = |size: f32| [(); 2].map(|()| size * random.random_range(-1.0f32..1.0));
        let states = (0..9)
            .map(|t| {
                let moved = |[x, y]: [f32; 2], [dx, dy]: [f32; 2]| {
                    let time = t as f32;
                    [x + 0.004 * time + dx, (y - 0.003 * time + 0.1 * time * dx + dy).max(0.01)]
                };
                let position = places.iter().map(|&place| moved(place, jitter(0.002))).collect();
                let velocity = places.iter().map(|_| jitter(0.5)).collect();
                State { position, velocity }
            })
            .collect();
        Trajectory::from(Stream {
            id: id as u64,
            source: "memory".into(),
            dt: 0.016,
            domain: Domain::UNIT,
            material,
            first_sequence: 0,
            first_stamp: Stamp::default(),
            stiffness: Some([1e3, 1e5][id]),
            tools: None,
            states,
        })
    };
    [0, 1].map(stream).to_vec()
}

/// A small network, with everything that a training may ask for switched on.
pub(super) fn config(core: Core) -> TrainConfig {
    let mut config = TrainConfig::defaults(Architecture::Particle);
    config.core = core;
    config.network.encoder = 10;
    config.network.hidden = 9;
    config.network.layers = 2;
    config.network.cell_width = 0.1;
    config.network.channels = vec![6, 7, 5];
    config.windows.batch = 3;
    config.windows.warm_up = 3;
    config.windows.noise = NoiseConfig { position: 0.002, velocity: 0.1, share: 0.5 };
    config.unroll = vec![UnrollStage { share: 1.0, frames: 3 }];
    config.optimizer.kind = OptimizerKind::Adam;
    config.optimizer.clip = 0.05;
    config.optimizer.epsilon = 1e-4;
    config.optimizer.average = 0.9;
    config
}

pub(super) fn description(config: &TrainConfig) -> Description {
    let mut description =
        Description::untrained(Architecture::Particle, config.core, config.sizes(0));
    description.grid = config.grid(SPACING);
    description.frame = config.network.frame;
    description.form = config.network.form;
    description.normalize_gates = config.network.normalize_gates;
    description.stiffness = config.network.stiffness;
    description.stiffness_knots = config.network.stiffness_knots.clone();
    description.gravity = config.gravity;
    description.warm_up = config.windows.warm_up as u32;
    description
}

/// Initial weights, all moved a little: a decoder of zeros would leave the other layers without gradients.
fn weights(description: &Description, seed: u64) -> BTreeMap<String, Weights> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut tensors = initial_weights(description, 5);
    for values in tensors.values_mut().map(|weights| &mut weights.values) {
        values.iter_mut().for_each(|value| *value += random.random_range(-0.1..0.1));
    }
    tensors
}

/// The same weights but for their last bits.
fn nearly(weights: &BTreeMap<String, Weights>, seed: u64) -> BTreeMap<String, Weights> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut tensors = weights.clone();
    for values in tensors.values_mut().map(|weights| &mut weights.values) {
        values.iter_mut().for_each(|value| *value *= 1.0 + random.random_range(-2e-7f32..2e-7));
    }
    tensors
}

/// A training in the emulator.
fn training(config: &TrainConfig, description: &Description, streams: &[Trajectory]) -> Training {
    let constants = TrainingConstants::of(description).unwrap();
    training_on(Emulator::new(&constants).unwrap(), config, description, streams)
}

fn training_on(
    device: Emulator,
    config: &TrainConfig,
    description: &Description,
    streams: &[Trajectory],
) -> Training {
    let device: Arc<dyn Device> = Arc::new(device);
    let store = cuda::particle_store(&*device, streams, SPACING).unwrap();
    let settings = cuda::settings(config, config.unroll[0].frames, device.rank().count);
    let training = Training::new(device, Arc::new(store), description, &settings).unwrap();
    training.set_weights(&weights(description, SEED)).unwrap();
    training
}

/// Trivial errors over some windows, where the loss needs them.
fn scale<'a>(
    config: &'a TrainConfig,
    description: &'a Description,
    sampler: &Sampler,
    state: &mut RunState,
) -> LossScale<'a> {
    let mut scale = LossScale {
        loss: &config.loss,
        noise: &config.windows.noise,
        normalization: &description.normalization,
        ballistic: Ballistic::new(description),
        common: Vec::new(),
    };
    if config.loss.kind == LossKind::Relative {
        let mut sums = CommonSums::new(config.unroll[0].frames, config.network.stiffness);
        for window in sampler.draw(20, &mut state.order).unwrap() {
            sums.add(&window, &scale.ballistic);
        }
        scale.common = sums.best();
    }
    scale
}

/// Steps on the CPU and in the emulator, each from the same weights on the same windows. Where a unit is so close to the bend of
/// its ReLU that the last bits of the weights decide on its gradient, the gradients may differ by what these bits change.
fn compare(config: &TrainConfig, streams: &[Trajectory]) {
    compare_network(config, description(config), streams);
}

/// The same of a network that the settings do not describe.
fn compare_network(config: &TrainConfig, description: Description, streams: &[Trajectory]) {
    let unroll = config.unroll[0].frames;
    let sampler = Sampler::new(streams, &config.windows, unroll).unwrap();
    let mut state = RunState::new(config, &description, None);
    state.unroll = unroll;
    let scale = scale(config, &description, &sampler, &mut state);
    let task =
        GradientTask { config, description: &description, scale: &scale, device: DeviceKind::Flex };
    let mut training = training(config, &description, streams);

    for step in 0..3 {
        let draws = sampler.choose_many(config.windows.batch, &mut state.order);
        let windows: Vec<Window> = draws.iter().map(|&draw| sampler.cut(draw).unwrap()).collect();
        let before = training.weights().unwrap();
        let near = in_order(&description, &nearly(&before, step)).into();
        let near = task.compute(&near, &windows, &mut state.dropout).gradients;
        state.weights = in_order(&description, &before).into();
        let slope = task.compute(&state.weights, &windows, &mut state.dropout);

        let correction = Correction::new(state.optimizer.steps + 1, 1e-2, &config.optimizer);
        let own = cuda::weights(&scale, &sampler, &draws, unroll).unwrap();
        let batch = cuda::batch(&draws, &correction, ONE_SET, None, Some(own));
        training.start(&[batch]).unwrap();
        let outcome = training.outcomes(1).unwrap()[0];

        let difference = f64::from(outcome.loss / slope.loss - 1.0).abs();
        assert!(difference < 2e-5, "step {step}: loss {} on the CPU, {}", slope.loss, outcome.loss);
        let gradients = training.gradients().unwrap();
        let near = named(&description, near);
        for (name, expected) in named(&description, slope.gradients) {
            let found = relative_error(&gradients[&name].values, &expected);
            let most = 2e-5 + 2.0 * relative_error(&near[&name], &expected);
            assert!(
                found < most,
                "step {step}: gradient by {name}: relative error {found:.1e}, at most {most:.1e}"
            );
        }

        // From the emulator's gradients: Muon enlarges small singular values, and their rounding, several hundred times.
        let most = if config.optimizer.kind == OptimizerKind::Muon { 1e-4 } else { 2e-5 };
        let gradients = in_order(&description, &gradients);
        let mut optimizer = state.optimizer.step(1e-2, &config.optimizer).measured();
        for (tensor, values) in Arc::make_mut(&mut state.weights).iter_mut().enumerate() {
            optimizer.change(tensor, values, &gradients[tensor]);
        }
        let norm = optimizer.gradient_norm();
        let difference = f64::from(outcome.gradient_norm) / norm - 1.0;
        assert!(difference.abs() < 2e-5, "norm of the gradient: {difference:.1e}");
        for (found, expected) in [
            (training.weights().unwrap(), by_name(&description, &state.weights)),
            (training.average().unwrap(), state.tensors(&description)),
        ] {
            for (name, expected) in expected {
                let found = relative_error(&found[&name].values, &expected.values);
                assert!(found < most, "step {step}: {name}: relative error {found:.1e}");
            }
        }
    }
}

#[test]
fn every_core_of_the_particle_model_takes_the_steps_of_the_cpu() {
    for core in Core::ALL {
        compare(&config(core), &streams());
    }
}

#[test]
fn other_forms_and_losses_of_the_particle_model_take_the_steps_of_the_cpu() {
    for core in [Core::MinGru, Core::MinLstm] {
        let mut config = config(core);
        config.network.form = Form::Log;
        config.network.normalize_gates = false;
        config.loss.kind = LossKind::Mse;
        config.loss.observed_weight = 0.0;
        config.windows.warm_up = 1;
        compare(&config, &streams());
    }
}

#[test]
fn a_network_conditioned_on_the_stiffness_of_each_stream_takes_the_steps_of_the_cpu() {
    let mut config = config(Core::MinGru);
    config.network.stiffness = true;
    compare(&config, &streams());
    // With inputs for materials that nobody knows yet.
    let material_inputs = 6;
    compare_network(&config, Description { material_inputs, ..description(&config) }, &streams());
}

#[test]
fn grids_of_two_and_four_levels_take_the_steps_of_the_cpu() {
    for channels in [vec![6, 7], vec![6, 7, 5, 9]] {
        let mut config = config(Core::MinGru);
        config.network.cell_width = 0.04;
        config.network.channels = channels;
        compare(&config, &streams());
    }
}

#[test]
fn muon_takes_the_steps_of_the_cpu() {
    for core in Core::ALL {
        let mut config = config(core);
        config.optimizer.kind = OptimizerKind::Muon;
        compare(&config, &streams());
    }
    let mut wide = config(Core::MinGru);
    wide.optimizer.kind = OptimizerKind::Muon;
    wide.network.channels = vec![36, 20, 24];
    compare(&wide, &streams_of([[9, 8], [8, 9]]));
}

/// More particles than a block adds up at a time, with different numbers of them in the two streams, and matrices that several blocks share.
#[test]
fn sums_over_many_particles_and_wide_layers_are_those_of_the_cpu() {
    let mut config = config(Core::MinGru);
    config.network.channels = vec![36, 20, 24];
    config.windows.batch = 2;
    compare(&config, &streams_of([[9, 8], [6, 9]]));
}

/// A batch so large that a share of the gradients by weights has several frames, in a window that is longer than its warm-up, of
/// streams with different numbers of particles; more columns of gates than a block has; a single frame.
#[test]
fn large_batches_wide_gates_and_a_single_frame_take_the_steps_of_the_cpu() {
    let mut large = config(Core::MinGru);
    large.network.encoder = 4;
    large.network.hidden = 5;
    large.network.layers = 1;
    large.network.channels = vec![3, 4];
    large.windows.batch = 64;
    compare(&large, &streams_of([[4, 3], [3, 5]]));

    let mut wide = config(Core::Gru);
    wide.network.hidden = 45;
    wide.network.layers = 1;
    wide.windows.batch = 2;
    wide.windows.warm_up = 1;
    wide.unroll = vec![UnrollStage { share: 1.0, frames: 1 }];
    compare(&wide, &streams());
}

#[test]
fn truncated_backpropagation_takes_the_steps_of_the_cpu() {
    for (core, warm_up, truncation) in
        [(Core::MinGru, 3, 2), (Core::Lstm, 3, 2), (Core::MinGru, 1, 1)]
    {
        let mut config = config(core);
        config.windows.warm_up = warm_up;
        config.unroll = vec![UnrollStage { share: 1.0, frames: 5 }];
        config.truncation = truncation;
        compare(&config, &streams());
    }
}

#[test]
fn two_devices_take_the_steps_of_one_with_both_parts_of_the_batch() {
    let mut config = config(Core::MinGru);
    config.windows.batch = 4;
    compare_devices(&config, 1e-5);
    config.optimizer.kind = OptimizerKind::Muon;
    // As in `compare`, from gradients that are added in another order; other ones would move the biases, 0 at first, elsewhere.
    compare_devices(&config, 5e-3);
}

/// Steps of one device and of two, whose losses and weights are at most so far apart (relative).
fn compare_devices(config: &TrainConfig, most: f64) {
    let (streams, description) = (streams(), description(config));
    let unroll = config.unroll[0].frames;
    let sampler = Sampler::new(&streams, &config.windows, unroll).unwrap();
    let mut state = RunState::new(config, &description, None);
    let scale = scale(config, &description, &sampler, &mut state);
    let draws: Vec<_> = (0..3).map(|_| sampler.choose_many(4, &mut state.order)).collect();
    let steps = |devices: usize, rank: usize| -> Vec<_> {
        let step = |(number, draws): (usize, &Vec<_>)| {
            let part = draws.len() / devices;
            let own = &draws[part * rank..part * (rank + 1)];
            let correction = Correction::new(number as u32 + 1, 1e-2, &config.optimizer);
            let weights = cuda::weights(&scale, &sampler, own, unroll).unwrap();
            cuda::batch(own, &correction, ONE_SET, None, Some(weights))
        };
        draws.iter().enumerate().map(step).collect()
    };
    let run = |mut training: Training, batches: Vec<_>| {
        training.start(&batches).unwrap();
        (training.outcomes(batches.len()).unwrap(), training.weights().unwrap())
    };
    let expected = run(training(config, &description, &streams), steps(1, 0));

    let devices = Emulator::group(&TrainingConstants::of(&description).unwrap(), 2).unwrap();
    let found = std::thread::scope(|scope| {
        let start = |(rank, device)| {
            let (description, streams) = (&description, &streams);
            let (run, batches) = (&run, steps(2, rank));
            scope.spawn(move || run(training_on(device, config, description, streams), batches))
        };
        let threads: Vec<_> = devices.into_iter().enumerate().map(start).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect::<Vec<_>>()
    });
    assert!(found[0] == found[1], "both have the same bits");
    for (found, expected) in found[0].0.iter().zip(&expected.0) {
        assert!(
            (f64::from(found.loss / expected.loss) - 1.0).abs() < most,
            "{found:?}, {expected:?}"
        );
    }
    for (name, expected) in &expected.1 {
        let apart = relative_error(&found[0].1[name].values, &expected.values);
        assert!(apart < most, "{name}: relative error {apart:.1e}");
    }
}

#[test]
fn a_run_of_the_particle_model_on_a_gpu_keeps_the_state_of_a_run_on_the_cpu() {
    let mut config = config(Core::MinGru);
    config.network.stiffness = true;
    keeps_the_state_of_a_run_on_the_cpu(&config);
}

#[test]
fn weights_for_several_stiffnesses_take_the_steps_of_the_cpu() {
    for (kind, knots) in [
        (OptimizerKind::Adam, vec![1e3, 3e4, 1e6]),
        (OptimizerKind::Muon, vec![1e2, 1e5]),
        // One is below all streams' stiffness, and left as it is.
        (OptimizerKind::Muon, vec![1.0, 1e3]),
    ] {
        let mut config = config(Core::MinGru);
        (config.optimizer.kind, config.network.stiffness) = (kind, true);
        config.network.stiffness_knots = knots;
        keeps_the_state_of_a_run_on_the_cpu(&config);
    }
}

/// Runs of both devices from the same seed: steps, a stop, and further steps from the state that was kept.
#[expect(clippy::too_many_lines, reason = "one story: steps, a stop, further steps")]
fn keeps_the_state_of_a_run_on_the_cpu(config: &TrainConfig) {
    let (streams, description) = (streams(), description(config));
    let unroll = config.unroll[0].frames;
    let run = |open: &dyn Fn() -> Learner| {
        let mut state = RunState::new(config, &description, None);
        let tensors = match description.stiffness_knots.len() {
            0 => weights(&description, 13),
            knots => {
                let of_knots = (0..knots as u64).map(|knot| weights(&description, 13 + knot));
                tensors_of_knots(&of_knots.collect::<Vec<_>>())
            }
        };
        state.weights = in_order(&description, &tensors).into();
        state.unroll = unroll;
        let mut sampler = Sampler::new(&streams, &config.windows, unroll).unwrap();
        if !config.network.stiffness_knots.is_empty() {
            sampler = sampler.by_stiffness();
        }
        let scale = scale(config, &description, &sampler, &mut state);
        let task = GradientTask {
            config,
            description: &description,
            scale: &scale,
            device: DeviceKind::Flex,
        };
        let mut losses = Vec::new();
        for rates in [vec![1e-3, 2e-3], vec![3e-3]] {
            let batches = Batches { first: 1, unroll, rates, left: 1 };
            let mut learner = open();
            learner.begin(&task, &state).unwrap();
            let steps = learner.steps(&task, &mut sampler, &batches, &mut state).unwrap();
            losses.extend(steps.into_iter().map(|step| (step.loss, step.windows)));
            learner.sync(&mut state).unwrap();
            let tensors = state.tensors(&description);
            let checkpoint = Checkpoint::new(description.clone(), tensors);
            let found = learner.surrogate(&checkpoint).unwrap();
            let expected = Surrogate::load(&checkpoint, None).unwrap();
            let first = streams[0].cut(0..1).unwrap().frame(0);
            let [found, expected] = [found, expected].map(|surrogate| {
                let stiffness = streams[0].stiffness;
                let mut hidden = surrogate.start_with_stiffness(&first, stiffness).unwrap();
                surrogate.stepper().step(&mut hidden, &first).velocity
            });
            for (found, expected) in found.as_flattened().iter().zip(expected.as_flattened()) {
                assert!((found - expected).abs() < 1e-4, "a model for validation");
            }
        }
        (state, losses)
    };
    let on_gpu = || {
        let program = cuda::program(&description).unwrap();
        let device: Arc<dyn Device> = Arc::new(Emulator::new(&*program).unwrap());
        let devices = [(device, Place::Device)];
        let learner = cuda::Learner::on(devices, &description, &streams).unwrap();
        Learner::Cuda(Box::new(learner))
    };
    let (expected, expected_losses) = run(&|| Learner::Burn);
    let run_on_cpu = &expected;
    let (found, found_losses) = run(&on_gpu);
    let (again, again_losses) = run(&on_gpu);

    assert_eq!(found_losses, again_losses, "the same bits each time");
    let tensors = |state: &RunState| by_name(&description, &state.weights);
    assert_eq!(tensors(&found), tensors(&again), "the same bits each time");
    for ((found, same), (expected, windows)) in found_losses.iter().zip(&expected_losses) {
        assert_eq!(same, windows, "the same windows are drawn");
        assert!((found / expected - 1.0).abs() < 2e-5, "loss {expected} on the CPU, {found}");
    }
    assert_eq!(found.optimizer.steps, expected.optimizer.steps);
    let moments = found.optimizer.moments.iter().zip(&expected.optimizer.moments);
    for (tensor, (found, expected)) in moments.enumerate() {
        if expected.first.is_empty() {
            // The weights of a stiffness that no batch was near.
            assert!(found.first.iter().chain(&found.second).all(|&number| number == 0.0));
            assert_eq!(found.average, run_on_cpu.weights[tensor], "still the first weights");
            continue;
        }
        assert!(relative_error(&found.first, &expected.first) < 1e-4, "first moments");
        assert!(relative_error(&found.second, &expected.second) < 1e-4, "second moments");
        assert!(relative_error(&found.average, &expected.average) < 1e-4, "averages");
    }
    let found = tensors(&found);
    for (name, expected) in tensors(&expected) {
        assert!(relative_error(&found[&name].values, &expected.values) < 5e-5, "{name}");
    }
}

#[test]
fn what_a_gpu_cannot_do_for_the_particle_model_is_refused() {
    let mut config = config(Core::MinGru);
    assert!(config.runs_on_gpus());
    config.network.dropout = 0.2;
    assert!(!config.runs_on_gpus());
    let description = description(&config);
    let settings = cuda::settings(&config, 2, 1);
    let stages = [settings];
    let refused = particle::footprint::bytes(&description, &stages, &[(100, 10)]).unwrap_err();
    assert!(refused.to_string().contains("network.dropout = 0.2"), "{refused}");
}

#[test]
fn layers_too_wide_for_muon_are_refused() {
    let mut config = config(Core::MinGru);
    config.optimizer.kind = OptimizerKind::Muon;
    config.network.channels = vec![6, 124, 7];
    let description = description(&config);
    let stages = [cuda::settings(&config, 2, 1)];
    let refused = particle::footprint::bytes(&description, &stages, &[(100, 10)]).unwrap_err();
    let expected = "optimizer.kind = muon for 1116 x 124 weights";
    assert!(refused.to_string().contains(expected), "{refused}");
}
