//! Compares networks, losses, gradients and Adam with PyTorch, using the data in `tests/golden/torch`; its generator,
//! `generate.py`, documents each tensor.

use std::{collections::BTreeMap, fs, path::Path, sync::Arc};

use burn::tensor::{Device, Tensor};
use safetensors::{Dtype, SafeTensors, tensor::TensorView};
use serde::Deserialize;

use super::{
    OptimizerConfig, TrainConfig, batch::Batch, loss, loss_weights::LossScale,
    optimizer::Optimizer, window::Window,
};
use crate::model::{
    DeviceKind,
    described::Model,
    dropout::Dropout,
    network::Network,
    state::{RecurrentState, TrajectoryBatch},
};
use eddy_frames::{Material, State};
use eddy_inference::{
    checkpoint::{Description, Weights, plan::Plan},
    engine::Ballistic,
};

/// Tolerance of forward pass, loss and gradients, relative to the largest value in the tensor.
const TOLERANCE: f64 = 1e-5;
/// Tolerance of the changes by ten steps of Adam.
const TOLERANCE_AFTER_ADAM: f64 = 1e-3;
const STEPS: u32 = 10;
const LEARNING_RATE: f64 = 1e-3;
const EPSILON: f32 = 1e-8;

/// The results of PyTorch for a network.
struct Golden {
    name: String,
    description: Description,
    config: TrainConfig,
    windows: Vec<Window>,
    /// By name, `forward.position` and the like.
    tensors: BTreeMap<String, Vec<f32>>,
    weights: BTreeMap<String, Weights>,
    loss: f64,
}

/// The metadata.
#[derive(Deserialize)]
struct Row {
    description: Description,
    training: Training,
}

/// Settings of the loss; the others are the defaults of [`TrainConfig`].
#[derive(Deserialize)]
struct Training {
    warm_up: usize,
    observed_weight: f32,
    clip: Option<f32>,
    #[serde(default)]
    truncation: usize,
}

