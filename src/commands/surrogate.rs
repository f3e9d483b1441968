//! The surrogate of a command.

use std::{num::NonZeroUsize, path::Path};

use anyhow::Context;
use eddy_cli::Device;
use eddy_inference::{
    checkpoint::Checkpoint,
    engine::{ModelError, Surrogate},
};

/// The surrogate of the checkpoint at `path`, or of the shipped particle model; one thread per core by default. On a GPU, the
/// threads copy frames.
pub(super) fn load(
    path: Option<&Path>,
    threads: Option<NonZeroUsize>,
    device: Device,
) -> anyhow::Result<Surrogate> {
    let checkpoint = Checkpoint::load_or_shipped(path)?;
    let name = path.map_or("the shipped checkpoint".into(), |path| path.display().to_string());
    on_device(&checkpoint, threads, device).context(name)
}

/// The surrogate of a checkpoint.
pub(super) fn on_device(
    checkpoint: &Checkpoint,
    threads: Option<NonZeroUsize>,
    device: Device,
) -> Result<Surrogate, ModelError> {
    match device {
        Device::Cpu => Surrogate::load(checkpoint, threads),
        #[cfg(feature = "cuda")]
        Device::Cuda(number) => eddy_cuda::load_surrogate(checkpoint, threads, number.into()),
    }
}
