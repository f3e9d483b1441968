//! Settled and slow states: one long rollout per stream, from a frame at which most scenes have slowed down.
//!
//! Position errors hardly see a predictor that stops what still moves: a pool that stands still and one that sloshes out of phase
//! are equally far from the truth. Speed and kinetic energy do, and so do one-step errors, which are compared with those of
//! constant velocity.

use serde::{Deserialize, Serialize};

use super::{area, bulk};
use crate::{
    Context, EvalError, Predictor, Rollout,
    dataset::{State, Stream},
    errors::square,
    mean_squared_distance,
    measure::Flights,
    numbers,
    predictor::RolloutOutcome,
    task::RolloutTask,
};

/// The frame that the rollout starts from: the last one of the scenes of `eddy simulate --preset kinds`, unless they are longer.
pub const SETTLED_START: usize = 299;
/// Frames ahead at which states are measured. Streams that are too short for the first one have no such rollout.
pub const SETTLED_FRAMES: [usize; 2] = [200, 500];
/// The last frames up to each of those, over which speed and energy are averaged: .64 s in the shipped models' scenes, about as long
/// as a pool takes to slosh from one wall to the other.
pub const SETTLED_AVERAGED: usize = 40;

/// Measures of the rollout of one predictor in one stream.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Settled {
    /// Root mean square position error of one-step predictions over the first of [`SETTLED_FRAMES`] (domain lengths); NaN for
    /// predictors that make none.
    #[serde(deserialize_with = "numbers::one")]
    pub step_rmse: f64,
    /// At each of [`SETTLED_FRAMES`] that the stream has.
    pub states: Vec<SettledState>,
}

/// What a rollout has become.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SettledState {
    /// The frame ahead.
    pub frame: usize,
    /// Mean speed of the particles over the last [`SETTLED_AVERAGED`] frames (domain lengths per second).
    pub speed: f64,
    /// Kinetic energy per mass over the same frames (domain lengths^2 per s^2).
    pub kinetic_energy: f64,
    /// Root mean square displacement of the particles since the start (domain lengths).
    pub moved: f64,
    /// Area that the particles occupy (domain lengths^2).
    pub area: f64,
}

impl Settled {
    /// Whether a stream is long enough.
    pub(crate) fn has_room(stream: &Stream) -> bool {
        stream.states.len() > SETTLED_START + SETTLED_FRAMES[0]
    }

    /// Rolls out from [`SETTLED_START`]; `None` for solvers, recorded rollouts and the mean of the training, which are not compared
    /// here.
    pub(crate) fn measure(
        context: &Context,
        predictor: &Predictor<'_>,
        stream: &Stream,
    ) -> Result<Option<Self>, EvalError> {
        let compared = matches!(
            predictor,
            Predictor::Model(_)
                | Predictor::JoinedLate(_)
                | Predictor::Baseline(_)
                | Predictor::LinearFit(_)
                | Predictor::Truth
        );
        if !compared {
            return Ok(None);
        }
        let [steps, longest] = SETTLED_FRAMES;
        let reach = longest.min(stream.states.len() - 1 - SETTLED_START);
        let (starts, flights) = (&[SETTLED_START], &Flights::default());
        let task = RolloutTask { stream, scene: None, starts, flights, horizon: steps, reach };
        let observed = &stream.states[SETTLED_START];
        let mut states = Vec::new();
        let mut add = |_: usize, rollout: Rollout| {
            let frames = SETTLED_FRAMES.into_iter().filter(|&frame| frame <= reach);
            let state = |frame| SettledState::new(context, observed, &rollout.states[..frame]);
            states.extend(frames.map(state));
        };
        let RolloutOutcome { step_results, .. } = predictor.roll_out(context, &task, &mut add)?;
        let sums = step_results.and_then(|results| results.steps);
        let step_rmse = sums.map_or(f64::NAN, |sums| {
            (sums.single.iter().sum::<f64>() / sums.count.iter().sum::<f64>()).sqrt()
        });
        Ok(Some(Self { step_rmse, states }))
    }
}

impl SettledState {
    /// Measures the states after `observed`, of which there is at least one.
    fn new(context: &Context, observed: &State, states: &[State]) -> Self {
        let averaged = &states[states.len().saturating_sub(SETTLED_AVERAGED)..];
        let mean = |of: fn(&[[f32; 2]]) -> f64| {
            averaged.iter().map(|state| of(&state.velocity)).sum::<f64>() / averaged.len() as f64
        };
        let last = &states[states.len() - 1].position;
        Self {
            frame: states.len(),
            speed: mean(speed),
            kinetic_energy: mean(bulk::kinetic_energy),
            moved: mean_squared_distance(last, &observed.position).sqrt(),
            area: area::occupied(last.iter(), context.domain, context.spacing),
        }
    }
}

/// Mean of |v| (domain lengths per second).
fn speed(velocity: &[[f32; 2]]) -> f64 {
    let sum: f64 = velocity.iter().map(|v| square(v.map(f64::from)).sqrt()).sum();
    sum / velocity.len() as f64
}
