//! What the node knows of one stream.

use std::time::Duration;

use eddy_frames::{Frame, FrameView, Stamp};
use eddy_inference::engine::HiddenState;

/// Frames older than so many intervals mean that the stream started again (a looped bag).
const RESTART_INTERVALS: u32 = 16;

/// One stream: its hidden state and where it stands.
pub(super) struct StreamTrack {
    /// The model's hidden state, after the last frame or the frame it filled in.
    pub memory: HiddenState,
    /// The model's prediction from that state: the next frame.
    pub predicted: Frame,
    /// Room for a prediction that takes the place of a missing frame.
    pub spare: Frame,
    /// Sequence of the last observed frame.
    pub sequence: u64,
    /// Stamp of the last observed frame.
    pub stamp: Stamp,
    /// Frames observed since the stream began or was reset.
    pub observed: u64,
    /// When the next frame of a free run is due; `None` while frames are observed.
    pub free_run_due: Option<Duration>,
    /// The node's count of uses when the stream was used last.
    pub used: u64,
}

/// How a frame follows the stream's last one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Follows {
    /// It is the next one, or so many are missing in between.
    After {
        /// Missing frames.
        gap: u64,
    },
    /// It was there already, or comes late.
    Late,
    /// It begins the stream anew.
    Restart,
}

impl StreamTrack {
    /// How `frame` follows. A change of the particles, or a stamp more than 16 intervals in the past,
    /// begins the stream anew.
    pub(super) fn follows(&self, frame: &FrameView<'_>) -> Follows {
        let reach = Stamp(0).advance(frame.dt, RESTART_INTERVALS).0;
        let restarted = frame.stamp < Stamp(self.stamp.0.saturating_sub(reach));
        if restarted || !frame.particles.are_of(&self.predicted.material) {
            return Follows::Restart;
        }
        match frame.sequence.checked_sub(self.sequence + 1) {
            Some(gap) => Follows::After { gap },
            None => Follows::Late,
        }
    }
}
