//! The frame model on a device.
//!
//! 1. `layout`: where its tensors are.
//! 2. `data`: trajectories on the device, windows of them.
//! 3. `training`: training steps.

mod data;
mod layout;
mod training;

pub use data::{Store, StoreWriter, Window};
pub use layout::{Layout, Matrix};
pub use training::{Batch, GROUP, Outcome, Settings, Training};
