//! The frame model on a device.
//!
//! 1. `layout`: where its tensors are.
//! 2. `data`: trajectories on the device or in the memory of the host.
//! 3. `training`: training steps.
//! 4. `stream`: what is remembered of a stream. `inference`: streams, frame by frame.
//! 5. `maximum`: the pooling by the maximum.
//! 6. [`footprint`]: the memory that a training needs.

mod data;
pub mod footprint;
mod inference;
mod layout;
mod maximum;
mod stream;
mod training;

pub use data::{Place, Store, StoreWriter};
pub use inference::{Inference, MOST_STREAMS, Streams};
pub use layout::Layout;
pub use training::Training;
