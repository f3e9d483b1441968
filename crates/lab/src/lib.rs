//! What measures and studies eddy, beside the product.
//!
//! 1. [`mod@bench`]: tables of what a machine carries.
//! 2. [`study`]: the paper's comparisons.
//! 3. [`commands`]: `eddy bench` and `eddy study`, whose arguments and tables they are.
//! 4. [`fuzzing`]: one function for each kind of bytes that arrive from outside.

pub mod bench;
pub mod commands;
pub mod fuzzing;
pub mod study;

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
