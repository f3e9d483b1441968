//! The operations of the networks. A folder has all of one operation but its definitions in burn and PyTorch: what it
//! computes, on processors with its gradient, on GPUs with its gradient, its tests.
//!
//! 1. [`cell`]: a layer of the core, from the outputs of its linear layers.
//! 2. [`ballistic`]: the motion that predictions are corrections of.
//! 3. [`rules`]: physical laws that correct predictions.

pub mod ballistic;
pub mod cell;
pub mod rules;