/// Little-endian numbers of a tensor.
fn numbers(tensor: &TensorView) -> Vec<f32> {
    let (bytes, _) = tensor.data().as_chunks::<4>();
    bytes.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

impl Golden {
    fn read(file: &Path) -> Self {
        let bytes = fs::read(file).unwrap();
        let (_, header) = SafeTensors::read_metadata(&bytes).unwrap();
        let words = header.metadata().as_ref().unwrap();
        let Row { description, training } = serde_json::from_str(&words["row"]).unwrap();
        // Mean squared errors, also of the particle model.
        let mut config = TrainConfig::paper();
        config.windows.warm_up = training.warm_up;
        config.truncation = training.truncation;
        config.loss.observed_weight = training.observed_weight;
        config.loss.density_weight = 0.0;
        config.optimizer.epsilon = EPSILON;
        config.optimizer.clip = training.clip.unwrap_or(f32::INFINITY);

        let data = SafeTensors::deserialize(&bytes).unwrap();
        let loss = data.tensor("loss").unwrap().data().try_into().unwrap();
        let floats = || data.iter().filter(|(_, tensor)| tensor.dtype() == Dtype::F32);
        let weights = floats().filter_map(|(name, tensor)| {
            let name = name.strip_prefix("weight.")?.to_owned();
            Some((name, Weights { shape: tensor.shape().to_vec(), values: numbers(&tensor) }))
        });
        let weights = weights.collect();
        let tensors: BTreeMap<_, _> =
            floats().map(|(name, tensor)| (name.to_owned(), numbers(&tensor))).collect();
        let windows = windows(&data.tensor("input.material").unwrap(), &tensors);
        let name = file.file_stem().unwrap().to_string_lossy().into_owned();
        Self {
            name,
            description,
            config,
            windows,
            tensors,
            weights,
            loss: f64::from_le_bytes(loss),
        }
    }

    fn network(&self, device: &Device) -> Network {
        let model = Model::new(&self.description);
        let weights = model.plan.in_order(&self.weights);
        Network::new(&model, &Arc::new(weights), device)
    }

    /// The windows, of which the first `warm_up` frames are observed.
    fn batch(&self, warm_up: usize, device: &Device) -> Batch {
        let scale = LossScale {
            loss: &self.config.loss,
            noise: &self.config.windows.noise,
            normalization: &self.description.normalization,
            ballistic: Ballistic::new(&self.description),
            common: Vec::new(),
        };
        Batch::new(&self.windows, warm_up, &scale, &self.description, device)
    }

    /// The loss of the network on the golden windows.
    fn loss(&self, network: &Network, device: &Device) -> Tensor<1> {
        let batch = self.batch(self.config.windows.warm_up, device);
        let (predicted, steps) =
            loss::unroll(network, &batch, self.config.truncation, &mut Dropout::none());
        loss::loss(&self.config.loss, &batch, &predicted, &steps, self.description.domain)
    }

    /// Compares a trajectory with the golden one, `NAME.position` and `NAME.velocity`.
    fn compare_track(&self, name: &str, found: TrajectoryBatch, device: DeviceKind) {
        for (part, found) in [("position", found.position), ("velocity", found.velocity)] {
            let found: Vec<f32> = found.into_data().iter::<f32>().collect();
            self.compare(&format!("{name}.{part}"), &found, TOLERANCE, device);
        }
    }

    /// Compares every tensor of a network with the golden one, `PREFIX.NAME`.
    fn compare_layers(
        &self,
        prefix: &str,
        found: &BTreeMap<String, Weights>,
        tolerance: f64,
        device: DeviceKind,
    ) {
        assert_eq!(found.len(), self.weights.len());
        for (name, found) in found {
            self.compare(&format!("{prefix}.{name}"), &found.values, tolerance, device);
        }
    }

    /// Turns weights after steps into their changes.
    fn subtract_weights(&self, weights: &mut BTreeMap<String, Weights>) {
        for (name, change) in weights {
            for (after, before) in change.values.iter_mut().zip(&self.weights[name].values) {
                *after -= before;
            }
        }
    }

    /// Compares values with those of the golden tensor `name`: max|a - b| <= `tolerance` max|b|.
    fn compare(&self, name: &str, found: &[f32], tolerance: f64, device: DeviceKind) {
        let expected = &self.tensors[name];
        assert_eq!(found.len(), expected.len(), "{}: {name}", self.name);
        let largest = expected.iter().fold(0.0, |largest: f64, b| largest.max(f64::from(b.abs())));
        let apart = |(a, b): (&f32, &f32)| f64::from((a - b).abs());
        let difference = found.iter().zip(expected).map(apart).fold(0.0, f64::max);
        // Written so that NaN fails.
        assert!(
            difference <= tolerance * largest,
            "{}, {device:?}: {name}: {difference:.2e} of {largest:.2e}",
            self.name
        );
    }
}

/// The golden input, window by window.
fn windows(material: &TensorView, tensors: &BTreeMap<String, Vec<f32>>) -> Vec<Window> {
    let [count, particles] = material.shape().try_into().unwrap();
    let pairs = |name: &str| tensors[name].as_chunks::<2>().0;
    let (position, velocity) = (pairs("input.position"), pairs("input.velocity"));
    let frames = position.len() / (count * particles);
    let window = |window: usize| {
        let kinds = &material.data()[window * particles..(window + 1) * particles];
        let states = (0..frames).map(|frame| {
            let start = (frame * count + window) * particles;
            let of = |values: &[[f32; 2]]| values[start..start + particles].to_vec();
            State { position: of(position), velocity: of(velocity) }
        });
        Window {
            stream: window as u64,
            start: 0,
            material: kinds.iter().map(|&kind| Material::try_from(kind).unwrap()).collect(),
            rest: position[window * particles..(window + 1) * particles].to_vec(),
            stiffness: tensors.get("input.stiffness").map(|all| all[window]),
            sweeps: vec![None; states.len() - 1],
            states: states.collect(),
            noisy: None,
        }
    };
    (0..count).map(window).collect()
}

/// Every golden network.
fn networks() -> Vec<Golden> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/golden/torch");
    let files = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    let files: Vec<_> = files
        .filter(|file| file.extension().is_some_and(|extension| extension == "safetensors"))
        .collect();
    assert_eq!(files.len(), 34, "the rows of generate.py");
    files.iter().map(|file| Golden::read(file)).collect()
}

/// Calls `check` with every golden network on every device of burn.
fn for_all(check: impl Fn(&Golden, DeviceKind)) {
    for golden in networks() {
        for device in [DeviceKind::Flex, DeviceKind::Ndarray] {
            check(&golden, device);
        }
    }
}

#[test]
fn every_network_predicts_the_same_as_pytorch() {
    for_all(|golden, kind| {
        let device = kind.device();
        let network = golden.network(&device);
        let none = &mut Dropout::none();
        let all = golden.batch(golden.windows[0].states.len() - 1, &device);
        let frames = TrajectoryBatch {
            position: Tensor::cat(vec![all.observed.position, all.future.position], 0),
            velocity: Tensor::cat(vec![all.observed.velocity, all.future.velocity], 0),
        };
        let (forward, _) = network.observe(&frames, &all.fixed, RecurrentState::default(), none);
        golden.compare_track("forward", forward, kind);

        let batch = golden.batch(golden.config.windows.warm_up, &device);
        let (future, _) = loss::unroll(&network, &batch, 0, none);
        golden.compare_track("unroll", future, kind);
    });
}

