//! Tables of what this machine carries.
//!
//! 1. [`solver`]: time of a substep by particles and threads.
//! 2. [`training`]: time of a training step by core and length of the window.
//! 3. [`limit`]: what the processor and its memory would allow.

pub mod limit;
pub mod solver;
pub mod training;
