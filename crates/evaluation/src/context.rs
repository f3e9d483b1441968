//! The evaluation context: settings, walls and units, the same for all predictors.

use super::{EvalError, LinearFit, Predictor, Units, window::starts};
use eddy_dataset::Bounds;
use eddy_frames::{Domain, State};
use eddy_inference::{
    checkpoint::{Description, Normalization},
    engine::{Ballistic, Baseline},
};

/// Minimum length of the rollouts of a full evaluation (frames), to detect blow-ups.
const BLOW_UP_REACH: usize = 200;

/// Rollouts per stream, unless others are requested.
pub const DEFAULT_STARTS: usize = 7;

/// What to evaluate.
#[derive(Clone, Copy, Debug)]
pub struct Settings {
    /// Frames ahead that are compared with the truth.
    pub horizon: usize,
    /// Length of a rollout (frames), at least the horizon; beyond the horizon only blow-ups are detected.
    pub reach: usize,
    /// Rollouts per stream.
    pub starts: usize,
    /// Whether physical measures are computed.
    pub measures: bool,
}

impl Settings {
    /// Errors, physical measures, and rollouts of at least 200 frames.
    pub const fn full(horizon: usize, starts: usize) -> Self {
        let reach = if horizon > BLOW_UP_REACH { horizon } else { BLOW_UP_REACH };
        Self { horizon, reach, starts, measures: true }
    }

    /// Errors only: cheap.
    pub const fn errors_only(horizon: usize, starts: usize) -> Self {
        Self { horizon, reach: horizon, starts, measures: false }
    }
}

/// What all predictors of an evaluation have in common.
#[derive(Clone, Debug)]
pub struct Context {
    /// What to evaluate.
    pub settings: Settings,
    /// Observed frames up to the first start.
    pub warm_up: usize,
    /// Step of the baselines. Its walls are the bounding box of all true positions, the best that a baseline can
    /// know.
    pub ballistic: Ballistic,
    /// Domain of the streams.
    pub domain: Domain,
    /// Distance between neighbouring particles at rest (domain lengths).
    pub spacing: f32,
    /// Divisors of normalised errors.
    pub units: Units,
    /// Mean x, y, vx, vy of the first model's training data (domain lengths, domain lengths per second).
    pub mean: [f32; 4],
    /// Whether there are tools, so that particles may be carried.
    pub has_tools: bool,
    /// The fit to the first model's training data, if its checkpoint has one.
    pub linear_fit: Option<LinearFit>,
}

impl Context {
    /// Takes interval, gravity and error units from the first model. Without tools. `domain` is the streams' domain: a particle
    /// model may have been trained in another one.
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
            has_tools: false,
            linear_fit: first.training.linear_fit.map(|rows| LinearFit { rows }),
        }
    }

    /// The trivial predictors that skill refers to.
    pub(super) fn baselines(&self) -> &'static [Baseline] {
        if self.has_tools { &Baseline::WITH_TOOLS } else { &Baseline::ALL }
    }

    /// The predictors that every evaluation has beside its models: the baselines of skill first.
    pub(super) fn simple_predictors<'a>(&self) -> impl Iterator<Item = Predictor<'a>> + use<'a> {
        let fit = self.linear_fit.map(Predictor::LinearFit);
        let baselines = self.baselines().iter().map(|&baseline| Predictor::Baseline(baseline));
        baselines.chain([Predictor::Mean]).chain(fit)
    }

    /// `particles` particles, all in the mean state of the training data.
    pub(super) fn mean_state(&self, particles: usize) -> State {
        let [x, y, vx, vy] = self.mean;
        State { position: vec![[x, y]; particles], velocity: vec![[vx, vy]; particles] }
    }

    /// The frames from which rollouts start, in a stream of `frames` frames.
    pub fn starts(&self, frames: usize) -> Vec<usize> {
        starts(frames, self.warm_up, self.settings)
    }

    /// Checks that the longest stream, of `found` frames, has room for a rollout.
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
