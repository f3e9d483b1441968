//! What the trainings of both networks share.
//!
//! 1. `window`: pieces of streams. `settings`: what a step is made of, and what comes of it.
//! 2. `packing`: where tensors are in the memory of a device.
//! 3. `tables`: what changes from step to step, in the memory of the device, so that one recorded step serves all.
//! 4. `optimizer`: weights, their gradients, Adam. `muon`: Muon.
//! 5. `counter`: the memory that a training needs.

mod counter;
mod muon;
mod optimizer;
mod packing;
mod settings;
mod tables;
mod window;

use std::collections::BTreeMap;

pub(crate) use counter::{Counter, LIBRARIES};
pub use optimizer::Optimizer;
pub(crate) use packing::{Builder, Part};
pub use packing::{Matrix, Packing};
pub use settings::{Batch, Outcome, Settings};
pub use tables::Tables;
pub use window::Window;
pub(crate) use window::key;

use crate::error::Result;
use eddy_inference::checkpoint::Weights;

/// Steps whose tables fit on the device at once.
pub const GROUP: usize = 64;

/// A network that is being trained on a device.
pub trait InTraining: Send {
    /// Its weights, their gradients and moments.
    fn optimizer(&self) -> &Optimizer;

    /// What changes from step to step.
    fn tables(&self) -> &Tables;

    /// Puts the weights of a checkpoint onto the device.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call), as of all that follows.
    fn set_weights(&self, tensors: &BTreeMap<String, Weights>) -> Result<()>;

    /// Starts up to [`GROUP`] steps; [`Self::outcomes`] waits for them.
    ///
    /// # Errors
    /// As above.
    ///
    /// # Panics
    /// With more steps, or with batches of another size than the settings say.
    fn start(&mut self, batches: &[Batch]) -> Result<()>;

    /// What came of the steps started last, for the whole batch.
    ///
    /// # Errors
    /// As above.
    fn outcomes(&self, steps: usize) -> Result<Vec<Outcome>> {
        self.tables().outcomes(steps)
    }

    /// The weights as a checkpoint has them.
    ///
    /// # Errors
    /// As above.
    fn weights(&self) -> Result<BTreeMap<String, Weights>> {
        self.optimizer().weights()
    }

    /// The running average of the weights; the weights themselves where none is kept.
    ///
    /// # Errors
    /// As above.
    fn average(&self) -> Result<BTreeMap<String, Weights>> {
        self.optimizer().average()
    }

    /// The gradient of the last step, before any tensor of it was shortened.
    ///
    /// # Errors
    /// As above.
    fn gradients(&self) -> Result<BTreeMap<String, Weights>> {
        self.optimizer().gradients()
    }
}
