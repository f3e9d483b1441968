//! The surrogate of a command.

use std::{num::NonZeroUsize, path::Path};

use anyhow::Context;
use eddy_inference::{
    checkpoint::Checkpoint,
    engine::{ModelError, Surrogate},
};

use crate::cli::ComputeDevice;

/// The surrogate of the checkpoint at `path`, or of the shipped particle model; one thread per core by default. On a GPU, the
/// threads copy frames.
pub(super) fn load(
    path: Option<&Path>,
    threads: Option<NonZeroUsize>,
    device: ComputeDevice,
) -> anyhow::Result<Surrogate> {
    let checkpoint = Checkpoint::load_or_shipped(path)?;
    let name = path.map_or("the shipped checkpoint".into(), |path| path.display().to_string());
    on_device(&checkpoint, threads, device).context(name)
}

/// The surrogate of a checkpoint.
pub(super) fn on_device(
    checkpoint: &Checkpoint,
    threads: Option<NonZeroUsize>,
    device: ComputeDevice,
) -> Result<Surrogate, ModelError> {
    match device {
        ComputeDevice::Cpu => Surrogate::load(checkpoint, threads),
        #[cfg(feature = "cuda")]
        ComputeDevice::Cuda(number) => on_gpu(checkpoint, threads, number.into()),
    }
}

#[cfg(feature = "cuda")]
fn on_gpu(
    checkpoint: &Checkpoint,
    threads: Option<NonZeroUsize>,
    number: usize,
) -> Result<Surrogate, ModelError> {
    use std::sync::Arc;

    use eddy_cuda::{frame, kernels, particle};
    use eddy_inference::{checkpoint::Architecture, engine::Accelerator};

    use super::devices::open_gpu;
    let Checkpoint { description, tensors } = checkpoint;
    let streams = || -> eddy_cuda::Result<Arc<dyn Accelerator>> {
        Ok(match description.architecture {
            Architecture::Frame => {
                let gpu = open_gpu(number, &kernels::Constants::of(description)?)?;
                let inference = frame::Inference::new(gpu, description, tensors)?;
                Arc::new(frame::Streams::new(inference.with_threads(threads)))
            }
            Architecture::Particle => {
                let gpu = open_gpu(number, &particle::Constants::of(description)?)?;
                let inference = particle::Inference::new(gpu, description, tensors)?;
                Arc::new(particle::Streams::new(inference.with_threads(threads)))
            }
        })
    };
    let streams = streams().map_err(|reason| ModelError::Device(reason.to_string()))?;
    Surrogate::on_device(checkpoint, streams)
}
