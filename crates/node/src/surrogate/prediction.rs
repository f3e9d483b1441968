//! A prediction, and its status message.

use std::time::Duration;

use eddy_frames::Frame;
use eddy_inference::error_model::ErrorEstimate;
use eddy_messages::{Header, PredictionStatus, StreamState as Phase};

/// A predicted frame and where it comes from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction<'a> {
    /// The predicted frame, with sequence and stamp of the predicted instant.
    pub frame: &'a Frame,
    /// Sequence of the last observed frame.
    pub source_sequence: u64,
    /// Frames from that one to the predicted one.
    pub horizon: u32,
    /// Whether the stream is observed or in a free run.
    pub state: Phase,
    /// How far off it is expected to be, if the model is calibrated for such a horizon.
    pub expected_error: Option<ErrorEstimate>,
}

impl Prediction<'_> {
    /// Fills the status message of this prediction; `status` is reused to save allocations.
    pub fn status(&self, latency: Duration, model: &str, status: &mut PredictionStatus) {
        let Header { stamp, frame_id } = &mut status.header;
        *stamp = self.frame.stamp.into();
        "world".clone_into(frame_id);
        status.stream = self.frame.stream;
        status.source_sequence = self.source_sequence;
        status.horizon = self.horizon;
        status.state = self.state as u8;
        status.latency = latency.as_secs_f32();
        model.clone_into(&mut status.model);
    }
}
