//! The particle model on a device.
//!
//! 1. `layout`: the constants of its kernels, and where its tensors are.
//! 2. `stream`: what is remembered of a stream, and its scratch memory in a step.
//! 3. `inference`: streams, frame by frame. `node_layers`: layers on nodes, for both.
//! 4. `training`: training steps. [`footprint`]: the memory that they need.

pub mod footprint;
mod inference;
mod lattice;
mod layout;
mod node_layers;
mod stream;
mod training;

pub use inference::{Inference, MOST_STREAMS, Streams};
pub use layout::{Constants, Layout};
pub use training::{Store, StoreWriter, Training, TrainingConstants};
