//! Predictions received as messages, joined with their status messages, in whichever order they arrive: a recorder
//! receives each topic on its own.

use std::collections::VecDeque;

use super::PredictionInfo;
use eddy_frames::{Frame, Stamp};
use eddy_messages::{PredictionStatus, StreamState};

/// Maximum number of predictions waiting for their status, and of statuses waiting for their prediction.
const CAPACITY: usize = 128;

impl From<&PredictionStatus> for PredictionInfo {
    fn from(status: &PredictionStatus) -> Self {
        Self {
            source: status.source_sequence,
            horizon: status.horizon,
            free_running: status.state == StreamState::FreeRunning as u8,
        }
    }
}

/// Joins a topic of predictions with its topic of statuses.
#[derive(Debug, Default)]
pub struct StatusJoiner {
    predictions: VecDeque<Frame>,
    statuses: VecDeque<PredictionStatus>,
}

impl StatusJoiner {
    /// Adds a prediction. Returns it if its status has arrived.
    pub fn prediction(&mut self, frame: Frame) -> Option<(Frame, PredictionInfo)> {
        match take(&mut self.statuses, |status| belongs_to(status, &frame)) {
            Some(status) => Some((frame, PredictionInfo::from(&status))),
            None => {
                push(&mut self.predictions, frame);
                None
            }
        }
    }

    /// Adds a status. Returns it with the oldest prediction that it belongs to, if one has arrived.
    pub fn status(&mut self, status: PredictionStatus) -> Option<(Frame, PredictionInfo)> {
        match take(&mut self.predictions, |frame| belongs_to(&status, frame)) {
            Some(frame) => Some((frame, PredictionInfo::from(&status))),
            None => {
                push(&mut self.statuses, status);
                None
            }
        }
    }

    /// Discards everything that waits.
    pub fn clear(&mut self) {
        self.predictions.clear();
        self.statuses.clear();
    }
}

fn belongs_to(status: &PredictionStatus, frame: &Frame) -> bool {
    let stamp = Stamp::from(status.header.stamp);
    (status.stream, stamp) == (frame.stream, frame.stamp)
}

/// Removes the first match.
fn take<T>(waiting: &mut VecDeque<T>, matches: impl FnMut(&T) -> bool) -> Option<T> {
    let place = waiting.iter().position(matches)?;
    waiting.remove(place)
}

/// Adds an item; a full list drops its oldest.
fn push<T>(waiting: &mut VecDeque<T>, item: T) {
    if waiting.len() == CAPACITY {
        waiting.pop_front();
    }
    waiting.push_back(item);
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

    /// Sequence of the prediction and its horizon, if joined.
    fn summary(joined: Option<(Frame, PredictionInfo)>) -> Option<(u64, u32)> {
        joined.map(|(frame, info)| (frame.sequence, info.horizon))
    }

    #[test]
    fn a_status_belongs_to_the_oldest_prediction_of_its_stream_and_instant() {
        let mut joiner = StatusJoiner::default();
        for (number, (stream, stamp)) in (0..).zip([(1, 10), (2, 10), (1, 20), (1, 10)]) {
            assert_eq!(joiner.prediction(frame(stream, stamp, number)), None);
        }
        assert_eq!(summary(joiner.status(status(1, 20, 3))), Some((2, 3)));
        assert_eq!(summary(joiner.status(status(1, 10, 2))), Some((0, 2)));
        assert_eq!(summary(joiner.status(status(1, 10, 1))), Some((3, 1)));
        assert_eq!(summary(joiner.status(status(2, 10, 1))), Some((1, 1)));
    }

    #[test]
    fn a_status_that_arrives_first_waits_for_its_prediction() {
        let mut joiner = StatusJoiner::default();
        assert_eq!(joiner.status(status(1, 10, 2)), None);
        assert_eq!(joiner.status(status(1, 10, 1)), None);
        assert_eq!(summary(joiner.prediction(frame(1, 10, 0))), Some((0, 2)));
        assert_eq!(summary(joiner.prediction(frame(1, 10, 1))), Some((1, 1)));
        assert_eq!(joiner.prediction(frame(1, 10, 2)), None);
    }

    #[test]
    fn predictions_without_a_status_are_dropped() {
        let mut joiner = StatusJoiner::default();
        for number in 0..=CAPACITY as u64 {
            joiner.prediction(frame(1, number as i64, number));
        }
        assert_eq!(joiner.status(status(1, 1, 1)).map(|(frame, _)| frame.sequence), Some(1));
        assert_eq!(joiner.status(status(1, 0, 1)), None);
        joiner.clear();
        assert_eq!(joiner.status(status(1, 2, 1)), None);
    }
}
