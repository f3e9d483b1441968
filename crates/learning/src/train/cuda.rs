//! Training on a GPU: the same windows, dropout masks, loss and steps as on the CPU.
//!
//! 1. `batches`: steps as the device takes them. `stores`: either network on a device.
//! 2. Here: GPUs that share the batches.

mod batches;
mod stores;

use std::sync::Arc;

use super::{
    TrainConfig, TrainError,
    gradients::GradientTask,
    knots,
    optimizer::{Correction, Moments},
    state::{RunState, by_name},
    steps::Step,
    validate,
    window::{Draw, Sampler},
};
use crate::model::GpuOptions;
use eddy_cuda::{
    device::Device,
    frame::Place,
    open_gpu, open_group,
    training::{Batch, GROUP, InTraining, Outcome},
};
use eddy_dataset::Trajectory;
use eddy_inference::{
    checkpoint::{Checkpoint, Description},
    engine::Surrogate,
};

use batches::weights_differ;
pub(super) use batches::{batch, common_weights, settings, weights};
pub(super) use stores::program;
use stores::{Stores, Validation};
#[cfg(test)]
pub(super) use stores::{particle_store, store};

/// A network that learns on GPUs, each with its part of every batch. Between epochs the run's state on the CPU is brought up
/// to date.
pub(super) struct Learner {
    replicas: Vec<Replica>,
    /// The network for validation, on the first GPU.
    validation: Option<Validation>,
}

/// A GPU with the network: all have the same weights.
struct Replica {
    device: Arc<dyn Device>,
    stores: Stores,
    /// Steps of the stage at hand.
    training: Option<Box<dyn InTraining>>,
}

/// Batches that are prepared and run at once.
pub(super) const BATCHES: usize = GROUP;

impl Learner {
    /// Opens GPUs, from `number` on, and copies the training streams to each. If one has no room for them, they go to the
    /// memory of the host, of which so much is free (bytes).
    pub(super) fn new(
        number: usize,
        options: GpuOptions,
        host_free: u64,
        config: &TrainConfig,
        description: &Description,
        streams: &[Trajectory],
    ) -> Result<Self, TrainError> {
        let program = program(description)?;
        let precision = stores::precision(description, options.precision);
        let count = options.count.get();
        let batch = config.windows.batch;
        if !batch.is_multiple_of(count) {
            return Err(TrainError::Setting {
                field: "windows.batch",
                found: format!("{batch} for {count} GPUs"),
                expected: "a multiple of the number of GPUs",
            });
        }
        let gpus = match count {
            1 => vec![open_gpu(number, &*program, precision)?],
            count => open_group(number..number + count, &*program, precision)?,
        };
        let stages: Vec<_> =
            config.unroll.iter().map(|stage| settings(config, stage.frames, count)).collect();
        let mut places = Vec::new();
        for (place, gpu) in gpus.iter().enumerate() {
            let number = number + place;
            let free = host_free / count as u64;
            let place = stores::place(gpu, number, description, &stages, streams, free)?;
            if place == Place::Host {
                tracing::info!(
                    "the trajectories do not fit into the memory of GPU {number}: each step's windows are fetched from the memory of the host"
                );
            }
            places.push(place);
        }
        let devices = gpus.into_iter().map(|gpu| Arc::new(gpu) as Arc<dyn Device>);
        Self::on(devices.zip(places), description, streams)
    }

    /// Of any devices, with the place of their trajectories.
    pub(super) fn on(
        devices: impl IntoIterator<Item = (Arc<dyn Device>, Place)>,
        description: &Description,
        streams: &[Trajectory],
    ) -> Result<Self, TrainError> {
        let replica = |(device, place): (Arc<dyn Device>, Place)| {
            let stores = Stores::new(&*device, description, streams, place)?;
            Ok(Replica { device, stores, training: None })
        };
        let replicas = devices.into_iter().map(replica).collect::<Result<Vec<_>, TrainError>>()?;
        Ok(Self { replicas, validation: None })
    }

    /// Devices that share a batch.
    fn count(&self) -> usize {
        self.replicas.first().map_or(1, |replica| replica.device.rank().count)
    }

    /// Takes the run's weights and moments onto the devices, for steps of its stage.
    pub(super) fn begin(
        &mut self,
        task: &GradientTask,
        state: &RunState,
    ) -> Result<(), TrainError> {
        let count = self.count();
        self.replicas.iter_mut().try_for_each(|replica| replica.begin(task, state, count))
    }

