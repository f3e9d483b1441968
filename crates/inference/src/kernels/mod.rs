//! Vectorised building blocks, for training and for streaming.
//!
//! They are written once for all SIMD instruction sets (crate `pulp`), of which one is selected at run time. A function that
//! takes the set as its first argument must be inlined into one that is compiled for that set; otherwise the compiler does
//! not use its instructions.
//!
//! 1. [`math`]: exponential, sigmoid, hyperbolic tangent, ELU.
//! 2. [`vectors`]: elementwise operations on several lists.
//! 3. [`activation`]: the networks' activation functions with their derivatives.
//!
//! Values and gradients of whole layers, for training:
//!
//! 4. [`matrix`]: products of large matrices. [`narrow`]: products with matrices of few columns.
//! 5. [`encoder`]: a linear layer and an activation on particles, and the mean over them.
//! 6. [`packed`]: recurrent weights, for products frame by frame.
//!
//! The sparse grid, the rest shape and elasticity, for both:
//!
//! 7. [`nodes`]: the nodes that particles touch, at two to four cell widths.
//! 8. [`rest_shape`]: strain and bend of jelly and rope.
//! 9. [`lattice`]: jelly as an elastic continuum.
//! 10. [`spacing`]: the distance between neighbouring particles.

pub mod activation;
pub mod encoder;
pub mod lattice;
pub mod math;
pub mod matrix;
pub mod narrow;
pub mod nodes;
pub mod packed;
pub mod rest_shape;
pub mod spacing;
pub mod vectors;
