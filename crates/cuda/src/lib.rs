//! eddy's networks and its solver on NVIDIA GPUs.
//!
//! 1. [`device`]: what the networks need of a device; [`gpu`] is one; tests have another, that of the
//!    crate `eddy-cuda-emulator`.
//! 2. [`kernels`]: the kernels' text and the constants they are compiled for.
//! 3. [`open_gpu`], [`open_solver`], [`load_surrogate`] open the GPUs of this machine.
//! 4. [`training`]: what trainings share. [`frame`]: the frame model. [`particle`]: the particle model. [`dense`]: the small network of the comparison of
//!    activations. [`solver`]: the MPM solver.
//!
//! No CUDA toolkit is needed to build: the driver, NVRTC and cuBLASLt are loaded at run time.

pub mod dense;
pub mod device;
pub mod frame;
pub mod gpu;
pub mod kernels;
pub mod particle;
pub mod solver;
pub mod training;

mod error;
mod graphs;
mod open;
mod streams;

pub use error::{CudaError, Result};
pub use open::{MOST_GPUS, gpu_number, load_surrogate, open_gpu, open_group, open_solver};

/// The example of the README, run as a test.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
