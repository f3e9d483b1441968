//! Training on a GPU beside training on the CPU: the kernels run in the emulator.

use std::{collections::BTreeMap, sync::Arc};

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    LossKind, NoiseConfig, OptimizerKind, TrainConfig, UnrollStage, cuda,
    gradients::GradientTask,
    knots::ONE_SET,
    loss_weights::{LossScale, TrivialSums},
    schedule::Batches,
    state::{RunState, by_name, in_order},
    steps::Learner,
    window::{Sampler, Window},
};
use crate::model::{DeviceKind, described::Model, network::Network};
use eddy_cuda::{
    device::Device,
    frame::{self, Place, Training},
    kernels::Constants,
    training::InTraining as _,
};
use eddy_cuda_emulator::Emulator;
use eddy_dataset::{Stream, Trajectory};
use eddy_frames::{Domain, Material, Stamp, State};
use eddy_inference::{
    checkpoint::{
        Activation, Architecture, Checkpoint, Core, Description, FeatureScaling, Form, FrameOutput,
        MaterialInput, Pooling, WeightFormat, Weights, plan::Plan,
    },
    engine::{Ballistic, Surrogate},
};

pub(super) const PARTICLES: usize = 21;

/// Two streams of particles that move at random.
pub(super) fn streams() -> Vec<Trajectory> {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut pairs = |low: f32, high: f32| -> Vec<[f32; 2]> {
        (0..PARTICLES).map(|_| [(); 2].map(|()| random.random_range(low..high))).collect()
    };
    let mut stream = |id: u64| {
        let states = (0..9)
            .map(|_| State { position: pairs(0.1, 0.9), velocity: pairs(-1.0, 1.0) })
            .collect();
        let material = (0..PARTICLES).map(|p| Material::ALL[(p * 7 + id as usize) % 4]).collect();
        Trajectory::from(Stream {
            id,
            source: "memory".into(),
            dt: 0.016,
            domain: Domain::UNIT,
            material,
            first_sequence: 0,
            first_stamp: Stamp::default(),
            stiffness: None,
            tools: None,
            states,
        })
    };
    vec![stream(0), stream(1)]
}

/// A small network, with everything that a training may ask for switched on.
pub(super) fn config(core: Core) -> TrainConfig {
    let mut config = TrainConfig::paper();
    config.network.frame.material = MaterialInput::OneHot;
    config.windows.mirror = true;
    config.core = core;
    config.network.encoder = 13;
    config.network.hidden = 10;
    config.network.dropout = 0.2;
    config.windows.batch = 3;
    config.windows.warm_up = 3;
    config.windows.noise = NoiseConfig { position: 0.01, velocity: 0.1, share: 0.5 };
    config.unroll = vec![UnrollStage { share: 1.0, frames: 3 }];
    config.loss.observed_weight = 0.5;
    config.loss.density_weight = 0.3;
    config.loss.density_grid = 9;
    config.optimizer.clip = 0.05;
    config.optimizer.epsilon = 1e-4;
    config.optimizer.average = 0.9;
    config
}

pub(super) fn description(config: &TrainConfig) -> Description {
    let mut description =
        Description::untrained(Architecture::Frame, config.core, config.sizes(PARTICLES));
    description.frame = config.network.frame;
    description.form = config.network.form;
    description.normalize_gates = config.network.normalize_gates;
    description.gravity = config.gravity;
    description.warm_up = config.windows.warm_up as u32;
    description
}

/// Weights of which none is zero: a decoder of zeros would leave the other layers without gradients.
fn random_weights(description: &Description) -> BTreeMap<String, Weights> {
    let mut random = ChaCha8Rng::seed_from_u64(11);
    let mut tensors = eddy_inference::checkpoint::initial_weights(description, 5);
    for values in tensors.values_mut().map(|weights| &mut weights.values) {
        values.iter_mut().for_each(|value| *value = random.random_range(-0.4..0.4));
    }
    tensors
}

/// Tensors in the order of the optimizer, by name.
pub(super) fn named(
    description: &Description,
    tensors: Vec<Vec<f32>>,
) -> BTreeMap<String, Vec<f32>> {
    let named = Plan::new(description).by_name(&tensors).into_iter();
    named.map(|(name, weights)| (name, weights.values)).collect()
}

