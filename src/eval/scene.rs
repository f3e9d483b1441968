//! One scene judged: every predictor from the same frames.

use super::{
    Arena, ErrorSums, EvalError, Kind, Predictor, Rollout,
    measure::{FlightSums, Flights, Physics, Rest, SHOWN, Window, is_blown_up},
    predictor::Predicting,
    steps::{OnTheWay, StepSums},
};
use crate::{dataset::Stream, mpm::Scene};

/// What one predictor came to in one scene, or in several.
#[derive(Clone, Debug)]
pub struct Tally {
    /// Errors of free rollouts.
    pub errors: ErrorSums,
    /// Errors of next frames, where they were predicted.
    pub steps: Option<StepSums>,
    /// What predictions of next frames did to bodies in free flight.
    pub flight: FlightSums,
    /// Physical measures at each of [`SHOWN`] within the horizon; none where they were not asked for.
    pub physics: Vec<Physics>,
    /// Rollouts.
    pub windows: usize,
    /// Rollouts with a prediction that is not finite.
    pub diverged: usize,
    /// Rollouts that blew up, those that diverged among them.
    pub blown_up: usize,
}

impl Tally {
    /// Nothing was predicted yet.
    pub fn new(arena: &Arena) -> Self {
        let shown = SHOWN.into_iter().filter(|&ahead| ahead <= arena.settings.horizon).count();
        Self {
            errors: ErrorSums::new(arena.settings.horizon, arena.ranges),
            steps: None,
            flight: FlightSums::default(),
            physics: vec![Physics::default(); if arena.settings.measures { shown } else { 0 }],
            windows: 0,
            diverged: 0,
            blown_up: 0,
        }
    }

    /// Adds what the same predictor came to elsewhere.
    pub fn merge(&mut self, other: &Self) {
        self.errors.merge(&other.errors);
        match (&mut self.steps, &other.steps) {
            (Some(steps), Some(others)) => steps.merge(others),
            (steps @ None, others) => steps.clone_from(others),
            (Some(_), None) => {}
        }
        self.flight.merge(&other.flight);
        self.physics.iter_mut().zip(&other.physics).for_each(|(sum, other)| sum.merge(other));
        self.windows += other.windows;
        self.diverged += other.diverged;
        self.blown_up += other.blown_up;
    }
}

/// A judged scene.
#[derive(Clone, Debug)]
pub struct JudgedScene {
    /// The stream's number.
    pub id: u64,
    /// What it is made of.
    pub kind: Kind,
    /// What each predictor came to, in their order.
    pub tallies: Vec<Tally>,
}

impl JudgedScene {
    /// Rollouts of each predictor.
    pub fn windows(&self) -> usize {
        self.tallies.first().map_or(0, |tally| tally.windows)
    }
}

/// Lets every predictor roll out from the same frames of a stream. `scene` is what it was simulated
/// from, for rivals that need it. Without room for a window there is nothing but empty tallies.
///
/// # Errors
/// [`EvalError`] when a predictor cannot take the particles.
pub fn judge_scene(
    arena: &Arena,
    predictors: &[Predictor<'_>],
    stream: &Stream,
    scene: Option<&Scene>,
) -> Result<JudgedScene, EvalError> {
    let starts = arena.starts(stream.states.len());
    let rest = arena.settings.measures.then(|| Rest::new(arena, stream));
    let windows: Vec<Window> =
        starts.iter().map(|&start| Window::new(arena, stream, start, rest.as_ref())).collect();
    let flights = match rest {
        Some(_) => Flights::of(stream, &arena.ballistic, arena.spacing),
        None => Flights::default(),
    };
    let (horizon, reach) = (arena.settings.horizon, arena.settings.reach);
    let what = Predicting { stream, scene, starts: &starts, flights: &flights, horizon, reach };
    let judge = |predictor: &Predictor<'_>| {
        let mut tally = Tally::new(arena);
        let limits = predictor.velocity_limits();
        let mut add = |number: usize, rollout: Rollout| {
            let window: &Window = &windows[number];
            tally.errors.add(&stream.material, &rollout.states, window.truth);
            if let Some(rest) = &rest {
                let sums = &mut tally.physics;
                window.measure(arena, &stream.material, rest, &rollout.states, sums);
            }
            let wild = |state| is_blown_up(state, &arena.extremes, limits, arena.domain);
            tally.windows += 1;
            tally.diverged += usize::from(rollout.diverged);
            tally.blown_up += usize::from(rollout.diverged || rollout.states.iter().any(wild));
        };
        if let Some(OnTheWay { steps, flight }) = predictor.roll_out(arena, &what, &mut add)? {
            (tally.steps, tally.flight) = (steps, flight);
        }
        Ok(tally)
    };
    let tallies = predictors.iter().map(judge).collect::<Result<_, EvalError>>()?;
    Ok(JudgedScene { id: stream.id, kind: Kind::of(&stream.material), tallies })
}
