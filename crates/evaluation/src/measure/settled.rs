//! Settled and slow states: one long rollout per stream, from a frame at which most scenes have slowed down.
//!
//! Position errors hardly see a predictor that stops what still moves: a pool that stands still and one that sloshes out of phase
//! are equally far from the truth. Speed and kinetic energy do, and so do one-step errors, which are compared with those of
//! constant velocity.

use serde::{Deserialize, Serialize};

use super::{area, bulk};
use crate::{
    Context, EvalError, Predictor, Rollout, errors::square, measure::Flights, numbers,
    predictor::RolloutOutcome, task::RolloutTask,
};
use eddy_dataset::Stream;
use eddy_frames::{State, mean_squared_distance};

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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        Settings, evaluate_scene,
        test_streams::{context, first_frames},
    };
    use eddy_inference::engine::Baseline;
    use eddy_mpm::{Preset, Scene};

    /// `frames` frames of a liquid that stands still, though every particle claims to rise.
    fn standing(frames: usize) -> Stream {
        let mut stream = first_frames(&Scene::generate(Preset::Kinds, 5, 0), 1);
        stream.states[0].velocity.fill([0.0, 0.1]);
        stream.states = vec![stream.states[0].clone(); frames];
        stream
    }

    /// Of the truth, of persistence, of constant velocity, and of the mean.
    fn measure(frames: usize, settings: Settings) -> Vec<Option<Settled>> {
        let stream = standing(frames);
        let predictors = [
            Predictor::Truth,
            Predictor::Baseline(Baseline::Persistence),
            Predictor::Baseline(Baseline::ConstantVelocity),
            Predictor::Mean,
        ];
        let context = context(&stream, settings);
        evaluate_scene(&context, &predictors, &stream, None).unwrap().settled
    }

    #[test]
    fn a_long_rollout_has_the_speed_the_displacement_and_the_area_of_its_predictor() {
        let found = measure(SETTLED_START + 1 + 200, Settings::full(5, 1));
        let [Some(truth), Some(still), Some(rising), None] = &found[..] else {
            panic!("{found:?}")
        };
        assert_eq!(truth, still);
        assert_eq!((truth.step_rmse, truth.states.len()), (0.0, 1));
        let state = truth.states[0];
        assert_eq!((state.frame, state.moved), (200, 0.0));
        assert!((state.speed - 0.1).abs() < 1e-6 && (state.kinetic_energy - 0.005).abs() < 1e-6);

        let frame = 0.1 * 0.016;
        assert!((rising.step_rmse - frame).abs() < 1e-6, "{rising:?}");
        assert!((rising.states[0].moved - 200.0 * frame).abs() < 1e-3, "{rising:?}");
        // It has risen past the ceiling in part, or is still inside.
        assert!(rising.states[0].area <= 1.05 * state.area && state.area > 0.0, "{rising:?}");
    }

    #[test]
    fn streams_that_are_too_short_and_cheap_evaluations_have_none() {
        assert!(measure(SETTLED_START + 200, Settings::full(5, 1)).is_empty());
        assert!(measure(SETTLED_START + 1 + 200, Settings::errors_only(5, 1)).is_empty());
        let longest = measure(SETTLED_START + 1 + 500, Settings::full(5, 1));
        let frames = longest[0].as_ref().unwrap().states.iter().map(|state| state.frame);
        assert_eq!(frames.collect::<Vec<_>>(), SETTLED_FRAMES);
    }
}
