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

    use eddy_cuda::{
        CudaError, frame,
        gpu::{Gpu, Precision},
        kernels::{self, Program},
        particle,
    };
    use eddy_inference::{checkpoint::Architecture, engine::Accelerator};
    let Checkpoint { description, tensors } = checkpoint;
    let gpu = |program: &dyn Program| {
        let cache = eddy_learning::model::kernel_cache();
        Gpu::new(number, program, Precision::Fp32, cache.as_deref()).map(Arc::new)
    };
    let streams = || -> Result<Arc<dyn Accelerator>, CudaError> {
        Ok(match description.architecture {
            Architecture::Frame => {
                let gpu = gpu(&kernels::Constants::of(description)?)?;
                let mut inference = frame::Inference::new(gpu, description, tensors)?;
                if let Some(threads) = threads {
                    inference = inference.with_threads(threads);
                }
                Arc::new(frame::Streams::new(inference))
            }
            Architecture::Particle => {
                let gpu = gpu(&particle::Constants::of(description)?)?;
                let mut inference = particle::Inference::new(gpu, description, tensors)?;
                if let Some(threads) = threads {
                    inference = inference.with_threads(threads);
                }
                Arc::new(particle::Streams::new(inference))
            }
        })
    };
    let streams = streams().map_err(|reason| ModelError::Device(reason.to_string()))?;
    Surrogate::on_device(checkpoint, streams)
}