/// The difference of two lists, relative to the second.
pub(super) fn relative_error(found: &[f32], expected: &[f32]) -> f64 {
    assert_eq!(found.len(), expected.len());
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
    let difference = norm(&mut found.iter().zip(expected).map(|(a, b)| f64::from(a - b)));
    difference / norm(&mut expected.iter().map(|&b| f64::from(b))).max(1e-12)
}

/// Steps on the CPU and in the emulator, from the same weights on the same windows.
#[expect(clippy::too_many_lines, reason = "one step, compared quantity by quantity")]
fn compare(config: &TrainConfig, scaling: FeatureScaling) {
    let streams = streams();
    let mut description = description(config);
    description.frame.scaling = scaling;
    let unroll = config.unroll[0].frames;
    let sampler = Sampler::new(&streams, &config.windows, unroll).unwrap();
    let mut scale = LossScale {
        loss: &config.loss,
        noise: &config.windows.noise,
        normalization: &description.normalization.clone(),
        ballistic: Ballistic::new(&description),
        common: Vec::new(),
    };
    let weights = random_weights(&description);
    let checkpoint = Checkpoint::new(description.clone(), weights.clone());
    let mut state = RunState::new(config, &checkpoint.description, None);
    state.weights = in_order(&description, &weights).into();
    state.unroll = unroll;
    if config.loss.kind == LossKind::Relative {
        let mut sums = TrivialSums::new(unroll);
        for window in sampler.draw(20, &mut state.order).unwrap() {
            sums.add(&window, &scale.ballistic);
        }
        scale.common = sums.best();
    }

    let device: Arc<dyn Device> =
        Arc::new(Emulator::new(&Constants::of(&description).unwrap()).unwrap());
    let store = Arc::new(cuda::store(&*device, &streams, Place::Device).unwrap());
    let settings = cuda::settings(config, unroll, 1);
    let mut training = Training::new(device, store, &description, &settings).unwrap();
    training.set_weights(&weights).unwrap();
    if let Some(weights) = cuda::common_weights(&scale, unroll, PARTICLES) {
        training.set_error_weights(weights).unwrap();
    }

    for step in 0..3 {
        let draws = sampler.choose_many(config.windows.batch, &mut state.order);
        let windows: Vec<Window> = draws.iter().map(|&draw| sampler.cut(draw).unwrap()).collect();
        let task = GradientTask {
            config,
            description: &description,
            scale: &scale,
            device: DeviceKind::Flex,
        };
        let masks = state.dropout.fork();
        let device = task.device.device().autodiff();
        let network = Network::new(&Model::new(&description), &state.weights, &device);
        let slope = task.group(&network, &windows, &mut masks.clone());

        let correction =
            super::optimizer::Correction::new(state.optimizer.steps + 1, 1e-2, &config.optimizer);
        let own = (config.loss.kind == LossKind::Relative)
            .then(|| cuda::weights(&scale, &sampler, &draws, unroll).unwrap());
        let batch = cuda::batch(&draws, &correction, ONE_SET, masks.random(), own);
        training.start(&[batch]).unwrap();
        let outcome = training.outcomes(1).unwrap()[0];

        let difference = f64::from(outcome.loss / slope.loss - 1.0).abs();
        assert!(difference < 2e-5, "step {step}: loss {} on the CPU, {}", slope.loss, outcome.loss);
        let gradients = training.gradients().unwrap();
        for (name, expected) in named(&description, slope.gradients.clone()) {
            let found = relative_error(&gradients[&name].values, &expected);
            assert!(found < 5e-5, "step {step}: gradient by {name}: relative error {found:.1e}");
        }

        let mut optimizer = state.optimizer.step(1e-2, &config.optimizer).measured();
        for (tensor, values) in Arc::make_mut(&mut state.weights).iter_mut().enumerate() {
            optimizer.change(tensor, values, &slope.gradients[tensor]);
        }
        let norm = optimizer.gradient_norm();
        assert!(
            (f64::from(outcome.gradient_norm) / norm - 1.0).abs() < 1e-4,
            "norm of the gradient"
        );
        for (found, expected) in [
            (training.weights().unwrap(), by_name(&description, &state.weights)),
            (training.average().unwrap(), state.tensors(&description)),
        ] {
            for (name, expected) in expected {
                let found = relative_error(&found[&name].values, &expected.values);
                assert!(found < 5e-5, "step {step}: {name}: relative error {found:.1e}");
            }
        }
    }
}

