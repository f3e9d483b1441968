//! Numbers in vectors: what training and streaming both compute with.
//!
//! Written once for every set of vector instructions (crate `pulp`), which is chosen while the program
//! runs. A function here takes the set as its first argument and has to be inlined into one that was
//! compiled for it: only so the compiler uses the instructions.
//!
//! 1. [`math`]: exponential, sigmoid, hyperbolic tangent, ELU.

pub mod math;
