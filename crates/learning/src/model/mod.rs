//! The networks, written in burn.
//!
//! Each step uses only those above it:
//!
//! 1. `device`: the compute devices.
//! 2. `state`: particles, trajectories and hidden states as tensors. `dropout`.
//! 3. `ballistic`: the motion of a particle that touches nothing, over tensors. `features`: the networks' inputs.
//! 4. `fused`: operations whose values and gradients are computed by [`kernels`](eddy_inference::kernels) instead of tensor
//!    operations, where gradients are recorded on the CPU.
//! 5. `grid_context`: the sparse grid of a batch. `sparse`: its layers in tensor operations.
//! 6. `fused_layers`: the layers as fused operations.
//! 7. `linear`: linear layers. `strain`: the strain of solids.
//! 8. `scan`: linear recurrences over all frames at once.
//! 9. `core`: the layers of the core.
//! 10. `grid`: the layers on the grid. `layers`: all layers of a network.
//! 11. `frame_model`: the paper's network (Table 1), one hidden state per frame. `particle_model`: one hidden state per
//!     particle, a residual on the ballistic step.
//! 12. `network`: either of the two.
//! 13. [`mod@reference`]: a checkpoint that predicts frame by frame, for comparison with the streaming engine.
//!
//! Letters in shapes: `T` frames, `B` windows, `N` particles of a window, `R` = B N rows, `F` input features, `E` encoder
//! width, `H` hidden width, `C` channels of the grid, `M` nodes.

pub mod reference;

pub(crate) mod ballistic;
pub(crate) mod core;
pub(crate) mod dropout;
pub(crate) mod features;
pub(crate) mod frame_model;
pub(crate) mod fused;
pub(crate) mod fused_layers;
pub(crate) mod grid;
pub(crate) mod grid_context;
pub(crate) mod layers;
pub(crate) mod linear;
pub(crate) mod network;
pub(crate) mod particle_model;
pub(crate) mod scan;
pub(crate) mod sparse;
pub(crate) mod state;
pub(crate) mod strain;

mod device;

pub use device::{DeviceKind, GpuOptions, NoDevice};
pub use eddy_inference::engine::Precision;
pub use reference::Reference;

pub use eddy_inference::checkpoint::{Architecture, Core};

#[cfg(test)]
mod engine_tests;
#[cfg(test)]
mod tests;
