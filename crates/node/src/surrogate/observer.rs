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

    /// Once a second.
    fn reported(&mut self, report: &NodeReport<'_>);
}

/// The state of a node.
#[derive(Clone, Copy, Debug)]
pub struct NodeReport<'a> {
    /// Rate and latency since the last report.
    pub rates: Rates,
    /// Counts since the node started.
    pub counters: &'a Counters,
    /// Number of streams that it keeps.
    pub streams: usize,
    /// Why frames were rejected since the last report: the last reason.
    pub rejected: Option<&'a str>,
    /// How streams differ from what the model was trained on: the stream and a sentence.
    pub warnings: &'a [(u64, String)],
}
