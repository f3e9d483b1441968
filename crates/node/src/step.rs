//! What a frame does to its own stream and to nothing else: several streams do it at once.

use std::time::Duration;

use super::{NodeSettings, Publish, track::StreamTrack};
use eddy_frames::{Frame, FrameView, decimal};
use eddy_inference::engine::{HiddenState, Stepper};
use eddy_messages::{Header, PredictionStatus, StreamState};

/// A predicted frame, with how it came to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Prediction<'a> {
    /// The predicted frame: sequence and stamp of the predicted instant.
    pub frame: &'a Frame,
    /// Sequence of the last observed frame.
    pub source_sequence: u64,
    /// Frames predicted ahead of it.
    pub horizon: u32,
    /// What the node does with the stream.
    pub state: StreamState,
}

impl Prediction<'_> {
    /// The message that goes with the frame, into one that was used before or is empty.
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

/// Room for the frames beyond the first that are predicted ahead.
#[derive(Default)]
pub(super) struct Ahead {
    /// For the copy of a stream's state that looks ahead.
    memory: Option<HiddenState>,
    frames: Vec<Frame>,
}

/// One stream with the frame that it observes next.
pub(super) struct Step<'a> {
    pub(super) track: &'a mut StreamTrack,
    pub(super) frame: FrameView<'a>,
    pub(super) arrived: Duration,
    /// The node's time.
    pub(super) now: Duration,
    /// Missing frames that the model fills.
    pub(super) gap: u64,
    pub(super) ahead: &'a mut Ahead,
    /// Whether there is something to publish, once the step is done.
    pub(super) tracking: bool,
    /// Whether every number of it is finite.
    pub(super) finite: bool,
}

impl Step<'_> {
    /// Fills the gap, observes the frame, predicts up to the horizon.
    pub(super) fn run(&mut self, stepper: &mut Stepper, settings: &NodeSettings, warm_up: u64) {
        let Self { track, frame, .. } = self;
        for _ in 0..self.gap {
            let missing = &mut track.spare;
            std::mem::swap(missing, &mut track.predicted);
            stepper.step_into(&mut track.memory, &*missing, &mut track.predicted);
        }
        stepper.step_into(&mut track.memory, *frame, &mut track.predicted);
        (track.sequence, track.stamp) = (frame.sequence, frame.stamp);
        track.observed += 1;
        if settings.free_run.is_some_and(|frames| track.observed >= frames.max(warm_up)) {
            track.free_run_due = Some(self.now + interval(track.predicted.dt));
        } else if track.observed >= warm_up {
            self.tracking = true;
            self.look_ahead(stepper, settings);
            let finite = self.published(settings).all(|(frame, _)| frame.check().is_ok());
            self.finite = finite;
        }
    }

    /// Predicts beyond the first frame, from a copy of the stream's state.
    fn look_ahead(&mut self, stepper: &mut Stepper, settings: &NodeSettings) {
        let Self { track, ahead: Ahead { memory, frames }, .. } = self;
        let beyond = settings.horizon as usize - 1;
        if beyond == 0 {
            return;
        }
        let memory = memory.get_or_insert_with(|| track.memory.clone());
        memory.clone_from(&track.memory);
        frames.resize_with(kept(settings), || track.predicted.clone());
        for number in 0..beyond {
            // Where only the last one counts, two take turns.
            let place = number % frames.len();
            if number == 0 {
                stepper.step_into(memory, &track.predicted, &mut frames[place]);
                continue;
            }
            let last = (number - 1) % frames.len();
            if let Ok([from, to]) = frames.get_disjoint_mut([last, place]) {
                stepper.step_into(memory, &*from, to);
            }
        }
    }

    /// The frames to publish, with how far ahead they are, in the order of their instants.
    fn published(&self, settings: &NodeSettings) -> impl Iterator<Item = (&Frame, u32)> {
        let horizon = settings.horizon as usize;
        let first = match settings.publish {
            Publish::All => 1,
            Publish::Last => horizon,
        };
        (first..=horizon).filter_map(move |ahead| {
            let frame = match ahead {
                1 => Some(&self.track.predicted),
                _ => self.ahead.frames.get((ahead - 2) % kept(settings)),
            };
            Some((frame?, ahead as u32))
        })
    }

    /// What is to be published.
    pub(super) fn predictions(
        &self,
        settings: &NodeSettings,
    ) -> impl Iterator<Item = Prediction<'_>> {
        self.published(settings).map(|(frame, horizon)| Prediction {
            frame,
            source_sequence: self.track.sequence,
            horizon,
            state: StreamState::Tracking,
        })
    }
}

/// Frames beyond the first that are kept for publication: all, or two that take turns.
fn kept(settings: &NodeSettings) -> usize {
    let beyond = settings.horizon as usize - 1;
    match settings.publish {
        Publish::All => beyond,
        Publish::Last => beyond.min(2),
    }
}

/// Time between two frames.
pub(super) fn interval(dt: f32) -> Duration {
    Duration::from_secs_f64(decimal(dt))
}
