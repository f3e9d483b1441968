//! Either network on a device: its trajectories, its training, its streams for validation.

use std::sync::Arc;

use crate::train::TrainError;
use eddy_cuda::{
    device::Device,
    frame::{self, Place},
    gpu::Precision,
    kernels::{Constants, Program},
    particle,
    training::{InTraining, Settings},
};
use eddy_dataset::Trajectory;
use eddy_inference::{
    checkpoint::{Architecture, Checkpoint, Description, WeightFormat},
    engine::{Accelerator, Surrogate, scales::stiffness_feature},
    kernels::rest_shape::RestShape,
};

/// What the kernels of a network are compiled for.
pub(in crate::train) fn program(description: &Description) -> Result<Box<dyn Program>, TrainError> {
    Ok(match description.architecture {
        Architecture::Frame => Box::new(Constants::of(description)?),
        Architecture::Particle => Box::new(particle::TrainingConstants::of(description)?),
    })
}

/// How the kernels of a network multiply: those of the particle model always with the errors of FP32.
pub(super) fn precision(description: &Description, wanted: Precision) -> Precision {
    match description.architecture {
        Architecture::Frame => wanted,
        Architecture::Particle => Precision::Fp32,
    }
}

/// Where the trajectories are to lie, for the largest of several stages; so much memory of the host is free (bytes).
pub(super) fn place(
    device: &dyn Device,
    number: usize,
    description: &Description,
    stages: &[Settings],
    streams: &[Trajectory],
    host_free: u64,
) -> Result<Place, TrainError> {
    match description.architecture {
        Architecture::Frame => {
            let frames = streams.iter().map(|stream| stream.frames).sum();
            Ok(frame::footprint::place(device, number, description, stages, frames, host_free)?)
        }
        Architecture::Particle => {
            let sizes = streams.iter().map(|stream| (stream.material.len(), stream.frames));
            let sizes: Vec<_> = sizes.collect();
            particle::footprint::check(device, number, description, stages, &sizes)?;
            Ok(Place::Device)
        }
    }
}

/// Materials by number.
fn numbers(stream: &Trajectory) -> Vec<u8> {
    stream.material.iter().map(|&material| material as u8).collect()
}

/// Calls `take` with every frame of a stream.
fn visit(
    stream: &Trajectory,
    mut take: impl FnMut(&[[f32; 4]]) -> eddy_cuda::Result<()>,
) -> Result<(), TrainError> {
    let mut outcome = Ok(());
    stream.visit(0..stream.frames, |state| {
        let pairs = state.position.iter().zip(&state.velocity);
        let bodies: Vec<_> = pairs.map(|(&[x, y], &[vx, vy])| [x, y, vx, vy]).collect();
        if outcome.is_ok() {
            outcome = take(&bodies);
        }
    })?;
    Ok(outcome?)
}

/// All frames of all streams of equally many particles, where the device reads them.
pub(in crate::train) fn store(
    device: &dyn Device,
    streams: &[Trajectory],
    place: Place,
) -> Result<frame::Store, TrainError> {
    let particles = streams.first().map_or(0, |stream| stream.material.len());
    let frames = streams.iter().map(|stream| stream.frames).sum();
    let mut store = frame::StoreWriter::new(device, particles, frames, place)?;
    for stream in streams {
        store.stream(&numbers(stream));
        visit(stream, |bodies| store.frame(bodies))?;
    }
    Ok(store.finish()?)
}

/// All frames of all streams with the rest shapes of their solids, which lie `spacing` apart at rest.
pub(in crate::train) fn particle_store(
    device: &dyn Device,
    streams: &[Trajectory],
    spacing: f32,
) -> Result<particle::Store, TrainError> {
    let counts = streams.iter().map(|stream| stream.material.len());
    let bodies = streams.iter().map(|stream| stream.material.len() * stream.frames).sum();
    let most = counts.max().unwrap_or(0);
    let mut store = particle::StoreWriter::new(device, most, bodies)?;
    for stream in streams {
        let sides = stream.domain.lower[0] + stream.domain.upper[0];
        let mirrored: Vec<_> = stream.rest.iter().map(|&[x, y]| [sides - x, y]).collect();
        let shape = |rest: &[[f32; 2]]| RestShape::new(rest, &stream.material, 1, spacing);
        let stiffness = stream.stiffness.map_or(0.0, stiffness_feature);
        store.stream(&numbers(stream), [&shape(&stream.rest), &shape(&mirrored)], stiffness);
        visit(stream, |bodies| store.frame(bodies))?;
    }
    Ok(store.finish()?)
}

/// The trajectories of a network's training on a device.
pub(super) enum Stores {
    Frame(Arc<frame::Store>),
    Particle(Arc<particle::Store>),
}

impl Stores {
    pub(super) fn new(
        device: &dyn Device,
        description: &Description,
        streams: &[Trajectory],
        place: Place,
    ) -> Result<Self, TrainError> {
        Ok(match &description.grid {
            None => Self::Frame(Arc::new(store(device, streams, place)?)),
            Some(grid) => Self::Particle(Arc::new(particle_store(device, streams, grid.spacing)?)),
        })
    }

    /// Memory for steps on them; `weights` of errors hold for all batches, or there are none.
    pub(super) fn training(
        &self,
        device: &Arc<dyn Device>,
        description: &Description,
        settings: &Settings,
        weights: Option<[f32; 4]>,
    ) -> Result<Box<dyn InTraining>, TrainError> {
        let device = Arc::clone(device);
        Ok(match self {
            Self::Frame(store) => {
                let store = Arc::clone(store);
                let training = frame::Training::new(device, store, description, settings)?;
                if let Some(weights) = weights {
                    training.set_error_weights(weights)?;
                }
                Box::new(training)
            }
            Self::Particle(store) => {
                let store = Arc::clone(store);
                Box::new(particle::Training::new(device, store, description, settings)?)
            }
        })
    }
}

/// The network for validation.
pub(super) enum Validation {
    Frame(frame::Streams),
    Particle(particle::Streams),
}

impl Validation {
    pub(super) fn new(
        device: &Arc<dyn Device>,
        Checkpoint { description, tensors, .. }: &Checkpoint,
    ) -> Result<Self, TrainError> {
        let device = Arc::clone(device);
        Ok(match description.architecture {
            Architecture::Frame => {
                let inference = frame::Inference::new(device, description, tensors)?;
                Self::Frame(frame::Streams::new(inference))
            }
            Architecture::Particle => {
                let inference = particle::Inference::new(device, description, tensors)?;
                Self::Particle(particle::Streams::new(inference))
            }
        })
    }

    /// A model with the weights of a training so far, averaged if it keeps an average: those of `checkpoint`.
    pub(super) fn surrogate(
        &self,
        checkpoint: &Checkpoint,
        training: Option<&dyn InTraining>,
    ) -> Result<Surrogate, TrainError> {
        let streams: Arc<dyn Accelerator> = match self {
            Self::Frame(streams) => {
                match training {
                    // Without a detour through the host.
                    Some(training) if checkpoint.description.weights == WeightFormat::F32 => {
                        streams.copy_weights(training)?;
                    }
                    _ => streams.set_weights(&checkpoint.tensors)?,
                }
                Arc::new(streams.clone())
            }
            Self::Particle(streams) => {
                streams.set_weights(&checkpoint.tensors)?;
                Arc::new(streams.clone())
            }
        };
        Ok(Surrogate::on_device(checkpoint, streams)?)
    }
}
