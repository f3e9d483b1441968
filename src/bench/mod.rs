//! Tables of what this machine carries.
//!
//! 1. [`solver`]: time of a substep by particles and threads.
//! 2. [`limit`]: what the processor and its memory would allow.

pub mod limit;
pub mod solver;
