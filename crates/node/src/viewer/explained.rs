//! Predictions that come as messages, joined with the messages that say how each came to be.
//!
//! Whichever comes first: a recorder takes down each topic on its own.

use std::collections::VecDeque;

use super::Ahead;
use eddy_frames::{Frame, Stamp};
use eddy_messages::{PredictionStatus, StreamState};

/// Predictions that wait for their status, and statuses for their prediction, at most.
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

/// Joins a topic of predictions with its topic of statuses.
#[derive(Debug, Default)]
pub struct Explained {
    predictions: VecDeque<Frame>,
    statuses: VecDeque<PredictionStatus>,
}

impl Explained {
    /// A prediction, with how it came to be if that was said before. One of which nobody speaks is forgotten.
    pub fn prediction(&mut self, frame: Frame) -> Option<(Frame, Ahead)> {
        match take(&mut self.statuses, |status| speaks_of(status, &frame)) {
            Some(status) => Some((frame, Ahead::from(&status))),
            None => {
                push(&mut self.predictions, frame);
                None
            }
        }
    }

    /// How a prediction came to be, with the oldest that this speaks of if it is there.
    pub fn status(&mut self, status: PredictionStatus) -> Option<(Frame, Ahead)> {
        match take(&mut self.predictions, |frame| speaks_of(&status, frame)) {
            Some(frame) => Some((frame, Ahead::from(&status))),
            None => {
                push(&mut self.statuses, status);
                None
            }
        }
    }

    /// Nobody waits any more.
    pub fn clear(&mut self) {
        self.predictions.clear();
        self.statuses.clear();
    }
}

fn speaks_of(status: &PredictionStatus, frame: &Frame) -> bool {
    let stamp = Stamp::from(status.header.stamp);
    (status.stream, stamp) == (frame.stream, frame.stamp)
}

/// The first that is meant.
fn take<T>(waiting: &mut VecDeque<T>, meant: impl FnMut(&T) -> bool) -> Option<T> {
    let place = waiting.iter().position(meant)?;
    waiting.remove(place)
}

/// One more; the oldest makes room.
fn push<T>(waiting: &mut VecDeque<T>, one: T) {
    if waiting.len() == WAITING {
        waiting.pop_front();
    }
    waiting.push_back(one);
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::Domain;
    use eddy_messages::Header;

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

    /// Sequence of the prediction and frames ahead of it, where both have come.
    fn told(joined: Option<(Frame, Ahead)>) -> Option<(u64, u32)> {
        joined.map(|(frame, ahead)| (frame.sequence, ahead.frames))
    }

    #[test]
    fn a_status_is_of_its_own_prediction_and_of_the_oldest_of_an_instant() {
        let mut explained = Explained::default();
        for (number, (stream, stamp)) in (0..).zip([(1, 10), (2, 10), (1, 20), (1, 10)]) {
            assert_eq!(explained.prediction(frame(stream, stamp, number)), None);
        }
        assert_eq!(told(explained.status(status(1, 20, 3))), Some((2, 3)));
        assert_eq!(told(explained.status(status(1, 10, 2))), Some((0, 2)));
        assert_eq!(told(explained.status(status(1, 10, 1))), Some((3, 1)));
        assert_eq!(told(explained.status(status(2, 10, 1))), Some((1, 1)));
    }

    #[test]
    fn a_status_that_comes_first_waits_for_its_prediction() {
        let mut explained = Explained::default();
        assert_eq!(explained.status(status(1, 10, 2)), None);
        assert_eq!(explained.status(status(1, 10, 1)), None);
        assert_eq!(told(explained.prediction(frame(1, 10, 0))), Some((0, 2)));
        assert_eq!(told(explained.prediction(frame(1, 10, 1))), Some((1, 1)));
        assert_eq!(explained.prediction(frame(1, 10, 2)), None);
    }

    #[test]
    fn what_nobody_explains_does_not_wait_for_ever() {
        let mut explained = Explained::default();
        for number in 0..=WAITING as u64 {
            explained.prediction(frame(1, number as i64, number));
        }
        assert_eq!(explained.status(status(1, 1, 1)).map(|(frame, _)| frame.sequence), Some(1));
        assert_eq!(explained.status(status(1, 0, 1)), None);
        explained.clear();
        assert_eq!(explained.status(status(1, 2, 1)), None);
    }
}
