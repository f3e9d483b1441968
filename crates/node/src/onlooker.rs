//! Who looks at what a node does.

use super::{Counters, Prediction, diagnostics::Rates};
use eddy_frames::FrameView;

/// Looks on. A node tells it after its work is done, and waits for nothing: whoever looks copies what it needs, and
/// is quick about it.
pub trait Onlooker: Send {
    /// A frame arrived, used or not; it may be none that can be used.
    fn observed(&mut self, frame: &FrameView<'_>);

    /// A prediction was published.
    fn predicted(&mut self, prediction: &Prediction<'_>);

    /// Rate and latency of the last second, everything counted so far, and the streams that are kept.
    fn reported(&mut self, rates: &Rates, counters: &Counters, streams: usize);
}
