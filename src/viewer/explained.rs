//! Predictions that come as messages, joined with the messages that say how each came to be.

use std::collections::VecDeque;

use super::Ahead;
use crate::{
    frame::{Frame, Stamp},
    msg::{PredictionStatus, StreamState},
};

/// Predictions that wait for their status, at most: a horizon of which every frame is published.
const WAITING: usize = 128;

impl From<&PredictionStatus> for Ahead {
    fn from(status: &PredictionStatus) -> Self {
        Self {
            source: status.source_sequence,
            frames: status.horizon,
            free: status.state == StreamState::FreeRunning as u8,
        }
    }
}

/// Joins both topics of predictions, of which each keeps its order.
#[derive(Debug, Default)]
pub struct Explained {
    waiting: VecDeque<Frame>,
}

impl Explained {
    /// A prediction, which waits for its status. One of which nobody has spoken for too long is forgotten.
    pub fn prediction(&mut self, frame: Frame) {
        if self.waiting.len() == WAITING {
            self.waiting.pop_front();
        }
        self.waiting.push_back(frame);
    }

    /// The oldest prediction that this speaks of, with how it came to be.
    pub fn status(&mut self, status: &PredictionStatus) -> Option<(Frame, Ahead)> {
        let stamp = Stamp::from(status.header.stamp);
        let meant = |frame: &Frame| (frame.stream, frame.stamp) == (status.stream, stamp);
        let frame = self.waiting.remove(self.waiting.iter().position(meant)?)?;
        Some((frame, status.into()))
    }

    /// Nobody waits any more.
    pub fn clear(&mut self) {
        self.waiting.clear();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{frame::Domain, msg::Header};

    fn frame(stream: u64, stamp: i64, sequence: u64) -> Frame {
        Frame {
            stream,
            sequence,
            stamp: Stamp(stamp),
            dt: 0.016,
            domain: Domain::UNIT,
            position: Vec::new(),
            velocity: Vec::new(),
            material: Vec::new(),
        }
    }

    fn status(stream: u64, stamp: i64, horizon: u32) -> PredictionStatus {
        let header = Header { stamp: Stamp(stamp).into(), ..Header::default() };
        PredictionStatus { header, stream, horizon, ..PredictionStatus::default() }
    }

    #[test]
    fn a_status_is_of_its_own_prediction_and_of_the_oldest_of_an_instant() {
        let mut explained = Explained::default();
        for (number, (stream, stamp)) in (0..).zip([(1, 10), (2, 10), (1, 20), (1, 10)]) {
            explained.prediction(frame(stream, stamp, number));
        }
        let mut joined = |stream, stamp, horizon| {
            let found = explained.status(&status(stream, stamp, horizon));
            found.map(|(frame, ahead)| (frame.sequence, ahead.frames))
        };
        assert_eq!(joined(1, 20, 3), Some((2, 3)));
        assert_eq!(joined(1, 10, 2), Some((0, 2)));
        assert_eq!(joined(1, 10, 1), Some((3, 1)));
        assert_eq!(joined(1, 10, 1), None);
        assert_eq!(joined(2, 10, 1), Some((1, 1)));
    }

    #[test]
    fn what_nobody_explains_does_not_wait_for_ever() {
        let mut explained = Explained::default();
        for number in 0..=WAITING as u64 {
            explained.prediction(frame(1, number as i64, number));
        }
        assert_eq!(explained.status(&status(1, 0, 1)), None);
        assert_eq!(explained.status(&status(1, 1, 1)).map(|(frame, _)| frame.sequence), Some(1));
    }
}
