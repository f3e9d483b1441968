//! The networks for streaming: one frame of a stream at a time.
//!
//! 1. [`scales`]: units of the particle model's inputs and outputs. [`Ballistic`]: the motion of a particle that touches
//!    nothing.
//! 2. The operations ([`ops`](crate::ops)) have layers, transfers, cells, the step from the decoder's outputs, and the rules.
//! 3. `core`: the layers of the five recurrent cores.
//! 4. `hidden_state`: what a network remembers of a stream, and the `order` of its particles in memory.
//! 5. `encoder`: the frame model's pointwise encoder, fused with its pooling. `frame_model`: the paper's network
//!    (Table 1), whose outputs [`Decoded`](crate::ops::decoder::Decoded) turns into states.
//! 6. `particle_model`: one hidden state per particle, and the stages of a frame. `particle_blocks`
//!    has those on particles, and sums them on the nodes of the `grid`; `merged` combines layers that have no activation between
//!    them.
//! 7. The rules ([`ops::rules`](crate::ops::rules)) correct a prediction; [`Corrector`] applies them after any predictor.
//! 8. [`fits()`]: which frames a network can predict. [`Warning`]: what a stream states compared with what a network was trained on.
//! 9. [`Surrogate`]: a checkpoint's packed network; [`Stepper`]: the threads ([`eddy_threads`]) and buffers that run it,
//!    or the [`Accelerator`].
//!
//! SIMD instructions are selected at run time (crate `pulp`). After a stream's first frame nothing is allocated
//! (`tests/allocation.rs` counts). The equations are those of the networks in burn (`eddy-learning`), which give the same
//! predictions within 1e-5; a property test there compares the two.
//!
//! Letters in shapes: `N` particles, `F` input features, `E` encoder width, `H` hidden width, `C0`, `C1`, .. channels
//! of the grid's levels.

mod accelerator;
mod baseline;
mod core;
mod encoder;
mod error;
mod fits;
mod frame_model;
mod grid;
mod hidden_state;
mod merged;
mod order;
mod particle_blocks;
mod particle_model;
pub mod scales;
mod stepper;
mod surrogate;
mod warning;

#[cfg(test)]
mod tests;

pub use crate::ops::{
    ballistic::Ballistic,
    rules::{Corrector, elastic::lattices},
};
pub use accelerator::{Accelerator, DeviceState, DeviceStep, Precision, StreamStart};
pub use baseline::Baseline;
pub use error::ModelError;
pub use fits::fits;
pub use hidden_state::HiddenState;
pub use stepper::{StepRequest, Stepper};
pub use surrogate::Surrogate;
pub use warning::{Stated, StreamSetup, Warning, WarningCounts, warnings};
