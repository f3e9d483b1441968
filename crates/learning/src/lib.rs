//! The networks in burn, and their training.
//!
//! 1. [`model`]: the networks as tensor operations: the reference that everything else is tested against.
//! 2. [`train`]: windows, losses, the training loop, checkpoints, resume.

pub mod model;
pub mod train;

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
