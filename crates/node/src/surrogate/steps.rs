//! The steps that a frame causes in its own stream. They touch nothing else, so that several streams are stepped in
//! parallel.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use super::{
    NodeSettings, Prediction, Publish,
    stream::{StreamState, expected_error},
};
use eddy_frames::{Frame, FrameView, decimal};
use eddy_inference::{
    engine::{HiddenState, StepRequest},
    error_model::{ErrorEstimate, ErrorModel},
};
use eddy_messages::StreamState as Phase;

/// Predictions further ahead (frames) are given up when the program is asked to end; a nearer one takes no time.
const FAR: usize = 256;

/// Buffers for the predictions beyond the first frame.
#[derive(Default)]
pub(super) struct HorizonBuffers {
    /// Copy of the stream's hidden state, advanced to the horizon.
    memory: Option<HiddenState>,
    frames: Vec<Frame>,
    /// How far off the published frames are expected to be.
    expected_errors: Vec<Option<ErrorEstimate>>,
}

/// What the streams of a batch have in common.
#[derive(Clone, Copy)]
pub(super) struct BatchContext<'a> {
    pub(super) settings: &'a NodeSettings,
    /// Frames that the model observes before its predictions are published.
    pub(super) warm_up: u64,
    /// Of a calibrated model.
    pub(super) error_model: Option<&'a ErrorModel>,
    /// Node time, if it is not the time of arrival.
    pub(super) simulated: Option<Duration>,
    /// Raised when the program is asked to end: predictions far ahead are given up.
    pub(super) stop: &'a AtomicBool,
}

/// The steps of one stream with the frame that it observes next: fills the gap, observes the frame, predicts up to the
/// horizon.
pub(super) struct StreamSteps<'a> {
    pub(super) stream: &'a mut StreamState,
    buffers: &'a mut HorizonBuffers,
    pub(super) frame: FrameView<'a>,
    pub(super) arrived: Duration,
    /// Missing frames for the model to fill in.
    gap: u64,
    context: BatchContext<'a>,
    /// Calls of [`StreamSteps::next`] so far.
    stepped: u64,
    /// Whether there are predictions to publish; set when the frame is observed.
    tracking: bool,
    /// Whether all of them are finite; set at the end.
    finite: bool,
}

impl<'a> StreamSteps<'a> {
    /// Before the first step. `frame` follows `gap` missing frames.
    pub(super) fn new(
        stream: &'a mut StreamState,
        buffers: &'a mut HorizonBuffers,
        frame: FrameView<'a>,
        arrived: Duration,
        gap: u64,
        context: BatchContext<'a>,
    ) -> Self {
        Self {
            stream,
            buffers,
            frame,
            arrived,
            gap,
            context,
            stepped: 0,
            tracking: false,
            finite: true,
        }
    }

    /// What is to be stepped next: the missing frames, the observed one, then those up to the horizon; `None` at the end,
    /// after which it must not be called again.
    pub(super) fn next(&mut self) -> Option<StepRequest<'_>> {
        let number = self.stepped;
        self.stepped += 1;
        if let Some(beyond) = number.checked_sub(self.gap + 1) {
            if beyond == 0 {
                self.observed();
            }
            if !self.looks_ahead(beyond) {
                self.finish();
                return None;
            }
            return self.look_ahead(beyond as usize);
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
    fn observed(&mut self) {
        let Self { stream, frame, context: BatchContext { settings, warm_up, .. }, .. } = self;
        (stream.sequence, stream.stamp) = (frame.sequence, frame.stamp);
        stream.observed += 1;
        if settings.free_run.is_some_and(|frames| stream.observed >= frames.max(*warm_up)) {
            let now = self.context.simulated.unwrap_or(self.arrived);
            stream.free_run_due = Some(now + interval(stream.predicted.dt));
        } else if stream.observed >= *warm_up {
            self.tracking = true;
        }
    }

    /// Whether frame `number` beyond the first is to be predicted. A stop ends it: then there is nothing to publish.
    fn looks_ahead(&mut self, number: u64) -> bool {
        let is_within = number + 1 < u64::from(self.context.settings.horizon);
        if is_within && number >= FAR as u64 && self.context.stop.load(Ordering::Relaxed) {
            self.tracking = false;
        }
        self.tracking && is_within
    }

    /// Frame `number` beyond the first, predicted from a copy of the stream's hidden state.
    fn look_ahead(&mut self, number: usize) -> Option<StepRequest<'_>> {
        let Self { stream, buffers: HorizonBuffers { memory, frames, .. }, .. } = self;
        let hidden = memory.get_or_insert_with(|| stream.memory.clone());
        // If only the last frame is published, two buffers alternate.
        let kept = kept(self.context.settings);
        let place = number % kept;
        if number == 0 {
            hidden.clone_from(&stream.memory);
            frames.resize_with(kept, || stream.predicted.clone());
            let frame = (&stream.predicted).into();
            return Some(StepRequest { hidden, frame, next: &mut frames[place] });
        }
        let [from, next] = frames.get_disjoint_mut([(number - 1) % kept, place]).ok()?;
        Some(StepRequest { hidden, frame: (&*from).into(), next })
    }

    /// After the last step: checks the frames to publish and estimates their errors.
    fn finish(&mut self) {
        let Self { stream, buffers: HorizonBuffers { frames, expected_errors, .. }, .. } = self;
        let StreamState { predicted, error_tracker, .. } = &mut **stream;
        let BatchContext { settings, error_model, .. } = self.context;
        expected_errors.clear();
        if !self.tracking {
            return;
        }
        for (frame, horizon) in published(predicted, frames, settings) {
            self.finite &= frame.check().is_ok();
            expected_errors.push(expected_error(error_tracker, error_model, frame, horizon));
        }
    }

    /// Whether a prediction is not finite.
    pub(super) fn has_diverged(&self) -> bool {
        !self.finite
    }

    /// The predictions to publish: none during warm-up and free runs.
    pub(super) fn predictions(&self) -> impl Iterator<Item = Prediction<'_>> {
        let HorizonBuffers { frames, expected_errors, .. } = &*self.buffers;
        let BatchContext { settings, stop, .. } = self.context;
        let frames = published(&self.stream.predicted, frames, settings);
        let predictions = frames.zip(expected_errors).enumerate();
        predictions.take_while(|(number, _)| *number < FAR || !stop.load(Ordering::Relaxed)).map(
            |(_, ((frame, horizon), &expected_error))| Prediction {
                frame,
                source_sequence: self.stream.sequence,
                horizon,
                state: Phase::Tracking,
                expected_error,
            },
        )
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
