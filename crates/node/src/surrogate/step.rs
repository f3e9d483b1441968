//! What a frame does to its own stream. Touches nothing else, so that several streams are stepped in parallel.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use super::{
    NodeSettings, Publish,
    stream::{StreamState, expected_error},
};
use eddy_frames::{Frame, FrameView, decimal};
use eddy_inference::{
    engine::{HiddenState, StepRequest, Stepper},
    error_model::{ErrorEstimate, ErrorModel},
};
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

/// Buffers for the predictions beyond the first frame.
#[derive(Default)]
pub(super) struct HorizonBuffers {
    /// Copy of the stream's hidden state, advanced to the horizon.
    memory: Option<HiddenState>,
    frames: Vec<Frame>,
    /// How far off the published frames are expected to be.
    expected_errors: Vec<Option<ErrorEstimate>>,
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
    /// Of a calibrated model.
    pub(super) error_model: Option<&'a ErrorModel>,
    /// Raised when the program is asked to end: predictions far ahead are given up.
    pub(super) stop: &'a AtomicBool,
    /// Calls of [`Step::next`] so far.
    pub(super) stepped: u64,
    /// Whether there are predictions to publish; set when the frame is observed.
    pub(super) tracking: bool,
    /// Whether all of them are finite; set by [`Step::finish`].
    pub(super) finite: bool,
}

impl Step<'_> {
    /// Fills the gap, observes the frame, predicts up to the horizon.
    pub(super) fn run(&mut self, stepper: &mut Stepper, settings: &NodeSettings, warm_up: u64) {
        while let Some(StepRequest { hidden, frame, next }) = self.next(settings, warm_up) {
            stepper.step_into(hidden, frame, next);
        }
        self.finish(settings);
    }

    /// What is to be stepped next: the missing frames, the observed one, then those up to the horizon; `None` at the end.
    pub(super) fn next(
        &mut self,
        settings: &NodeSettings,
        warm_up: u64,
    ) -> Option<StepRequest<'_>> {
        let number = self.stepped;
        self.stepped += 1;
        if let Some(beyond) = number.checked_sub(self.gap + 1) {
            if beyond == 0 {
                self.observed(settings, warm_up);
            }
            return if self.tracking { self.look_ahead(beyond, settings) } else { None };
        }
        let StreamState { memory: hidden, predicted: next, spare, error_tracker, observed, .. } =
            &mut *self.stream;
        if number == self.gap {
            if let Some(tracker) = error_tracker {
                // A frame that was predicted from a prediction says nothing about one step.
                let is_of_one_step = self.gap == 0 && *observed > 0;
                tracker.observe(&self.frame, is_of_one_step.then_some(&*next));
            }
            return Some(StepRequest { hidden, frame: self.frame, next });
        }
        std::mem::swap(spare, next);
        Some(StepRequest { hidden, frame: (&*spare).into(), next })
    }

    /// The stream has observed the frame: what comes next?
    fn observed(&mut self, settings: &NodeSettings, warm_up: u64) {
        let Self { stream, frame, .. } = self;
        (stream.sequence, stream.stamp) = (frame.sequence, frame.stamp);
        stream.observed += 1;
        if settings.free_run.is_some_and(|frames| stream.observed >= frames.max(warm_up)) {
            stream.free_run_due = Some(self.now + interval(stream.predicted.dt));
        } else if stream.observed >= warm_up {
            self.tracking = true;
        }
    }

    /// Frame `number` beyond the first, predicted from a copy of the stream's hidden state. A stop ends it: then there is
    /// nothing to publish.
    fn look_ahead(&mut self, number: u64, settings: &NodeSettings) -> Option<StepRequest<'_>> {
        let number = number as usize;
        if number + 1 >= settings.horizon as usize {
            return None;
        }
        if number >= FAR && self.stop.load(Ordering::Relaxed) {
            self.tracking = false;
            return None;
        }
        let Self { stream, buffers: HorizonBuffers { memory, frames, .. }, .. } = self;
        let hidden = memory.get_or_insert_with(|| stream.memory.clone());
        // If only the last frame is published, two buffers alternate.
        let place = number % kept(settings);
        if number == 0 {
            hidden.clone_from(&stream.memory);
            frames.resize_with(kept(settings), || stream.predicted.clone());
            let frame = (&stream.predicted).into();
            return Some(StepRequest { hidden, frame, next: &mut frames[place] });
        }
        let [from, next] = frames.get_disjoint_mut([(number - 1) % kept(settings), place]).ok()?;
        Some(StepRequest { hidden, frame: (&*from).into(), next })
    }

    /// After the last of [`Step::next`].
    pub(super) fn finish(&mut self, settings: &NodeSettings) {
        let Self { stream, buffers: HorizonBuffers { frames, expected_errors, .. }, .. } = self;
        let StreamState { predicted, error_tracker, .. } = &mut **stream;
        expected_errors.clear();
        self.finite = true;
        if !self.tracking {
            return;
        }
        for (frame, horizon) in published(predicted, frames, settings) {
            self.finite &= frame.check().is_ok();
            expected_errors.push(expected_error(error_tracker, self.error_model, frame, horizon));
        }
    }

    /// The predictions to publish.
    pub(super) fn predictions(
        &self,
        settings: &NodeSettings,
    ) -> impl Iterator<Item = Prediction<'_>> {
        let HorizonBuffers { frames, expected_errors, .. } = &*self.buffers;
        let frames = published(&self.stream.predicted, frames, settings);
        frames.zip(expected_errors).map(|((frame, horizon), &expected_error)| Prediction {
            frame,
            source_sequence: self.stream.sequence,
            horizon,
            state: Phase::Tracking,
            expected_error,
        })
    }
}

/// The frames to publish with their horizons, in the order of time: `first` and those `beyond`.
fn published<'a>(
    first: &'a Frame,
    beyond: &'a [Frame],
    settings: &NodeSettings,
) -> impl Iterator<Item = (&'a Frame, u32)> {
    let (horizon, kept) = (settings.horizon as usize, kept(settings));
    let nearest = match settings.publish {
        Publish::All => 1,
        Publish::Last => horizon,
    };
    (nearest..=horizon).filter_map(move |ahead| {
        let frame = match ahead {
            1 => Some(first),
            _ => beyond.get((ahead - 2) % kept),
        };
        Some((frame?, ahead as u32))
    })
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