#[test]
fn every_core_takes_the_steps_of_the_cpu() {
    for core in Core::ALL {
        compare(&config(core), FeatureScaling::MinMax);
    }
}

#[test]
fn the_log_form_and_gates_that_are_not_normalised_take_the_steps_of_the_cpu() {
    for core in [Core::MinGru, Core::MinLstm] {
        let mut config = config(core);
        config.network.form = Form::Log;
        config.network.normalize_gates = false;
        compare(&config, FeatureScaling::ZScore);
    }
}

#[test]
fn every_activation_takes_the_steps_of_the_cpu() {
    for activation in Activation::ALL {
        let mut config = config(Core::Mlp);
        config.network.frame.activation = activation;
        config.network.frame.material = MaterialInput::Scalar;
        compare(&config, FeatureScaling::MinMax);
    }
}

#[test]
fn every_pooling_takes_the_steps_of_the_cpu() {
    for (pooling, core) in
        [(Pooling::Max, Core::MinGru), (Pooling::MeanMax, Core::Gru), (Pooling::MeanMax, Core::Mlp)]
    {
        let mut config = config(core);
        config.network.frame.pooling = pooling;
        compare(&config, FeatureScaling::MinMax);
    }
}

#[test]
fn every_output_takes_the_steps_of_the_cpu() {
    for output in [FrameOutput::Residual, FrameOutput::Position] {
        let mut config = config(Core::MinGru);
        config.network.frame.output = output;
        // Some particles hit a wall, where a ballistic step has no gradient.
        config.gravity = [0.0, -200.0];
        compare(&config, FeatureScaling::MinMax);
    }
}

#[test]
fn a_relative_loss_takes_the_steps_of_the_cpu() {
    let mut config = config(Core::MinGru);
    config.loss.kind = LossKind::Relative;
    config.loss.common_share = 0.5;
    compare(&config, FeatureScaling::MinMax);
}

#[test]
fn the_default_training_takes_the_steps_of_the_cpu() {
    let mut config = TrainConfig::defaults(Architecture::Frame);
    config.network.encoder = 260; // more than a block of the encoder has
    config.network.hidden = 12;
    config.windows.batch = 2;
    config.optimizer.epsilon = 1e-4;
    compare(&config, FeatureScaling::MinMax);
}