    /// One step for each learning rate, at most [`BATCHES`].
    ///
    /// # Errors
    /// [`TrainError::Cuda`].
    pub(super) fn steps(
        &mut self,
        task: &GradientTask,
        sampler: &Sampler,
        rates: &[f64],
        state: &mut RunState,
    ) -> Result<Vec<Step>, TrainError> {
        let GradientTask { config, scale, .. } = task;
        let part = config.windows.batch / self.count();
        let mut batches = vec![Vec::new(); self.replicas.len()];
        let mut drawn = Vec::new();
        for &rate in rates {
            let draws = sampler.choose_many(config.windows.batch, &mut state.order);
            let stiffnesses = draws.iter().map(|draw| sampler.stiffness(draw));
            let shares = knots::shares(&config.network.stiffness_knots, stiffnesses);
            let masks = state.dropout.fork();
            state.optimizer.steps += 1;
            let correction = Correction::new(state.optimizer.steps, rate, &config.optimizer);
            for (replica, batches) in self.replicas.iter().zip(&mut batches) {
                let first = replica.device.rank().number * part;
                let draws = &draws[first..first + part];
                let own = weights_differ(config)
                    .then(|| weights(scale, sampler, draws, state.unroll))
                    .transpose()?;
                batches.push(batch(draws, &correction, shares, masks.random(), own));
            }
            drawn.push((rate, draws));
        }
        // A thread for each GPU: they wait for each other within a step, and so would for one that has failed.
        let devices: Vec<_> = self.replicas.iter().map(|replica| replica.device.clone()).collect();
        let outcomes = std::thread::scope(|scope| {
            let devices = &devices;
            let mut threads = Vec::new();
            for (replica, batches) in self.replicas.iter_mut().zip(batches) {
                threads.push(scope.spawn(move || {
                    let outcomes = replica.run(&batches);
                    if outcomes.is_err() {
                        devices.iter().for_each(|device| device.leave_group());
                    }
                    outcomes
                }));
            }
            let outcomes: Vec<_> = threads
                .into_iter()
                .map(|thread| {
                    thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
                })
                .collect();
            outcomes.into_iter().collect::<Result<Vec<_>, TrainError>>()
        })?;
        // All have the same outcomes: those of the whole batch.
        let outcomes = outcomes.into_iter().next().unwrap_or_default().into_iter().zip(drawn);
        Ok(outcomes.map(|(outcome, (rate, draws))| step(outcome, rate, &draws, sampler)).collect())
    }

    /// A model with the weights of the steps so far, averaged if the run keeps an average: those of `checkpoint`.
    pub(super) fn surrogate(&mut self, checkpoint: &Checkpoint) -> Result<Surrogate, TrainError> {
        let Some(first) = self.replicas.first() else { unreachable!("a learner has a device") };
        if !checkpoint.description.stiffness_knots.is_empty() {
            // A device has the weights of one stiffness.
            return validate::one_thread(checkpoint);
        }
        let validation = match &self.validation {
            Some(validation) => validation,
            None => self.validation.insert(Validation::new(&first.device, checkpoint)?),
        };
        validation.surrogate(checkpoint, first.training.as_deref())
    }

    /// Brings the run's weights and moments up to date.
    pub(super) fn sync(&self, state: &mut RunState) -> Result<(), TrainError> {
        let training = self.replicas.first().and_then(|replica| replica.training.as_ref());
        let Some(training) = training else { return Ok(()) };
        let [weights, first, second, average] = training.optimizer().state()?;
        state.weights = weights.into();
        let moments = first.into_iter().zip(second).zip(average);
        state.optimizer.moments =
            moments.map(|((first, second), average)| Moments { first, second, average }).collect();
        Ok(())
    }
}

impl Replica {
    /// Takes the run's weights and moments, for steps of its stage on one of `count` devices.
    fn begin(
        &mut self,
        task: &GradientTask,
        state: &RunState,
        count: usize,
    ) -> Result<(), TrainError> {
        let GradientTask { config, description, scale, .. } = task;
        // Free the memory of the previous stage first.
        self.training = None;
        let settings = settings(config, state.unroll, count);
        let particles = description.sizes.particles.unwrap_or_default();
        let weights = common_weights(scale, state.unroll, particles);
        let training = self.stores.training(&self.device, description, &settings, weights)?;
        training.set_weights(&by_name(description, &state.weights))?;
        let none = Moments::default();
        let moments = state.weights.iter().enumerate().map(|(tensor, weights)| {
            let Moments { first, second, average } =
                state.optimizer.moments.get(tensor).unwrap_or(&none);
            // The average begins at the weights.
            let average = if average.is_empty() { weights } else { average };
            [first.as_slice(), second.as_slice(), average.as_slice()]
        });
        training.optimizer().set_moments(moments)?;
        self.training = Some(training);
        Ok(())
    }

    fn run(&mut self, batches: &[Batch]) -> Result<Vec<Outcome>, TrainError> {
        let training = self.training.as_mut().expect("a stage begins before its steps");
        training.start(batches)?;
        Ok(training.outcomes(batches.len())?)
    }
}

/// The result of a step.
fn step(outcome: Outcome, learning_rate: f64, draws: &[Draw], sampler: &Sampler) -> Step {
    let Outcome { loss, gradient_norm, not_finite } = outcome;
    let windows = draws.iter().map(|draw| sampler.origin(draw)).collect();
    let gradient_norm = gradient_norm.into();
    Step { loss, learning_rate, gradient_norm, finite: !not_finite, windows }
}
