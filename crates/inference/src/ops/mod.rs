//! The operations of the networks. A folder has one operation, but for its definitions in burn and PyTorch: what it
//! computes, on processors and on GPUs, with the gradients that training needs there, and its tests. Forms that are fused with
//! others stay with these; the folder names them.
//!
//! 1. [`features`]: the inputs of the networks.
//! 2. [`node_inputs`]: the inputs of the nodes of the grid.
//! 3. [`cell`]: a layer of the core, from the outputs of its linear layers.
//! 4. [`linear`]: a linear layer.
//! 5. [`decoder`]: from the decoder's outputs to the next state, with [`ballistic`]: free fall between walls.
//! 6. [`rules`]: physical laws that correct predictions.

pub mod ballistic;
pub mod cell;
pub mod decoder;
pub mod features;
pub mod linear;
pub mod node_inputs;
pub mod rules;
