//! The surrogate of a command.

use std::{num::NonZeroUsize, path::Path};

use anyhow::Context;
use eddy_inference::{
    checkpoint::Checkpoint,
    engine::{ModelError, Surrogate},
};

use crate::cli::PredictionDevice;

/// The surrogate of the checkpoint at `path`, or of the shipped particle model; one thread per core by default.
pub(super) fn load(
    path: Option<&Path>,
    threads: Option<NonZeroUsize>,
    device: PredictionDevice,
) -> anyhow::Result<Surrogate> {
    let checkpoint = Checkpoint::load_or_shipped(path)?;
    let name = path.map_or("the shipped checkpoint".into(), |path| path.display().to_string());
    on_device(&checkpoint, threads, device).context(name)
}

/// The surrogate of a checkpoint.
pub(super) fn on_device(
    checkpoint: &Checkpoint,
    threads: Option<NonZeroUsize>,
    device: PredictionDevice,
) -> Result<Surrogate, ModelError> {
    match device {
        PredictionDevice::Cpu => Surrogate::load(checkpoint, threads),
        #[cfg(feature = "cuda")]
        PredictionDevice::Cuda(number) => on_gpu(checkpoint, number.into()),
    }
}

#[cfg(feature = "cuda")]
fn on_gpu(checkpoint: &Checkpoint, number: usize) -> Result<Surrogate, ModelError> {
    use eddy_cuda::{
        CudaError,
        frame::{Inference, Streams},
        gpu::{Gpu, Precision},
        kernels::Constants,
    };
    let Checkpoint { description, tensors } = checkpoint;
    let streams = || -> Result<Streams, CudaError> {
        let constants = Constants::of(description)?;
        let cache = eddy_learning::model::kernel_cache();
        let gpu = Gpu::new(number, &constants, Precision::Fp32, cache.as_deref())?;
        Ok(Streams::new(Inference::new(std::sync::Arc::new(gpu), description, tensors)?))
    };
    let streams = streams().map_err(|reason| ModelError::Device(reason.to_string()))?;
    Surrogate::on_device(checkpoint, std::sync::Arc::new(streams))
}
