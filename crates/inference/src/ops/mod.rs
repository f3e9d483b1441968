//! The operations of the networks. A folder has all of one operation but its definitions in burn and PyTorch: what it
//! computes, on processors with its gradient, on GPUs with its gradient, its tests.
//!
//! 1. [`cell`]: a layer of the core, from the outputs of its linear layers.
//! 2. [`linear`]: a linear layer.
//! 3. [`decoder`]: from the decoder's outputs to the next state, with [`ballistic`]: free fall between walls.
//! 4. [`rules`]: physical laws that correct predictions.

pub mod ballistic;
pub mod cell;
pub mod decoder;
pub mod linear;
pub mod rules;
