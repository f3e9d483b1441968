use std::{collections::BTreeMap, sync::Arc};

use burn::tensor::{Device, Tensor, TensorData};
use proptest::prelude::*;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::{
    described::Model,
    dropout::Dropout,
    network::Network,
    state::{ParticleState, RecurrentState, StaticInputs, TrajectoryBatch},
    tape::Pass,
    *,
};
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::{
    checkpoint::{
        Activation, Checkpoint, Description, FeatureScaling, Form, FrameOutput, GridOptions,
        MaterialInput, Normalization, Pooling, Rules, Sizes, Weights, initial_weights,
        plan::{POSITION, VELOCITY},
        tensor_shapes,
    },
    engine::Ballistic,
    ops::linear::Linear,
};

const PARTICLES: usize = 7;
const DT: f32 = 0.016;

fn description(architecture: Architecture, core: Core) -> Description {
    let particles = (architecture == Architecture::Frame).then_some(PARTICLES);
    // A spacing so large that all particles are neighbours.
    let grid = GridOptions { cell_width: 0.2, channels: vec![3, 4, 5], spacing: 0.3 };
    Description {
        grid: particles.is_none().then_some(grid),
        materials: vec![Material::Liquid, Material::Jelly],
        // No rules: the network alone.
        rules: Rules::default(),
        normalization: Normalization {
            minimum: [0.05, 0.05, -3.0, -4.0],
            maximum: [0.95, 0.95, 3.0, 3.0],
            mean: [0.5, 0.3, 0.1, -0.5],
            standard_deviation: [0.2, 0.2, 0.7, 0.9],
        },
        ..Description::untrained(
            architecture,
            core,
            Sizes { encoder: 6, hidden: 5, layers: 2, particles },
        )
    }
}

/// Initial weights, but with a decoder that is not zero.
fn weights(description: &Description, seed: u64) -> BTreeMap<String, Weights> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut tensors = initial_weights(description, seed);
    for name in ["decoder.weight", "decoder.bias"] {
        for value in &mut tensors.get_mut(name).unwrap().values {
            *value = random.random_range(-0.3..0.3);
        }
    }
    tensors
}

/// Particles at random places in every frame.
fn frames(count: u64) -> Vec<Frame> {
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let mut pairs = |low: f32, high: f32| {
        (0..PARTICLES).map(|_| [(); 2].map(|()| random.random_range(low..high))).collect()
    };
    (0..count)
        .map(|sequence| Frame {
            stream: 4,
            sequence,
            stamp: Stamp(0).advance(DT, sequence as u32),
            dt: DT,
            domain: Domain::UNIT,
            position: pairs(0.06, 0.94),
            velocity: pairs(-2.0, 2.0),
            material: (0..PARTICLES)
                .map(|i| if i < 3 { Material::Liquid } else { Material::Jelly })
                .collect(),
        })
        .collect()
}

/// The described network with these weights.
fn network(
    description: &Description,
    tensors: &BTreeMap<String, Weights>,
    device: &Device,
) -> Network {
    let model = Model::new(description);
    let weights = model.plan.in_order(tensors);
    Network::new(&model, &Arc::new(weights), device)
}

/// The static inputs of windows that start with these frames, which have their rest shape.
fn fixed(description: &Description, starts: &[Frame]) -> Arc<StaticInputs> {
    let material: Vec<_> = starts.iter().flat_map(|frame| frame.material.clone()).collect();
    let rest: Vec<_> = starts.iter().flat_map(|frame| frame.position.clone()).collect();
    let stiffness: Vec<_> = (1..=starts.len()).map(|number| 3e3 * number as f32).collect();
    let stiffness = description.stiffness.then_some(&stiffness[..]);
    let grid = description.grid.as_ref();
    StaticInputs::new(&material, &rest, starts.len(), stiffness, grid)
}

fn trajectory(frames: &[Frame], device: &Device) -> TrajectoryBatch {
    let rows = |values: &[[f32; 2]]| {
        let data = TensorData::new(values.as_flattened().to_vec(), [values.len(), 2]);
        Tensor::<2>::from_data(data, device)
    };
    let state = frames
        .iter()
        .map(|f| ParticleState { position: rows(&f.position), velocity: rows(&f.velocity) });
    TrajectoryBatch::stack(state.collect())
}

fn numbers<const D: usize>(tensor: &Tensor<D>) -> Vec<f32> {
    tensor.clone().into_data().try_to_vec().unwrap()
}

fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
    assert_eq!(a.len(), b.len());
    let apart = |(a, b): (&f32, &f32)| (a - b).abs();
    // NaN is far apart.
    let apart = a.iter().zip(b).map(apart).map(|x| if x.is_nan() { f32::INFINITY } else { x });
    apart.fold(0.0, f32::max)
}

