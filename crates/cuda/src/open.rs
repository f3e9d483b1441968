//! Opens the GPUs of this machine: for a surrogate, for the solver, or for any other program.

use std::{num::NonZeroUsize, ops::Range, path::PathBuf, sync::Arc};

use eddy_inference::{
    checkpoint::{Architecture, Checkpoint},
    engine::{Accelerator, ModelError, Surrogate},
};

use crate::{
    error::Result,
    frame,
    gpu::{Gpu, Precision},
    kernels::{self, Program},
    particle,
    solver::{self, Solvers},
};

/// GPUs of a machine that can be chosen.
pub const MOST_GPUS: usize = 16;

/// The number of the GPU that a device's name means: `cuda` or `cuda:N`, N below [`MOST_GPUS`].
pub fn gpu_number(name: &str) -> Option<u8> {
    let number = match name.strip_prefix("cuda")? {
        "" => 0,
        number => number.strip_prefix(':')?.parse().ok()?,
    };
    (usize::from(number) < MOST_GPUS).then_some(number)
}

/// The GPU of this number with the kernels of a program. Compiled kernels are kept in the user's cache folder, if there is one.
///
/// # Errors
/// [`CudaError`](crate::CudaError) when the GPU or a library is not there.
pub fn open_gpu(number: usize, program: &dyn Program, precision: Precision) -> Result<Gpu> {
    Gpu::new(number, program, precision, kernel_cache().as_deref())
}

/// GPUs of these numbers that train together, as [`open_gpu`].
///
/// # Errors
/// As [`open_gpu`], and when the GPUs cannot reach each other.
pub fn open_group(
    numbers: Range<usize>,
    program: &dyn Program,
    precision: Precision,
) -> Result<Vec<Gpu>> {
    Gpu::group(numbers, program, precision, kernel_cache().as_deref())
}

/// The folder of compiled kernels.
fn kernel_cache() -> Option<PathBuf> {
    Some(dirs::cache_dir()?.join("eddy").join("kernels"))
}

/// The MPM solver on the GPU of this number.
///
/// # Errors
/// As [`open_gpu`].
pub fn open_solver(number: usize) -> Result<Solvers> {
    let gpu = open_gpu(number, &solver::Constants, Precision::Fp32)?;
    Ok(Solvers::new(Arc::new(gpu), number))
}

/// A checkpoint on the GPU of this number, all products in FP32, with so many threads that copy frames to it and back, by default one
/// per core.
///
/// # Errors
/// [`ModelError`] of the checkpoint, or [`ModelError::Device`].
pub fn load_surrogate(
    checkpoint: &Checkpoint,
    threads: Option<NonZeroUsize>,
    number: usize,
) -> std::result::Result<Surrogate, ModelError> {
    let open = move |Checkpoint { description, tensors, .. }: &Checkpoint| {
        let open = |program: &dyn Program| open_gpu(number, program, Precision::Fp32).map(Arc::new);
        let streams = || -> Result<Arc<dyn Accelerator>> {
            Ok(match description.architecture {
                Architecture::Frame => {
                    let gpu = open(&kernels::Constants::of(description)?)?;
                    let inference = frame::Inference::new(gpu, description, tensors)?;
                    Arc::new(frame::Streams::new(inference.with_threads(threads)))
                }
                Architecture::Particle => {
                    let gpu = open(&particle::Constants::of(description)?)?;
                    let inference = particle::Inference::new(gpu, description, tensors)?;
                    Arc::new(particle::Streams::new(inference.with_threads(threads)))
                }
            })
        };
        streams().map_err(|reason| ModelError::Device(reason.to_string()))
    };
    Surrogate::on_devices(checkpoint, open)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_gpu_has_a_name() {
        for (name, number) in [("cuda", Some(0)), ("cuda:0", Some(0)), ("cuda:15", Some(15))] {
            assert_eq!(gpu_number(name), number, "{name}");
        }
        for name in ["cuda:16", "cuda:", "cuda1", "cuda:-1", "flex"] {
            assert_eq!(gpu_number(name), None, "{name}");
        }
    }
}
