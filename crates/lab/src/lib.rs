//! Tools that measure and study eddy.
//!
//! 1. [`mod@bench`]: what `eddy bench` measures.
//! 2. [`study`]: the paper's comparisons.
//! 3. [`plans`]: data sets and comparisons as tasks for several machines.
//! 4. [`commands`]: arguments and tables of `eddy bench`, `eddy study` and `eddy plan`.

pub mod bench;
pub mod commands;
pub mod plans;
pub mod study;
