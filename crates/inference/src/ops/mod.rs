//! The operations of the networks. A folder has one operation, but for its definitions in burn and PyTorch: what it
//! computes, on processors and on GPUs, with the gradients that training needs there, and its tests. Forms that are fused with
//! others stay with these; the folder names them.
//!
//! 1. [`features`]: the inputs of the networks.
//! 2. [`linear`]: a linear layer.
//! 3. [`transfer`]: sums from particles to the nodes of the grid, and from nodes to particles.
//! 4. [`node_inputs`]: the inputs of the nodes.
//! 5. [`convolution`]: a layer on nodes.
//! 6. [`cell`]: a layer of the core, from the outputs of its linear layers.
//! 7. [`decoder`]: from the decoder's outputs to the next state, with [`ballistic`]: free fall between walls.
//! 8. [`rules`]: physical laws that correct predictions.

pub mod ballistic;
pub mod cell;
pub mod convolution;
pub mod decoder;
pub mod features;
pub mod linear;
pub mod node_inputs;
pub mod rules;
pub mod transfer;
