//! Judges predictions by free rollouts.
//!
//! 1. [`window`]: from which frames of a stream rollouts start.
//! 2. [`rollout`]: the model fed with its own output; it sees observed frames only.
//! 3. [`baseline`]: persistence, constant velocity, ballistic with walls.
//! 4. [`errors`]: squared errors summed over windows, for each material and frame ahead.
//! 5. [`report`]: root mean squares, skill, as JSON, CSV and tables.

mod baseline;
mod errors;
mod report;
mod rollout;
mod window;

pub use baseline::Baseline;
pub use errors::{ErrorSums, Errors, mean_squared_distance};
pub use report::{MaterialErrors, PredictorReport, Report};
pub use rollout::{Rollout, roll_out};
pub use window::starts;

use crate::{
    checkpoint::Normalization,
    dataset::{Bounds, Stream},
    engine::{ModelError, Surrogate},
    model::Ballistic,
};

/// How to judge.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// Length of a rollout (frames).
    pub horizon: usize,
    /// Rollouts a stream.
    pub starts: usize,
}

/// Why streams cannot be judged.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// The model cannot take the particles.
    #[error("stream {stream}: {reason}")]
    Model {
        /// The stream.
        stream: u64,
        /// What the model says.
        reason: ModelError,
    },
    /// No stream is long enough.
    #[error(
        "streams: the longest has {found} frames, expected at least {expected}: {warm_up} to observe and {horizon} to predict"
    )]
    TooShort {
        /// Frames of the longest stream.
        found: usize,
        /// Frames of one window.
        expected: usize,
        /// Frames observed.
        warm_up: usize,
        /// Frames predicted.
        horizon: usize,
    },
}

/// Errors of the model and of every baseline, over the same windows.
#[derive(Clone, Debug)]
pub struct Judgement {
    /// The model's errors.
    pub model: ErrorSums,
    /// Each baseline's errors.
    pub baselines: [(Baseline, ErrorSums); 3],
    /// Rollouts.
    pub windows: usize,
    /// Rollouts in which the model predicted something that is not finite.
    pub diverged: usize,
}

/// Rolls `surrogate` and the baselines out from frames spread over every stream.
///
/// `progress` is called after every window.
///
/// # Errors
/// [`EvalError`] when the streams do not fit the model or are all too short for one window.
pub fn judge(
    surrogate: &Surrogate,
    streams: &[Stream],
    settings: Settings,
    mut progress: impl FnMut(),
) -> Result<Judgement, EvalError> {
    let mut judge = Judge::new(surrogate, settings, walls_around(streams));
    for stream in streams {
        for start in judge.starts(stream.states.len()) {
            judge.window(stream, start)?;
            progress();
        }
    }
    judge.finish(streams.iter().map(|stream| stream.states.len()).max().unwrap_or(0))
}

/// Judges one window after the other, for streams that are not all in memory.
pub struct Judge<'a> {
    surrogate: &'a Surrogate,
    settings: Settings,
    ballistic: Ballistic,
    judgement: Judgement,
}

impl<'a> Judge<'a> {
    /// Nothing is judged yet. `walls` is where the particles of all streams are: the best walls a
    /// baseline can know.
    pub fn new(surrogate: &'a Surrogate, settings: Settings, walls: Bounds) -> Self {
        let description = surrogate.description();
        let sums = || ErrorSums::new(settings.horizon, &description.normalization);
        let judgement = Judgement {
            model: sums(),
            baselines: Baseline::ALL.map(|baseline| (baseline, sums())),
            windows: 0,
            diverged: 0,
        };
        let Bounds { lower, upper } = walls;
        let ballistic =
            Ballistic { gravity: description.gravity, dt: description.dt, lower, upper };
        Self { surrogate, settings, ballistic, judgement }
    }

    /// The frames of a stream of `frames` frames from which rollouts start.
    pub fn starts(&self, frames: usize) -> Vec<usize> {
        starts(frames, self.warm_up(), self.settings)
    }

    /// Frames the model observes up to each start.
    pub fn warm_up(&self) -> usize {
        self.surrogate.description().warm_up as usize
    }

    /// Rolls out from frame `start`, which has the warm-up up to it and the horizon after it.
    ///
    /// # Errors
    /// [`EvalError::Model`] when the stream does not fit the model.
    pub fn window(&mut self, stream: &Stream, start: usize) -> Result<(), EvalError> {
        let horizon = self.settings.horizon;
        let rollout = predict(self.surrogate, stream, start, horizon)
            .map_err(|reason| EvalError::Model { stream: stream.id, reason })?;
        let truth = &stream.states[start + 1..=start + horizon];
        let judgement = &mut self.judgement;
        judgement.windows += 1;
        judgement.diverged += usize::from(rollout.diverged);
        judgement.model.add(&stream.material, &rollout.states, truth);
        for (baseline, errors) in &mut judgement.baselines {
            let states = baseline.roll_out(&stream.states[start], horizon, &self.ballistic);
            errors.add(&stream.material, &states, truth);
        }
        Ok(())
    }

    /// The judgement. `longest` is the number of frames of the longest stream, for the error.
    ///
    /// # Errors
    /// [`EvalError::TooShort`] when there was no window.
    pub fn finish(self, longest: usize) -> Result<Judgement, EvalError> {
        let (warm_up, horizon) = (self.warm_up(), self.settings.horizon);
        if self.judgement.windows == 0 {
            let expected = warm_up + horizon;
            return Err(EvalError::TooShort { found: longest, expected, warm_up, horizon });
        }
        Ok(self.judgement)
    }
}

/// The model's rollout from frame `start`, of which it sees the warm-up frames up to `start`.
fn predict(
    surrogate: &Surrogate,
    stream: &Stream,
    start: usize,
    horizon: usize,
) -> Result<Rollout, ModelError> {
    let first = start + 1 - surrogate.description().warm_up as usize;
    let observed: Vec<_> = (first..=start).map(|index| stream.frame(index)).collect();
    roll_out(surrogate, &observed, horizon)
}

fn walls_around(streams: &[Stream]) -> Bounds {
    let mut walls = Bounds::default();
    streams.iter().flat_map(|stream| &stream.states).for_each(|state| walls.widen(state));
    walls
}

/// The ranges that MinMax errors are divided by.
fn ranges(normalization: &Normalization) -> [f64; 4] {
    std::array::from_fn(|f| {
        f64::from(normalization.maximum[f] - normalization.minimum[f]).max(f64::EPSILON)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{checkpoint::Checkpoint, dataset::load_streams};

    #[test]
    fn a_future_of_nan_changes_no_rollout() {
        let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/bags/sample");
        let stream = load_streams(&[sample.into()]).unwrap().remove(0);
        let surrogate = Surrogate::load(&Checkpoint::shipped().unwrap(), None).unwrap();
        let (start, horizon) = (8, 10);
        let mut blind = stream.clone();
        for state in &mut blind.states[start + 1..] {
            state.position.fill([f32::NAN; 2]);
            state.velocity.fill([f32::NAN; 2]);
        }
        let seeing = predict(&surrogate, &stream, start, horizon).unwrap();
        assert_eq!(predict(&surrogate, &blind, start, horizon).unwrap(), seeing);
        assert!(!seeing.diverged);
        assert_ne!(seeing.states[0], seeing.states[horizon - 1], "nothing moved at all");
    }
}
