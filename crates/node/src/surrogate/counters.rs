//! Frames that were not used, and why; losses.

use std::collections::BTreeMap;

use super::GroupCounts;
use eddy_frames::InvalidFrame;
use eddy_inference::engine::ModelError;
use eddy_messages::BadFrame;

/// Why a frame was rejected.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum Rejection {
    /// It is not a valid frame.
    #[error(transparent)]
    Bad(#[from] BadFrame),
    /// The model cannot predict it.
    #[error(transparent)]
    Model(#[from] ModelError),
    /// It is a duplicate, or arrived after a later frame.
    #[error("sequence: found {found}, expected at least {expected}")]
    Late { found: u64, expected: u64 },
    /// The stream is in a free run.
    #[error("frame {found} ignored during a free run")]
    FreeRunning { found: u64 },
}

/// Counts since the node started.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Counters {
    /// Frames that arrived.
    pub received: u64,
    /// Predictions that were published.
    pub published: u64,
    /// Messages that could not be decoded as `ParticleFrame`.
    pub undecodable: u64,
    /// Frames with unequal lengths, unknown materials, the wrong dimension or an empty domain.
    pub malformed: u64,
    /// Frames with a NaN or an infinity.
    pub not_finite: u64,
    /// Frames whose `dt` is not positive or differs from the checkpoint's.
    pub wrong_interval: u64,
    /// Frames with a material, a number of particles or a domain that the model does not predict.
    pub wrong_particles: u64,
    /// Frames with particles far outside of their domain.
    pub outside_domain: u64,
    /// Frames with particles much faster than any in the model's training.
    pub too_fast: u64,
    /// Duplicates and frames that arrived late.
    pub late: u64,
    /// Frames that arrived during a free run of their stream.
    pub ignored_in_free_run: u64,
    /// Frames of free runs that were skipped: the time jumped ahead, or the model is too slow.
    pub skipped_in_free_run: u64,
    /// Missing frames that were replaced by a prediction.
    pub filled: u64,
    /// Missing frames in gaps that were too long to fill.
    pub lost_in_gaps: u64,
    /// Streams that were reset and warm up again.
    pub resets: u64,
    /// Streams that were forgotten to make room for others; they warm up again when they return.
    pub forgotten_streams: u64,
    /// Frames that were dropped because the node was too slow.
    pub lost_in_queue: u64,
    /// `lost_in_queue` by stream, for the first 1,024 streams that lost any.
    pub dropped_by_stream: BTreeMap<u64, u64>,
    /// Messages that the transport dropped before they reached the node.
    pub lost_in_transport: u64,
    /// Predictions that were not finite and therefore not published.
    pub diverged: u64,
    /// Predictions that could not be sent on an output, or not to all of its subscribers.
    pub unpublished: u64,
    /// Frames of streams that another member of the group owns.
    pub of_other_members: u64,
    /// Predictions that were not published because another member of the group may own their stream.
    pub withheld: u64,
    /// Streams that moved to another member of the group.
    pub handed_over: u64,
    /// Members and streams of the group; `None` without one.
    pub group: Option<GroupCounts>,
}

impl Counters {
    /// Counts a rejected frame. Returns the name of the counter.
    pub fn reject(&mut self, rejection: &Rejection) -> &'static str {
        let (counter, name) = match rejection {
            Rejection::Bad(BadFrame::Cdr(_)) => (&mut self.undecodable, "undecodable"),
            Rejection::Bad(BadFrame::Invalid(InvalidFrame::NotFinite { .. })) => {
                (&mut self.not_finite, "not_finite")
            }
            Rejection::Bad(BadFrame::Invalid(InvalidFrame::Interval { .. }))
            | Rejection::Model(ModelError::Interval { .. }) => {
                (&mut self.wrong_interval, "wrong_interval")
            }
            Rejection::Bad(BadFrame::Invalid(_)) => (&mut self.malformed, "malformed"),
            Rejection::Model(ModelError::Implausible(InvalidFrame::Outside { .. })) => {
                (&mut self.outside_domain, "outside_domain")
            }
            Rejection::Model(ModelError::Implausible(_) | ModelError::Fast { .. }) => {
                (&mut self.too_fast, "too_fast")
            }
            Rejection::Model(_) => (&mut self.wrong_particles, "wrong_particles"),
            Rejection::Late { .. } => (&mut self.late, "late"),
            Rejection::FreeRunning { .. } => (&mut self.ignored_in_free_run, "ignored_in_free_run"),
        };
        *counter += 1;
        name
    }

    /// Every counter with its name, in the order of the fields.
    pub fn named(&self) -> [(&'static str, u64); 23] {
        [
            ("received", self.received),
            ("published", self.published),
            ("undecodable", self.undecodable),
            ("malformed", self.malformed),
            ("not_finite", self.not_finite),
            ("wrong_interval", self.wrong_interval),
            ("wrong_particles", self.wrong_particles),
            ("outside_domain", self.outside_domain),
            ("too_fast", self.too_fast),
            ("late", self.late),
            ("ignored_in_free_run", self.ignored_in_free_run),
            ("skipped_in_free_run", self.skipped_in_free_run),
            ("filled", self.filled),
            ("lost_in_gaps", self.lost_in_gaps),
            ("resets", self.resets),
            ("forgotten_streams", self.forgotten_streams),
            ("lost_in_queue", self.lost_in_queue),
            ("lost_in_transport", self.lost_in_transport),
            ("diverged", self.diverged),
            ("unpublished", self.unpublished),
            ("of_other_members", self.of_other_members),
            ("withheld", self.withheld),
            ("handed_over", self.handed_over),
        ]
    }

    /// Frames that are invalid or do not fit the model.
    pub fn bad(&self) -> u64 {
        self.undecodable
            + self.malformed
            + self.not_finite
            + self.wrong_interval
            + self.wrong_particles
            + self.outside_domain
            + self.too_fast
    }

    /// Frames lost before the model saw them, each counted once: a frame that the transport or the queue dropped also
    /// leaves a gap in its stream, so this is the larger of the two counts. Duplicates, frames that arrived too late for
    /// their gap, and unpublished predictions are not included.
    pub fn frames_lost(&self) -> u64 {
        let gaps = self.filled.saturating_add(self.lost_in_gaps);
        gaps.max(self.lost_in_queue.saturating_add(self.lost_in_transport))
    }

    /// Grows whenever a frame is missing or late, or a prediction could not be sent. One loss may count twice: where it
    /// was dropped, and as the gap that it left.
    pub fn lost(&self) -> u64 {
        [self.late, self.lost_in_gaps, self.filled, self.lost_in_queue, self.lost_in_transport]
            .into_iter()
            .fold(self.unpublished, u64::saturating_add)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_frame_that_was_dropped_and_left_a_gap_is_lost_once() {
        let dropped = Counters { lost_in_queue: 3, ..Counters::default() };
        assert_eq!(dropped.frames_lost(), 3, "before the next frame of its stream");
        let gap = Counters { filled: 1, lost_in_gaps: 2, ..dropped };
        assert_eq!(gap.frames_lost(), 3);
        let elsewhere = Counters { lost_in_gaps: 9, ..gap };
        assert_eq!(elsewhere.frames_lost(), 10, "lost before this node");
        let late = Counters { late: 5, unpublished: 5, ..elsewhere };
        assert_eq!(late.frames_lost(), 10);
    }
}
