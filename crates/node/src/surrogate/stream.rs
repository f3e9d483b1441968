//! The state that the node keeps of one stream.

use std::time::Duration;

use eddy_frames::{Frame, FrameView, Stamp};
use eddy_inference::{
    engine::HiddenState,
    error_model::{ErrorEstimate, ErrorModel, ErrorTracker},
};

pub(super) struct StreamState {
    /// Hidden state of the model after the last frame, observed or filled in.
    pub memory: HiddenState,
    /// The next frame, predicted from that state.
    pub predicted: Frame,
    /// Scratch frame for a prediction that replaces a missing frame.
    pub spare: Frame,
    /// What errors are estimated from, if the model is calibrated.
    pub error_tracker: Option<ErrorTracker>,
    /// Sequence of the last observed frame.
    pub sequence: u64,
    /// Stamp of the last observed frame.
    pub stamp: Stamp,
    /// Frames observed since the stream started or was reset.
    pub observed: u64,
    /// When the next frame of a free run is due (node time); `None` while frames are observed.
    pub free_run_due: Option<Duration>,
    /// Value of the node's use counter at the last use, for eviction.
    pub used: u64,
}

/// How a frame relates to the last one of its stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Order {
    /// The next frame, after `gap` missing ones.
    Next { gap: u64 },
    /// A duplicate, or one that arrived after a later frame.
    Late,
    /// The first frame of a restarted stream.
    Restart,
}

/// How far off a prediction `horizon` frames after the last observed one is expected to be, if the model is calibrated for it.
pub(super) fn expected_error(
    tracker: &mut Option<ErrorTracker>,
    model: Option<&ErrorModel>,
    predicted: &Frame,
    horizon: u32,
) -> Option<ErrorEstimate> {
    tracker.as_mut()?.estimate(model?, predicted, horizon)
}

impl StreamState {
    /// How `frame` relates to the last one. Different particles, another domain, or a stamp far in the
    /// past, restart the stream.
    pub(super) fn order(&self, frame: &FrameView<'_>) -> Order {
        let restarted = self.stamp.restarts_at(frame.stamp, frame.dt);
        let same = frame.domain == self.predicted.domain
            && frame.particles.are_of(&self.predicted.material);
        if restarted || !same {
            return Order::Restart;
        }
        match frame.sequence.checked_sub(self.sequence + 1) {
            Some(gap) => Order::Next { gap },
            None => Order::Late,
        }
    }
}
