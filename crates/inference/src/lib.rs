//! Predicts particle frames from a checkpoint, one frame of a stream at a time, with one hidden state per stream.
//!
//! 1. [`checkpoint`]: weights and description of a network as files.
//! 2. [`kernels`]: vectorised kernels and their adjoints, for prediction and training.
//! 3. [`ops`]: the operations of the networks, on processors and GPUs.
//! 4. [`engine`]: runs a checkpoint's network and its rules.
//! 5. [`error_model`]: how far its predictions are expected to be off.

pub mod checkpoint;
pub mod engine;
pub mod error_model;
pub mod kernels;
pub mod ops;

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
