//! The particle model on a device.
//!
//! 1. `layout`: the constants of its kernels, and where its tensors are.
//! 2. `stream`: what is remembered of a stream, and its scratch memory in a step.
//! 3. `inference`: streams, frame by frame.

mod inference;
mod layout;
mod stream;

pub use inference::{Inference, MOST_STREAMS, Streams};
pub use layout::{Constants, Layout};
