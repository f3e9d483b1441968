//! Numbers in vectors: what training and streaming both compute with.
//!
//! Written once for every set of vector instructions (crate `pulp`), which is chosen while the program
//! runs. A function here takes the set as its first argument and has to be inlined into one that was
//! compiled for it: only so the compiler uses the instructions.
//!
//! 1. [`math`]: exponential, sigmoid, hyperbolic tangent, ELU.
//! 2. [`vectors`]: the same work on every number of several lists.
//! 3. [`activation`]: the networks' activations with their slopes.
//!
//! Values and gradients of whole layers, for training:
//!
//! 4. [`linear`]: a linear layer; [`matrix`] has the products of large matrices, [`narrow`] those with
//!    matrices of few columns.
//! 5. [`encoder`]: particles through a linear layer and an activation to their mean.
//! 6. [`minimal`]: minGRU and minLSTM over all frames, from their linear parts.
//! 7. [`gru`], [`lstm`]: frame by frame, with recurrent weights that are [`packed`].
//!
//! The particles' grid, for both:
//!
//! 8. [`nodes`]: the sparse grid that particles touch, at three cell widths.
//! 9. [`transfer`]: from particles to nodes and back.
//! 10. [`gathered`]: convolutions on nodes.
//! 11. [`rest_shape`]: strain and bend of bodies that keep their shape.
//! 12. [`spacing`]: how far apart particles are.

pub mod activation;
pub mod encoder;
pub mod gathered;
pub mod gru;
pub mod linear;
pub mod lstm;
pub mod math;
pub mod matrix;
pub mod minimal;
pub mod narrow;
pub mod nodes;
pub mod packed;
pub mod rest_shape;
pub mod spacing;
pub mod transfer;
pub mod vectors;
