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
    dataset::Stream,
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
    let description = surrogate.description();
    let warm_up = description.warm_up as usize;
    let (lower, upper) = walls_around(streams);
    let ballistic = Ballistic { gravity: description.gravity, dt: description.dt, lower, upper };
    let sums = || ErrorSums::new(settings.horizon, &description.normalization);
    let mut judgement = Judgement {
        model: sums(),
        baselines: Baseline::ALL.map(|baseline| (baseline, sums())),
        windows: 0,
        diverged: 0,
    };
    for stream in streams {
        for start in starts(stream.states.len(), warm_up, settings) {
            let rollout = predict(surrogate, stream, start, settings.horizon)
                .map_err(|reason| EvalError::Model { stream: stream.id, reason })?;
            let truth = &stream.states[start + 1..=start + settings.horizon];
            judgement.windows += 1;
            judgement.diverged += usize::from(rollout.diverged);
            judgement.model.add(&stream.material, &rollout.states, truth);
            for (baseline, errors) in &mut judgement.baselines {
                let states = baseline.roll_out(&stream.states[start], settings.horizon, &ballistic);
                errors.add(&stream.material, &states, truth);
            }
            progress();
        }
    }
    if judgement.windows == 0 {
        return Err(EvalError::TooShort {
            found: streams.iter().map(|stream| stream.states.len()).max().unwrap_or(0),
            expected: warm_up + settings.horizon,
            warm_up,
            horizon: settings.horizon,
        });
    }
    Ok(judgement)
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

/// The smallest and largest coordinates of the particles: the best walls a baseline can know.
fn walls_around(streams: &[Stream]) -> ([f32; 2], [f32; 2]) {
    let (mut lower, mut upper) = ([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]);
    for position in streams.iter().flat_map(|s| &s.states).flat_map(|state| &state.position) {
        for axis in 0..2 {
            lower[axis] = lower[axis].min(position[axis]);
            upper[axis] = upper[axis].max(position[axis]);
        }
    }
    (lower, upper)
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