#[test]
fn losses_and_gradients_equal_those_of_pytorch() {
    for_all(|golden, kind| {
        let device = kind.device();
        let network = golden.network(&device.clone().autodiff());
        let loss = golden.loss(&network, &device);
        let value = f64::from(loss.clone().inner().into_scalar::<f32>());
        let difference = (value - golden.loss).abs();
        assert!(difference <= TOLERANCE * golden.loss, "{}: {value} {}", golden.name, golden.loss);

        let gradients = network.gradients(&mut loss.backward());
        let gradients = Plan::new(&golden.description).by_name(&gradients);
        golden.compare_layers("gradient", &gradients, TOLERANCE, kind);
    });
}

/// Loss, gradients and ten steps of Adam by the kernels for GPUs, in the emulator.
#[cfg(feature = "cuda")]
#[test]
#[expect(clippy::too_many_lines, reason = "one story: loss, gradients, ten steps")]
fn kernels_for_gpus_take_the_steps_of_pytorch() {
    use super::{cuda, optimizer::Correction, window::Draw};
    use eddy_cuda::{
        frame::{Place, Training},
        kernels::Constants,
        training::InTraining as _,
    };
    use eddy_cuda_emulator::Emulator;
    use eddy_dataset::{Stream, Trajectory};
    use eddy_frames::Stamp;

    let frame_models =
        networks().into_iter().filter(|golden| golden.description.sizes.particles.is_some());
    // GPUs cut gradients of the particle model only.
    for golden in frame_models.filter(|golden| golden.config.truncation == 0) {
        let Golden { description, config, windows, .. } = &golden;
        let streams = windows.iter().map(|window| {
            Trajectory::from(Stream {
                id: window.stream,
                source: golden.name.clone().into(),
                dt: description.dt,
                domain: description.domain,
                material: window.material.clone(),
                first_sequence: 0,
                first_stamp: Stamp::default(),
                stiffness: None,
                tools: None,
                states: window.states.clone(),
            })
        });
        let streams: Vec<_> = streams.collect();
        let mut config = config.clone();
        config.windows.batch = windows.len();
        config.network.dropout = 0.0;
        let unroll = windows[0].states.len() - config.windows.warm_up;
        let emulator = Emulator::new(&Constants::of(description).unwrap()).unwrap();
        let store = cuda::store(&emulator, &streams, Place::Device).unwrap();
        let settings = cuda::settings(&config, unroll, 1);
        let mut training =
            Training::new(Arc::new(emulator), Arc::new(store), description, &settings).unwrap();
        training.set_weights(&golden.weights).unwrap();
        let scale = LossScale {
            loss: &config.loss,
            noise: &config.windows.noise,
            normalization: &description.normalization,
            ballistic: Ballistic::new(description),
            common: Vec::new(),
        };
        let particles = description.sizes.particles.unwrap();
        let weights = cuda::common_weights(&scale, unroll, particles).unwrap();
        training.set_error_weights(weights).unwrap();
        let draws: Vec<_> = (0..windows.len())
            .map(|stream| Draw { stream, start: 0, mirrored: false, noise: None })
            .collect();
        let batch = |step: u32| {
            let correction = Correction::new(step, LEARNING_RATE, &config.optimizer);
            cuda::batch(&draws, &correction, crate::train::knots::ONE_SET, None, None)
        };
        let kind = DeviceKind::Cuda(0);

        training.start(&[batch(1)]).unwrap();
        let found = f64::from(training.outcomes(1).unwrap()[0].loss);
        let difference = (found - golden.loss).abs();
        assert!(difference <= TOLERANCE * golden.loss, "{}: {found} {}", golden.name, golden.loss);
        golden.compare_layers("gradient", &training.gradients().unwrap(), TOLERANCE, kind);

        let batches: Vec<_> = (2..=STEPS).map(batch).collect();
        training.start(&batches).unwrap();
        let mut changes = training.weights().unwrap();
        golden.subtract_weights(&mut changes);
        golden.compare_layers("change", &changes, TOLERANCE_AFTER_ADAM, kind);
    }
}

#[test]
fn ten_steps_of_adam_change_the_weights_as_in_pytorch() {
    for_all(|golden, kind| {
        let device = kind.device();
        let model = Model::new(&golden.description);
        let mut weights = Arc::new(model.plan.in_order(&golden.weights));
        let mut optimizer = Optimizer::default();
        let config: &OptimizerConfig = &golden.config.optimizer;
        for _ in 0..STEPS {
            let network = Network::new(&model, &weights, &device.clone().autodiff());
            let gradients = network.gradients(&mut golden.loss(&network, &device).backward());
            let mut step = optimizer.step(LEARNING_RATE, config);
            let all = Arc::make_mut(&mut weights).iter_mut().zip(&gradients).enumerate();
            all.for_each(|(tensor, (values, gradient))| step.change(tensor, values, gradient));
        }
        let mut changes = model.plan.by_name(&weights);
        golden.subtract_weights(&mut changes);
        golden.compare_layers("change", &changes, TOLERANCE_AFTER_ADAM, kind);
    });
}
