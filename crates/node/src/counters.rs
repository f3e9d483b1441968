//! Everything that was not used, and why.

use std::collections::BTreeMap;

use eddy_frames::InvalidFrame;
use eddy_inference::engine::ModelError;
use eddy_messages::BadFrame;

/// Why a frame was not used.
#[derive(Debug, thiserror::Error)]
pub enum Refusal {
    /// It is no whole frame.
    #[error(transparent)]
    Bad(#[from] BadFrame),
    /// The model cannot predict such a frame.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// It came a second time, or after a later one.
    #[error("stream {stream}: sequence: found {found}, expected at least {expected}")]
    Late {
        /// The stream.
        stream: u64,
        /// The frame's sequence number.
        found: u64,
        /// The next sequence number of the stream.
        expected: u64,
    },
    /// The stream simulates itself by now.
    #[error(
        "stream {stream}: found sequence {found}, expected no more frames: the stream runs free"
    )]
    FreeRunning {
        /// The stream.
        stream: u64,
        /// The frame's sequence number.
        found: u64,
    },
}

/// Counts since the start of the node.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames that arrived.
    pub received: u64,
    /// Predictions that were published.
    pub published: u64,
    /// Bytes that are no `ParticleFrame`.
    pub undecodable: u64,
    /// Frames with unequal lengths, unknown materials, another dimension or an empty domain.
    pub malformed: u64,
    /// Frames with a NaN or an infinity.
    pub not_finite: u64,
    /// Frames whose `dt` is not the checkpoint's.
    pub wrong_interval: u64,
    /// Frames whose particles or domain do not fit the model.
    pub wrong_particles: u64,
    /// Duplicates and frames that came late.
    pub late: u64,
    /// Frames of a stream that runs free.
    pub ignored_in_free_run: u64,
    /// Frames that were missing and filled with a prediction.
    pub filled: u64,
    /// Frames that were missing in gaps too large to fill.
    pub missing: u64,
    /// Streams that were set back to their warm-up.
    pub resets: u64,
    /// Streams that made room for others.
    pub evicted_streams: u64,
    /// Frames that were dropped because the node was slow.
    pub dropped_from_queue: u64,
    /// Of them, those of each stream that lost any (of the first 1,024 such streams).
    pub dropped_by_stream: BTreeMap<u64, u64>,
    /// Messages that the transport had to give up before they reached the node.
    pub lost_in_transport: u64,
    /// Predictions that were not finite, and not published.
    pub diverged: u64,
    /// Predictions that an output could not take.
    pub unpublished: u64,
}

impl Counters {
    /// Counts one refusal.
    pub fn refuse(&mut self, refusal: &Refusal) {
        let counter = match refusal {
            Refusal::Bad(BadFrame::Cdr(_)) => &mut self.undecodable,
            Refusal::Bad(BadFrame::Invalid(InvalidFrame::NotFinite { .. })) => &mut self.not_finite,
            Refusal::Bad(BadFrame::Invalid(_)) => &mut self.malformed,
            Refusal::Model(ModelError::Interval { .. }) => &mut self.wrong_interval,
            Refusal::Model(_) => &mut self.wrong_particles,
            Refusal::Late { .. } => &mut self.late,
            Refusal::FreeRunning { .. } => &mut self.ignored_in_free_run,
        };
        *counter += 1;
    }

    /// Every counter with its name, in the order of the fields.
    pub fn named(&self) -> [(&'static str, u64); 17] {
        [
            ("received", self.received),
            ("published", self.published),
            ("undecodable", self.undecodable),
            ("malformed", self.malformed),
            ("not_finite", self.not_finite),
            ("wrong_interval", self.wrong_interval),
            ("wrong_particles", self.wrong_particles),
            ("late", self.late),
            ("ignored_in_free_run", self.ignored_in_free_run),
            ("filled", self.filled),
            ("missing", self.missing),
            ("resets", self.resets),
            ("evicted_streams", self.evicted_streams),
            ("dropped_from_queue", self.dropped_from_queue),
            ("lost_in_transport", self.lost_in_transport),
            ("diverged", self.diverged),
            ("unpublished", self.unpublished),
        ]
    }

    /// Frames that could not be used through their own fault.
    pub fn bad(&self) -> u64 {
        self.undecodable
            + self.malformed
            + self.not_finite
            + self.wrong_interval
            + self.wrong_particles
    }

    /// Frames that streams lost before the model saw them, none of them twice: a frame that the transport or the queue
    /// gave up is a gap in its stream, too, so it is the larger of the two counts. Duplicates, frames that came too late
    /// for their gap, and predictions that did not leave are not among them.
    pub fn frames_lost(&self) -> u64 {
        let gaps = self.filled.saturating_add(self.missing);
        gaps.max(self.dropped_from_queue.saturating_add(self.lost_in_transport))
    }

    /// Grows whenever a frame did not arrive, or not in time, or a prediction did not leave. One loss may count twice:
    /// as what dropped it, and as the gap that it left.
    pub fn lost(&self) -> u64 {
        [self.late, self.missing, self.filled, self.dropped_from_queue, self.lost_in_transport]
            .into_iter()
            .fold(self.unpublished, u64::saturating_add)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_that_was_dropped_and_left_a_gap_is_lost_once() {
        let dropped = Counters { dropped_from_queue: 3, ..Counters::default() };
        assert_eq!(dropped.frames_lost(), 3, "before its stream goes on");
        let gap = Counters { filled: 1, missing: 2, ..dropped };
        assert_eq!(gap.frames_lost(), 3);
        let elsewhere = Counters { missing: 9, ..gap };
        assert_eq!(elsewhere.frames_lost(), 10, "those that nobody dropped here");
        let late = Counters { late: 5, unpublished: 5, ..elsewhere };
        assert_eq!(late.frames_lost(), 10);
    }
}
