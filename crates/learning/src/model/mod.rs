//! The networks, written in burn.
//!
//! Each step uses only those above it:
//!
//! 1. `device`: the compute devices.
//! 2. `state`: particles, trajectories and hidden states as tensors. `dropout`. `grid_context`: the sparse grid of a batch.
//! 3. Operations over tensors: `ballistic`, the motion of a particle that touches nothing; `features`, the networks' inputs, with
//!    `strain`, that of solids; `linear`; `sparse`, those on the grid; `core`, the cells, with `scan`, linear recurrences over all
//!    frames at once.
//! 4. `described`: a network without its weights.
//! 5. `definition`: the networks, operation by operation, as the [`plan`](eddy_inference::checkpoint::plan) lists them.
//! 6. `tape`: the same on plain lists, with their gradients. `recorded`: as one operation of burn, where gradients are recorded on
//!    the CPU.
//! 7. `network`: a network on a device, where one of the two computes it.
//! 8. [`mod@reference`]: a checkpoint that predicts frame by frame, for comparison with the streaming engine.
//!
//! Letters in shapes: `T` frames, `B` windows, `N` particles of a window, `R` = B N rows, `F` input features, `E` encoder
//! width, `H` hidden width, `C` channels of the grid, `M` nodes.

pub mod reference;

pub(crate) mod described;
pub(crate) mod dropout;
pub(crate) mod network;
pub(crate) mod state;

mod ballistic;
mod core;
mod definition;
mod features;
mod grid_context;
mod linear;
mod recorded;
mod scan;
mod sparse;
mod strain;
mod tape;

mod device;

pub use device::{DeviceKind, GpuOptions, NoDevice};
pub use eddy_inference::engine::Precision;
pub use reference::Reference;

pub use eddy_inference::checkpoint::{Architecture, Core};

#[cfg(test)]
mod engine_tests;
#[cfg(test)]
mod tests;
