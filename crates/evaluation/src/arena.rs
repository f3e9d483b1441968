//! What is the same for everyone who is judged.

use super::{EvalError, Units, window::starts};
use crate::dataset::{Bounds, State};
use eddy_frames::Domain;
use eddy_inference::{
    checkpoint::{Description, Normalization},
    engine::Ballistic,
};

/// Rollouts of a full judgement go on to this frame at least, to see whether they blow up.
const BLOW_UP_REACH: usize = 200;

/// How to judge.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// Frames ahead that are compared with the truth.
    pub horizon: usize,
    /// Length of a rollout (frames), at least the horizon; beyond it only blow-ups are looked for.
    pub reach: usize,
    /// Rollouts a stream.
    pub starts: usize,
    /// Whether physical measures are taken.
    pub measures: bool,
}

impl Settings {
    /// Everything: rollouts go on to frame 200 at least.
    pub const fn full(horizon: usize, starts: usize) -> Self {
        let reach = if horizon > BLOW_UP_REACH { horizon } else { BLOW_UP_REACH };
        Self { horizon, reach, starts, measures: true }
    }

    /// Errors only, which is cheap.
    pub const fn errors_only(horizon: usize, starts: usize) -> Self {
        Self { horizon, reach: horizon, starts, measures: false }
    }
}

/// What is the same for everyone who is judged.
#[derive(Clone, Debug)]
pub struct Arena {
    /// How to judge.
    pub settings: Settings,
    /// Frames that are observed before the first start.
    pub warm_up: usize,
    /// The baselines' step: walls are where the particles of all streams were, the best that a baseline
    /// can know.
    pub ballistic: Ballistic,
    /// The box that holds the particles.
    pub domain: Domain,
    /// Distance between neighbouring particles at rest (domain lengths).
    pub spacing: f32,
    /// What normalised errors are divided by.
    pub units: Units,
    /// Mean of x, y, vx, vy in the training of the first model (domain lengths, domain lengths per second).
    pub mean: [f32; 4],
}

impl Arena {
    /// The arena for models of which this is the first: interval, gravity and the units of normalised
    /// errors are its own. `domain` is that of the streams: a particle model may have been trained in another.
    pub fn new(
        settings: Settings,
        first: &Description,
        warm_up: usize,
        domain: Domain,
        walls: Bounds,
        spacing: f32,
    ) -> Self {
        let Bounds { lower, upper } = walls;
        let (gravity, dt) = (first.gravity, first.dt);
        Self {
            settings,
            warm_up,
            ballistic: Ballistic { gravity, dt, lower, upper },
            domain,
            spacing,
            units: units(&first.normalization),
            mean: first.normalization.mean,
        }
    }

    /// So many particles as they were on average in the training.
    pub(super) fn mean_state(&self, particles: usize) -> State {
        let [x, y, vx, vy] = self.mean;
        State { position: vec![[x, y]; particles], velocity: vec![[vx, vy]; particles] }
    }

    /// The frames of a stream of `frames` frames from which rollouts start.
    pub fn starts(&self, frames: usize) -> Vec<usize> {
        starts(frames, self.warm_up, self.settings)
    }

    /// Refuses streams of which even the longest, of `found` frames, has no window.
    ///
    /// # Errors
    /// [`EvalError::TooShort`].
    pub fn check(&self, found: usize) -> Result<(), EvalError> {
        if !self.starts(found).is_empty() {
            return Ok(());
        }
        let (warm_up, horizon) = (self.warm_up, self.settings.horizon);
        Err(EvalError::TooShort { found, expected: warm_up + horizon, warm_up, horizon })
    }
}

fn units(normalization: &Normalization) -> Units {
    let Normalization { minimum, maximum, standard_deviation, .. } = normalization;
    let range = |f: usize| f64::from(maximum[f] - minimum[f]).max(f64::EPSILON);
    let deviation = |f: usize| f64::from(standard_deviation[f]).max(f64::EPSILON);
    Units { ranges: std::array::from_fn(range), deviations: std::array::from_fn(deviation) }
}
