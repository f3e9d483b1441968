//! The node's output for observers within this process.

use super::{Counters, Prediction, diagnostics::Rates};
use eddy_frames::FrameView;

/// Called by the node after its own work is done. The node waits for it, so implementations copy what they need and
/// return.
pub trait Observer: Send {
    /// A frame arrived. It may be one that the node rejects.
    fn observed(&mut self, frame: &FrameView<'_>);

    /// A prediction was published.
    fn predicted(&mut self, prediction: &Prediction<'_>);

    /// Once a second: rate and latency of that second, all counters, and the number of streams.
    fn reported(&mut self, rates: &Rates, counters: &Counters, streams: usize);
}