/// Every network, and one that is conditioned on the stiffness.
fn every_network() -> impl Iterator<Item = Description> {
    let both = [Architecture::Frame, Architecture::Particle];
    let conditioned = Description { stiffness: true, ..description(both[1], Core::MinGru) };
    let all = both.into_iter().flat_map(|kind| Core::ALL.map(|core| description(kind, core)));
    all.chain([conditioned])
}

/// The stiffness of a stream for a network that is conditioned on it.
fn stiffness(description: &Description) -> Option<f32> {
    description.stiffness.then_some(3e3)
}

#[test]
fn streaming_frame_by_frame_equals_observing_all_frames_at_once() {
    let frames = frames(9);
    for description in every_network() {
        let checkpoint = Checkpoint::new(description.clone(), weights(&description, 1));
        let device = DeviceKind::Flex.device();
        let network = network(&checkpoint.description, &checkpoint.tensors, &device);
        let fixed = fixed(&description, &frames[..1]);
        let none = &mut Dropout::none();
        // In two parts, to include the carried state.
        let (start, rest) = frames.split_at(4);
        let (first, hidden) =
            network.observe(&trajectory(start, &device), &fixed, RecurrentState::default(), none);
        let (second, _) = network.observe(&trajectory(rest, &device), &fixed, hidden, none);
        let expected = [first, second].map(|t| [numbers(&t.position), numbers(&t.velocity)]);

        let reference = Reference::load(&checkpoint, DeviceKind::Flex).unwrap();
        let mut hidden = reference.start(&frames[0], stiffness(&description));
        let streamed: Vec<Frame> =
            frames.iter().map(|frame| reference.step(&mut hidden, frame)).collect();
        let flat = |pick: fn(&Frame) -> &Vec<[f32; 2]>| -> Vec<f32> {
            streamed.iter().flat_map(|f| pick(f).as_flattened()).copied().collect()
        };
        for (part, found) in [flat(|f| &f.position), flat(|f| &f.velocity)].iter().enumerate() {
            let expected = [expected[0][part].clone(), expected[1][part].clone()].concat();
            let difference = largest_difference(found, &expected);
            assert!(difference <= 1e-5, "{difference}: {description:?}");
        }
        assert_eq!(streamed[8].sequence, 9);
        assert_eq!(streamed[8].stamp, Stamp(9 * 16_000_000));
    }
}

#[test]
fn flex_and_ndarray_agree() {
    let frames = frames(6);
    for description in every_network() {
        let checkpoint = Checkpoint::new(description.clone(), weights(&description, 2));
        let [flex, ndarray] = [DeviceKind::Flex, DeviceKind::Ndarray].map(|device| {
            let reference = Reference::load(&checkpoint, device).unwrap();
            let mut hidden = reference.start(&frames[0], stiffness(&description));
            let last = frames.iter().map(|frame| reference.step(&mut hidden, frame)).last();
            last.unwrap()
        });
        for (a, b) in [(flex.position, ndarray.position), (flex.velocity, ndarray.velocity)] {
            let difference = largest_difference(a.as_flattened(), b.as_flattened());
            assert!(difference <= 1e-4, "{difference}: {description:?}");
        }
    }
}

/// Descriptions that together cover every core, form, pooling, activation, normalisation and kind of input.
fn every_option() -> Vec<Description> {
    let mut all: Vec<Description> = every_network().collect();
    let frame = |core, change: fn(&mut Description)| {
        let mut description = description(Architecture::Frame, core);
        change(&mut description);
        description
    };
    all.extend([
        frame(Core::MinGru, |d| d.form = Form::Log),
        frame(Core::MinLstm, |d| d.form = Form::Log),
        frame(Core::MinLstm, |d| d.normalize_gates = false),
        frame(Core::MinLstm, |d| {
            d.form = Form::Log;
            d.normalize_gates = false;
        }),
        frame(Core::MinGru, |d| d.frame.pooling = Pooling::Max),
        frame(Core::Gru, |d| d.frame.pooling = Pooling::MeanMax),
        frame(Core::MinGru, |d| d.frame.material = MaterialInput::Scalar),
        frame(Core::MinGru, |d| d.frame.scaling = FeatureScaling::ZScore),
        frame(Core::MinGru, |d| d.material_inputs = 6),
        frame(Core::MinGru, |d| d.frame.output = FrameOutput::Residual),
        frame(Core::MinGru, |d| d.frame.output = FrameOutput::Position),
    ]);
    // Wide enough to use several threads.
    all.extend([Core::Lstm, Core::Gru, Core::MinLstm, Core::MinGru].map(|core| {
        frame(core, |d| d.sizes = Sizes { encoder: 40, hidden: 600, ..d.sizes.clone() })
    }));
    all.extend(Activation::ALL.map(|activation| {
        let mut description = description(Architecture::Frame, Core::Mlp);
        description.frame.activation = activation;
        description
    }));
    all
}

