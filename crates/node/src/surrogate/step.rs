//! What a frame does to its own stream. Touches nothing else, so that several streams are stepped in parallel.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use super::{NodeSettings, Publish, stream::StreamState};
use eddy_frames::{Frame, FrameView, decimal};
use eddy_inference::engine::{HiddenState, Stepper};
use eddy_messages::{Header, PredictionStatus, StreamState as Phase};

/// Predictions further ahead (frames) are given up when the program is asked to end; a nearer one takes no time.
pub(super) const FAR: usize = 256;

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

/// Buffers for the predictions beyond the first frame.
#[derive(Default)]
pub(super) struct HorizonBuffers {
    /// Copy of the stream's hidden state, advanced to the horizon.
    memory: Option<HiddenState>,
    frames: Vec<Frame>,
}

/// One stream and the frame that it observes next.
pub(super) struct Step<'a> {
    pub(super) stream: &'a mut StreamState,
    pub(super) frame: FrameView<'a>,
    pub(super) arrived: Duration,
    /// Node time.
    pub(super) now: Duration,
    /// Missing frames for the model to fill in.
    pub(super) gap: u64,
    pub(super) buffers: &'a mut HorizonBuffers,
    /// Raised when the program is asked to end: predictions far ahead are given up.
    pub(super) stop: &'a AtomicBool,
    /// Whether there are predictions to publish; set by [`Step::run`].
    pub(super) tracking: bool,
    /// Whether all of them are finite; set by [`Step::run`].
    pub(super) finite: bool,
}

impl Step<'_> {
    /// Fills the gap, observes the frame, predicts up to the horizon.
    pub(super) fn run(&mut self, stepper: &mut Stepper, settings: &NodeSettings, warm_up: u64) {
        let Self { stream, frame, .. } = self;
        for _ in 0..self.gap {
            let missing = &mut stream.spare;
            std::mem::swap(missing, &mut stream.predicted);
            stepper.step_into(&mut stream.memory, &*missing, &mut stream.predicted);
        }
        stepper.step_into(&mut stream.memory, *frame, &mut stream.predicted);
        (stream.sequence, stream.stamp) = (frame.sequence, frame.stamp);
        stream.observed += 1;
        if settings.free_run.is_some_and(|frames| stream.observed >= frames.max(warm_up)) {
            stream.free_run_due = Some(self.now + interval(stream.predicted.dt));
        } else if stream.observed >= warm_up {
            self.tracking = self.look_ahead(stepper, settings);
            let finite = self.published(settings).all(|(frame, _)| frame.check().is_ok());
            self.finite = finite || !self.tracking;
        }
    }

    /// Predicts beyond the first frame, from a copy of the stream's hidden state. Returns whether it reached the horizon;
    /// a stop ends it.
    fn look_ahead(&mut self, stepper: &mut Stepper, settings: &NodeSettings) -> bool {
        let Self { stream, buffers: HorizonBuffers { memory, frames }, .. } = self;
        let beyond = settings.horizon as usize - 1;
        if beyond == 0 {
            return true;
        }
        let memory = memory.get_or_insert_with(|| stream.memory.clone());
        memory.clone_from(&stream.memory);
        frames.resize_with(kept(settings), || stream.predicted.clone());
        for number in 0..beyond {
            if number >= FAR && self.stop.load(Ordering::Relaxed) {
                return false;
            }
            // If only the last frame is published, two buffers alternate.
            let place = number % frames.len();
            if number == 0 {
                stepper.step_into(memory, &stream.predicted, &mut frames[place]);
                continue;
            }
            let last = (number - 1) % frames.len();
            if let Ok([from, to]) = frames.get_disjoint_mut([last, place]) {
                stepper.step_into(memory, &*from, to);
            }
        }
        true
    }

    /// The frames to publish with their horizons, in the order of time.
    fn published(&self, settings: &NodeSettings) -> impl Iterator<Item = (&Frame, u32)> {
        let horizon = settings.horizon as usize;
        let first = match settings.publish {
            Publish::All => 1,
            Publish::Last => horizon,
        };
        (first..=horizon).filter_map(move |ahead| {
            let frame = match ahead {
                1 => Some(&self.stream.predicted),
                _ => self.buffers.frames.get((ahead - 2) % kept(settings)),
            };
            Some((frame?, ahead as u32))
        })
    }

    /// The predictions to publish.
    pub(super) fn predictions(
        &self,
        settings: &NodeSettings,
    ) -> impl Iterator<Item = Prediction<'_>> {
        self.published(settings).map(|(frame, horizon)| Prediction {
            frame,
            source_sequence: self.stream.sequence,
            horizon,
            state: Phase::Tracking,
        })
    }
}

/// Buffers for frames beyond the first: one for each published frame, or two that alternate.
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
