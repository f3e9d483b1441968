//! Tools that measure and study eddy.
//!
//! 1. [`mod@bench`]: what `eddy bench` measures.
//! 2. [`study`]: the paper's comparisons.
//! 3. [`plans`]: data sets and comparisons as tasks for several machines.
//! 4. [`commands`]: arguments and tables of `eddy bench`, `eddy study` and `eddy plan`.
//! 5. [`fuzzing`]: one function per kind of external input.

pub mod bench;
pub mod commands;
pub mod fuzzing;
pub mod plans;
pub mod study;

/// Compiles and runs the example of the README.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