/// Predictions of three windows over a warm-up and two free frames, with dropout, and the gradients of their weighted squares by every
/// tensor.
fn values_and_gradients(description: &Description, device: DeviceKind) -> Vec<Vec<f32>> {
    let recorded = device.device().autodiff();
    let network = network(description, &weights(description, 3), &recorded);
    let frames = frames(9);
    let windows: Vec<TrajectoryBatch> =
        frames.chunks(3).map(|frames| trajectory(frames, &device.device())).collect();
    let side_by_side = |pick: fn(&TrajectoryBatch) -> &Tensor<3>| {
        Tensor::cat(windows.iter().map(|trajectory| pick(trajectory).clone()).collect(), 1)
    };
    let trajectory = TrajectoryBatch {
        position: side_by_side(|t| &t.position),
        velocity: side_by_side(|t| &t.velocity),
    };
    let starts: Vec<Frame> = frames.chunks(3).map(|frames| frames[0].clone()).collect();
    let fixed = fixed(description, &starts);
    let dropout = &mut Dropout::new(0.3, ChaCha8Rng::seed_from_u64(5));
    let (steps, hidden) = network.observe(&trajectory, &fixed, RecurrentState::default(), dropout);
    let (next, hidden) = network.step(&steps.at(2), &fixed, hidden, dropout);
    let (after, _) = network.step(&next, &fixed, hidden, dropout);
    let mut values = vec![numbers(&steps.position), numbers(&steps.velocity)];
    values.extend([&next, &after].map(|state| numbers(&state.velocity)));
    let loss = steps.velocity.square().sum()
        + next.position.square().sum()
        + after.velocity.square().sum().mul_scalar(0.5);
    values.extend(network.gradients(&mut loss.backward()));
    values
}

#[test]
fn the_tape_and_the_definition_give_the_same_values_and_gradients() {
    for description in every_option() {
        let found = values_and_gradients(&description, DeviceKind::Flex);
        let expected = values_and_gradients(&description, DeviceKind::Ndarray);
        let tensors = tensor_shapes(&description).len();
        assert_eq!((found.len(), expected.len()), (4 + tensors, 4 + tensors));
        assert!(found.iter().all(|values| !values.is_empty()), "a tensor without a gradient");
        for (index, (found, expected)) in found.iter().zip(&expected).enumerate() {
            let largest = expected.iter().fold(1e-6f32, |largest, x| largest.max(x.abs()));
            let difference = largest_difference(found, expected) / largest;
            // Velocities that are differences of positions have their rounding, divided by the frame interval.
            assert!(difference <= 5e-5, "{index}: {difference}: {description:?}");
        }
    }
}

/// Predictions of many frames after a state that was made up, the state after them, and the gradients of the sum of their squares by
/// the positions, by that state and by the weights.
fn from_a_state(description: &Description, frames: usize, device: DeviceKind) -> Vec<Vec<f32>> {
    let recorded = device.device().autodiff();
    let network = network(description, &weights(description, 3), &recorded);
    let frames = self::frames(frames as u64);
    let fixed = fixed(description, &frames[..1]);
    let mut random = ChaCha8Rng::seed_from_u64(frames.len() as u64);
    let mut made_up = |shape: [usize; 2]| {
        let numbers = (0..shape[0] * shape[1]).map(|_| random.random_range(-1.0..1.0));
        let numbers = TensorData::new(numbers.collect::<Vec<f32>>(), shape);
        Tensor::<2>::from_data(numbers, &recorded).require_grad()
    };
    let rows = if description.grid.is_some() { PARTICLES } else { 1 };
    let states = made_up(Model::new(description).state_shape(rows));
    let expected = made_up([PARTICLES, 2]);
    let TrajectoryBatch { position, velocity } = trajectory(&frames, &recorded);
    let position = position.require_grad();
    let shown = TrajectoryBatch { position: position.clone(), velocity };
    let hidden =
        RecurrentState { states: Some(states.clone()), expected_velocity: Some(expected.clone()) };
    let (next, after) = network.observe(&shown, &fixed, hidden, &mut Dropout::none());
    let after = after.states.unwrap();
    let mut values = vec![numbers(&next.position), numbers(&next.velocity), numbers(&after)];
    let squares = [next.position, next.velocity].map(|track| track.square().sum());
    let [first, second] = squares;
    let mut gradients = (first + second + after.square().sum()).backward();
    values.push(numbers(&position.grad(&gradients).unwrap()));
    for input in [states, expected] {
        values.push(input.grad(&gradients).map_or(Vec::new(), |by| numbers(&by)));
    }
    values.extend(network.gradients(&mut gradients));
    values
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]
    #[test]
    fn the_tape_and_the_definition_continue_a_state_alike(
        frames in (0u32..=8).prop_flat_map(|power| (1usize << power) / 2 + 1..=1 << power),
    ) {
        let networks = every_option().into_iter().filter(|d| d.sizes.hidden < 100);
        for description in networks {
            let found = from_a_state(&description, frames, DeviceKind::Flex);
            let expected = from_a_state(&description, frames, DeviceKind::Ndarray);
            prop_assert_eq!(found.len(), expected.len());
            for (index, (found, expected)) in found.iter().zip(&expected).enumerate() {
                // What a network does not read has no gradient, or one of zeros.
                let read = expected.iter().any(|&by| by != 0.0);
                prop_assert!(read || found.iter().all(|&by| by == 0.0), "{}", index);
                let largest = expected.iter().fold(1e-6f32, |largest, x| largest.max(x.abs()));
                let difference =
                    if read { largest_difference(found, expected) / largest } else { 0.0 };
                prop_assert!(difference <= 5e-5, "{index}: {difference}: {description:?}");
            }
        }
    }
}