/// The largest difference of two components.
fn apart(a: &[[f32; 2]], b: &[[f32; 2]]) -> f32 {
    let pairs = a.as_flattened().iter().zip(b.as_flattened());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// Runs of both devices from the same seed: steps, a stop, and further steps from the state that was kept.
#[test]
#[expect(clippy::too_many_lines, reason = "one story: steps, a stop, further steps")]
fn a_run_on_a_gpu_keeps_the_state_of_a_run_on_the_cpu() {
    let config = config(Core::MinLstm);
    let (streams, description) = (streams(), description(&config));
    let unroll = config.unroll[0].frames;
    let scale = LossScale {
        loss: &config.loss,
        noise: &config.windows.noise,
        normalization: &description.normalization,
        ballistic: Ballistic::new(&description),
        common: Vec::new(),
    };
    let task = GradientTask {
        config: &config,
        description: &description,
        scale: &scale,
        device: DeviceKind::Flex,
    };
    let weights = random_weights(&description);
    let checkpoint = |state: &RunState| {
        let tensors = state.tensors(&description);
        Checkpoint::new(description.clone(), tensors)
    };
    let run = |open: &dyn Fn() -> Learner| {
        let mut state = RunState::new(&config, &description, None);
        state.weights = in_order(&description, &weights).into();
        state.unroll = unroll;
        let mut sampler = Sampler::new(&streams, &config.windows, unroll).unwrap();
        let mut losses = Vec::new();
        for rates in [vec![1e-3, 2e-3], vec![3e-3]] {
            let batches = Batches { first: 1, unroll, rates, left: 1 };
            let mut learner = open();
            learner.begin(&task, &state).unwrap();
            // Its weights are those before the steps, and change with them.
            learner.surrogate(&checkpoint(&state)).unwrap();
            let steps = learner.steps(&task, &mut sampler, &batches, &mut state).unwrap();
            losses.extend(steps.into_iter().map(|step| (step.loss, step.windows)));
            learner.sync(&mut state).unwrap();
            let first = streams[0].cut(0..1).unwrap().frame(0);
            let [exact, rounded] = [WeightFormat::F32, WeightFormat::F16].map(|format| {
                let checkpoint = checkpoint(&state).with_weights(format);
                let found = learner.surrogate(&checkpoint).unwrap();
                let expected = Surrogate::load(&checkpoint, None).unwrap();
                let [found, expected] = [found, expected].map(|surrogate| {
                    let mut hidden = surrogate.start(&first).unwrap();
                    surrogate.stepper().step(&mut hidden, &first).velocity
                });
                assert!(apart(&found, &expected) < 1e-5, "a model for validation, {format:?}");
                expected
            });
            assert!(apart(&exact, &rounded) > 1e-5, "rounding changes nothing");
        }
        (state, losses)
    };
    let (expected, expected_losses) = run(&|| Learner::Burn);
    let (found, found_losses) = run(&|| {
        let device = Arc::new(Emulator::new(&Constants::of(&description).unwrap()).unwrap());
        Learner::Cuda(Box::new(
            cuda::Learner::on([(device as Arc<dyn Device>, Place::Host)], &description, &streams)
                .unwrap(),
        ))
    });

    assert_eq!(found_losses.len(), 3);
    for ((found, same), (expected, windows)) in found_losses.iter().zip(&expected_losses) {
        assert_eq!(same, windows, "the same windows are drawn");
        assert!((found / expected - 1.0).abs() < 2e-5, "loss {expected} on the CPU, {found}");
    }
    assert_eq!(found.optimizer.steps, expected.optimizer.steps);
    assert_eq!(found.order.get_word_pos(), expected.order.get_word_pos());
    assert_eq!(found.optimizer.moments.len(), expected.optimizer.moments.len());
    for (found, expected) in found.optimizer.moments.iter().zip(&expected.optimizer.moments) {
        assert!(relative_error(&found.first, &expected.first) < 1e-4, "first moments");
        assert!(relative_error(&found.second, &expected.second) < 1e-4, "second moments");
        assert!(relative_error(&found.average, &expected.average) < 1e-4, "averages");
    }
    let (found, expected) =
        (by_name(&description, &found.weights), by_name(&description, &expected.weights));
    for (name, expected) in expected {
        assert!(relative_error(&found[&name].values, &expected.values) < 5e-5, "{name}");
    }
}

#[test]
fn gpus_do_not_cut_gradients_of_the_frame_model() {
    let mut config = config(Core::MinGru);
    assert!(config.runs_on_gpus());
    config.truncation = 2;
    assert!(!config.runs_on_gpus());
    let settings = [cuda::settings(&config, 3, 1)];
    let bytes = frame::footprint::bytes(&description(&config), &settings, 10, Place::Device);
    let refused = bytes.unwrap_err().to_string();
    assert!(refused.contains("truncation = 2 for the frame model"), "{refused}");
}

#[test]
fn inputs_for_materials_that_the_kernels_do_not_know_are_refused_for_the_frame_model() {
    let description = Description { material_inputs: 6, ..description(&config(Core::MinGru)) };
    let refused = Constants::of(&description).unwrap_err().to_string();
    assert!(refused.contains("material_inputs = 6"), "{refused}");
}

#[test]
fn muon_on_gpus_is_not_for_the_frame_model() {
    let mut config = config(Core::MinGru);
    config.optimizer.kind = OptimizerKind::Muon;
    assert!(!config.runs_on_gpus());
    let settings = [cuda::settings(&config, 3, 1)];
    let bytes = frame::footprint::bytes(&description(&config), &settings, 10, Place::Device);
    let refused = bytes.unwrap_err().to_string();
    assert!(refused.contains("optimizer.kind = muon for the frame model"), "{refused}");
}
