//! Streaming prediction of particle frames: a checkpoint in, the next frame out, one hidden state a stream.
//!
//! 1. [`checkpoint`]: the weights and what a network is, as files.
//! 2. [`kernels`]: vectorised building blocks, forward and adjoint, for streaming and for training.
//! 3. [`engine`]: a checkpoint that predicts frames, one after the other.

pub mod checkpoint;
pub mod engine;
pub mod kernels;

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
