//! Features of predictions, and the errors that became known later.

use crate::Rollout;
use eddy_dataset::Stream;
use eddy_frames::{Frame, FrameView, mean_squared_distance};
use eddy_inference::{
    engine::Surrogate,
    error_model::{ErrorTracker, Features},
};

/// A prediction of a rollout.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample {
    /// Frames ahead.
    pub horizon: u32,
    /// What was known when it was made.
    pub features: Features,
    /// Mean squared position error (domain lengths squared).
    pub error: f64,
    /// That of a ballistic prediction from the same frame.
    pub ballistic_error: f64,
}

/// Takes samples of the rollouts from a stream.
pub(crate) struct Sampler<'a> {
    stream: &'a Stream,
    /// Frames ahead, in increasing order.
    horizons: &'a [u32],
    tracker: ErrorTracker,
    /// A frame of the stream for predicted states.
    frame: Frame,
    samples: Vec<Sample>,
}

impl<'a> Sampler<'a> {
    pub(crate) fn new(surrogate: &Surrogate, stream: &'a Stream, horizons: &'a [u32]) -> Self {
        let tracker = ErrorTracker::new(surrogate.description(), &stream.domain, &stream.material);
        Self { stream, horizons, tracker, frame: stream.frame(0), samples: Vec::new() }
    }

    /// Observes a frame of the stream, which was `predicted` from the one before it.
    pub(crate) fn observe(&mut self, frame: &Frame, predicted: Option<&Frame>) {
        if !self.horizons.is_empty() {
            self.tracker.observe(&FrameView::from(frame), predicted);
        }
    }

    /// Takes the samples of a rollout from the frame `start`, which was observed last. A rollout that diverges has none: a node
    /// does not publish such predictions.
    pub(crate) fn add(&mut self, start: usize, rollout: &Rollout) {
        if rollout.diverged {
            return;
        }
        for &horizon in self.horizons {
            let ahead = horizon as usize;
            let (Some(truth), Some(state)) =
                (self.stream.states.get(start + ahead), rollout.states.get(ahead - 1))
            else {
                return;
            };
            self.frame.position.clone_from(&state.position);
            let Some(features) = self.tracker.features(&self.frame, horizon) else { return };
            self.samples.push(Sample {
                horizon,
                features,
                error: mean_squared_distance(&state.position, &truth.position),
                ballistic_error: self.tracker.ballistic_error(&truth.position, horizon),
            });
        }
    }

    pub(crate) fn finish(self) -> Vec<Sample> {
        self.samples
    }
}
