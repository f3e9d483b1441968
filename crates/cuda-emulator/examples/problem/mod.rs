//! Networks with streams of particles that move at random, for the examples and tests of this crate.

use std::{collections::BTreeMap, error::Error, sync::Arc};

use eddy_cuda::{
    device::Device,
    frame::{Place, Store, StoreWriter, Training},
    kernels::Constants,
    training::{Batch, InTraining as _, Outcome, Settings, Window},
};
use eddy_inference::checkpoint::{
    Architecture, Core, Description, MaterialInput, Pooling, Sizes, Weights, initial_weights,
};

pub type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// The paper's widths.
pub const PAPER: Sizes = Sizes { encoder: 256, hidden: 1250, layers: 2, particles: Some(2500) };

/// Numbers in -1..1 that only depend on the seed.
pub struct Noise(pub u64);

impl Noise {
    pub fn next(&mut self) -> f32 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}

/// A network of these widths, its weights, and streams of particles that move at random.
#[derive(Clone)]
pub struct Problem {
    pub description: Description,
    pub weights: BTreeMap<String, Weights>,
    pub settings: Settings,
    pub frames: usize,
    pub place: Place,
    streams: usize,
}

impl Problem {
    pub fn new(core: Core, sizes: Sizes, one_hot: bool, settings: Settings) -> Self {
        let mut description = Description::untrained(Architecture::Frame, core, sizes);
        if !one_hot {
            description.frame.material = MaterialInput::Scalar;
        }
        let weights = Self::weights(&description);
        Self { description, weights, settings, frames: 40, place: Place::Device, streams: 8 }
    }

    /// The same with another pooling of the particles.
    #[must_use]
    pub fn with_pooling(mut self, pooling: Pooling) -> Self {
        self.description.frame.pooling = pooling;
        self.weights = Self::weights(&self.description);
        self
    }

    /// Initial weights, those of the decoder at random: its zeros would leave the other layers without gradients.
    fn weights(description: &Description) -> BTreeMap<String, Weights> {
        let mut noise = Noise(7);
        let mut weights = initial_weights(description, 1);
        for weight in weights.get_mut("decoder.weight").into_iter().flat_map(|w| &mut w.values) {
            *weight = 0.03 * noise.next();
        }
        weights
    }

    fn store(&self, device: &dyn Device) -> Result<Store> {
        let particles = self.description.sizes.particles.unwrap_or_default();
        let mut noise = Noise(3);
        let mut store =
            StoreWriter::new(device, particles, self.frames * self.streams, self.place)?;
        for stream in 0..self.streams {
            let material: Vec<u8> =
                (0..particles).map(|p| ((p * 4 / particles + stream) % 4) as u8).collect();
            store.stream(&material);
            for _ in 0..self.frames {
                let bodies: Vec<_> = (0..particles)
                    .map(|_| {
                        [
                            0.5 + 0.4 * noise.next(),
                            0.5 + 0.4 * noise.next(),
                            noise.next(),
                            noise.next(),
                        ]
                    })
                    .collect();
                store.frame(&bodies)?;
            }
        }
        Ok(store.finish()?)
    }

    pub fn training(&self, device: Arc<dyn Device>) -> Result<Training> {
        let store = Arc::new(self.store(&*device)?);
        let training = Training::new(device, store, &self.description, &self.settings)?;
        training.set_weights(&self.weights)?;
        let even = 2.0
            * self.description.sizes.particles.unwrap_or_default() as f32
            * self.settings.unroll as f32;
        training.set_error_weights([1.0 / even, 1.0 / even, 0.25 / even, 0.25 / even])?;
        Ok(training)
    }

    pub fn constants(&self) -> Result<Constants> {
        Ok(Constants::of(&self.description)?)
    }

    pub fn batches(&self, count: usize) -> Vec<Batch> {
        let window = |i: usize| Window {
            stream: i * 7 % self.streams,
            start: i * 13 % (self.frames - self.settings.warm_up - self.settings.unroll),
            mirrored: i.is_multiple_of(3),
            noise: i.is_multiple_of(2).then_some([i as u8; 32]),
        };
        (1..=count)
            .map(|step| Batch {
                windows: (0..self.settings.batch)
                    .map(|i| window(i + step * self.settings.batch))
                    .collect(),
                rate: 1e-3 / (1.0 - 0.9f32.powi(step as i32)),
                plain_rate: 1e-3,
                shares: [1.0, 0.0, 0.0, 0.0],
                correction: 1.0 / (1.0 - 0.999f32.powi(step as i32)).sqrt(),
                kept: 0.5,
                dropout: [step as u8; 32],
                weights: None,
            })
            .collect()
    }
}

/// Calls `work` for each of several devices that train together, in a thread of its own, with a training and its part of the
/// batches.
pub fn together<D: Device + 'static, T: Send>(
    problem: &Problem,
    devices: Vec<D>,
    batches: &[Batch],
    work: impl Fn(Training, Vec<Batch>) -> Result<T> + Sync,
) -> Result<Vec<T>> {
    let part = problem.settings.batch / devices.len();
    let settings = Settings { batch: part, ..problem.settings.clone() };
    let problem = &Problem { settings, ..problem.clone() };
    let run = |number: usize, device: D| -> Result<T> {
        let of_device = |batch: &Batch| {
            let windows = batch.windows[number * part..(number + 1) * part].to_vec();
            Batch { windows, ..batch.clone() }
        };
        work(problem.training(Arc::new(device))?, batches.iter().map(of_device).collect())
    };
    std::thread::scope(|scope| {
        let run = &run;
        let start = |(number, device)| {
            scope.spawn(move || run(number, device).map_err(|reason| reason.to_string()))
        };
        let threads: Vec<_> = devices.into_iter().enumerate().map(start).collect();
        threads
            .into_iter()
            .map(|thread| Ok(thread.join().map_err(|_| "a device's thread has panicked")??))
            .collect()
    })
}

/// What came of the steps of a device, and its weights.
pub type Trained = (Vec<Outcome>, BTreeMap<String, Weights>);

/// Steps of several devices.
pub fn train_together<D: Device + 'static>(
    problem: &Problem,
    devices: Vec<D>,
    batches: &[Batch],
) -> Result<Vec<Trained>> {
    together(problem, devices, batches, |mut training, batches| {
        training.start(&batches)?;
        Ok((training.outcomes(batches.len())?, training.weights()?))
    })
}

/// The largest relative error of a tensor.
pub fn worst(found: &BTreeMap<String, Weights>, expected: &BTreeMap<String, Weights>) -> f64 {
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
    let errors = expected.iter().map(|(name, expected)| {
        let pairs = found[name].values.iter().zip(&expected.values);
        norm(&mut pairs.map(|(a, b)| f64::from(a - b)))
            / norm(&mut expected.values.iter().map(|&b| f64::from(b))).max(1e-12)
    });
    errors.fold(0.0, f64::max)
}