#[test]
fn an_untrained_particle_model_is_the_ballistic_step() {
    let description = description(Architecture::Particle, Core::MinGru);
    let checkpoint = Checkpoint::new(description.clone(), initial_weights(&description, 5));
    let reference = Reference::load(&checkpoint, DeviceKind::Flex).unwrap();
    let frames = frames(3);
    let mut hidden = reference.start(&frames[0], stiffness(&description));
    for frame in &frames {
        let next = reference.step(&mut hidden, frame);
        let (mut position, mut velocity) = (frame.position.clone(), frame.velocity.clone());
        Ballistic::new(&checkpoint.description).step_all(&mut position, &mut velocity);
        let found = [next.position.as_flattened(), next.velocity.as_flattened()].concat();
        let expected = [position.as_flattened(), velocity.as_flattened()].concat();
        assert!(largest_difference(&found, &expected) <= 1e-6);
    }
}

#[test]
fn pooling_before_the_second_linear_is_exact() {
    let description = description(Architecture::Frame, Core::MinGru);
    let model = Model::new(&description);
    let weights = model.plan.in_order(&weights(&description, 1));
    let frame = &frames(1)[0];
    let fixed = fixed(&description, std::slice::from_ref(frame));
    let features = model.frame_features.forward(&frame.position, &frame.velocity, &fixed.material);

    // Table 1, literally: both layers for every particle, then the mean.
    let [first, second] = [0, 1].map(|layer| &weights[2 * layer..2 * layer + 2]);
    let linear = |weights: &[Vec<f32>], activation, input: &[f32]| {
        let [weight, bias] = weights else { unreachable!("a matrix and a bias") };
        Linear { weight, bias, activation }.forward(input)
    };
    let points = linear(second, None, &linear(first, Some(Activation::Elu), &features));
    let width = description.sizes.hidden;
    let mean = (0..width)
        .map(|unit| points.iter().skip(unit).step_by(width).sum::<f32>() / PARTICLES as f32);
    let literal: Vec<_> = mean.collect();

    let operations = &(0..model.plan.core.start);
    let (model, fixed) = (&*model, &*fixed);
    let pass = Pass { model, weights: &weights, fixed, frames: 1, masks: &[], operations };
    let given = [frame.position.as_flattened().to_vec(), frame.velocity.as_flattened().to_vec()];
    let tape = pass.forward([POSITION, VELOCITY].into_iter().zip(given), Vec::new());
    assert!(largest_difference(&tape.lists[model.plan.core_inputs()[0]], &literal) <= 1e-6);
}

#[test]
fn gates_of_an_untrained_network_are_open() {
    let frames = frames(1);
    for core in [Core::MinGru, Core::MinLstm] {
        let description = description(Architecture::Particle, core);
        let device = DeviceKind::Flex.device();
        // The first layer of the core reads zeros.
        let mut tensors = initial_weights(&description, 1);
        tensors.get_mut("context.weight").unwrap().values.fill(0.0);
        let network = network(&description, &tensors, &device);
        let fixed = fixed(&description, &frames);
        // What it keeps of a state of ones.
        let after = |last: f32| {
            let shape = Model::new(&description).state_shape(PARTICLES);
            let states = Some(Tensor::full(shape, last, &device));
            let hidden = RecurrentState { states, expected_velocity: None };
            let shown = trajectory(&frames, &device);
            let (_, hidden) = network.observe(&shown, &fixed, hidden, &mut Dropout::none());
            hidden.states.unwrap().slice([0..PARTICLES, 0..shape[1]])
        };
        let kept = after(1.0) - after(0.0);
        assert!(numbers(&kept).iter().all(|a| *a < 0.45), "{core:?}");
    }
}
