//! Whatever predicts: models, baselines, rivals, and the truth itself.

use super::{
    Arena, Baseline, EvalError, Restart, Rollout, chaos,
    measure::Flights,
    rollout::{roll_out_from_first, roll_out_joined_late},
    steps::{Follower, OnTheWay},
};
use crate::dataset::{State, Stream};
use eddy_inference::engine::{Ballistic, ModelError, Surrogate};
use eddy_mpm::{MpmError, Scene};

/// Whatever predicts.
#[derive(Clone, Copy)]
pub enum Predictor<'a> {
    /// A model that has observed the stream from its first frame on.
    Model(&'a Surrogate),
    /// A model that joined the stream in the middle: it has seen its warm-up.
    JoinedLate(&'a Surrogate),
    /// What learns nothing.
    Baseline(Baseline),
    /// Every particle as it was on average in the training: what z-score errors are measured by.
    Mean,
    /// The solver, restarted.
    Restart(Restart),
    /// The truth, slightly displaced.
    Chaos,
    /// The truth: what measures give for it is what they are to be compared with.
    Truth,
}

/// What is to be predicted.
#[derive(Clone, Copy)]
pub(super) struct Predicting<'a> {
    pub(super) stream: &'a Stream,
    /// What the stream was simulated from.
    pub(super) scene: Option<&'a Scene>,
    /// The frames that rollouts start from.
    pub(super) starts: &'a [usize],
    /// Free flight in the stream.
    pub(super) flights: &'a Flights,
    /// Frames ahead that are compared with the truth.
    pub(super) horizon: usize,
    /// Length of a rollout (frames).
    pub(super) reach: usize,
}

impl<'a> Predicting<'a> {
    /// Who follows predictions of next frames.
    pub(super) fn follower(&self) -> Follower<'a> {
        Follower::new(self.stream, self.starts, self.flights, self.horizon)
    }
}

/// What else there is to say of rollouts from every start.
pub(super) struct RolledOut {
    /// Predictions of next frames, where there are any.
    pub(super) on_the_way: Option<OnTheWay>,
    /// Why rollouts were lost.
    pub(super) failure: Option<String>,
}

impl Predictor<'_> {
    /// Rolls out from every start. `each` gets the number of the start and its rollout.
    pub(super) fn roll_out(
        &self,
        arena: &Arena,
        what: &Predicting<'_>,
        each: &mut dyn FnMut(usize, Rollout),
    ) -> Result<RolledOut, EvalError> {
        let Predicting { stream, starts, reach, .. } = *what;
        let of_model = |reason: ModelError| EvalError::Model { stream: stream.id, reason };
        let of_rival = |reason: MpmError| EvalError::Rival { stream: stream.id, reason };
        let scene = || what.scene.ok_or(EvalError::NoScene { stream: stream.id });
        let mut failure = None;
        let on_the_way = match *self {
            Self::Model(surrogate) => {
                Some(roll_out_from_first(surrogate, what, each).map_err(of_model)?)
            }
            Self::JoinedLate(surrogate) => {
                roll_out_joined_late(surrogate, what, each).map_err(of_model)?;
                None
            }
            Self::Baseline(baseline) => {
                Some(roll_out_baseline(baseline, &arena.ballistic, what, each))
            }
            Self::Mean => {
                let state = arena.mean_state(stream.material.len());
                for (number, &start) in starts.iter().enumerate() {
                    let observed = &stream.states[start];
                    each(number, Rollout::collect(observed, reach, || Some(state.clone())));
                }
                None
            }
            Self::Restart(restart) => {
                let scene = scene()?;
                let done = restart.roll_out(scene, stream, starts, reach, each);
                failure = done.map_err(of_rival).err();
                let flight = restart.fly(scene, stream, what.flights);
                Some(OnTheWay { steps: None, flight })
            }
            Self::Chaos => {
                failure = chaos::roll_out(scene()?, stream, starts, reach, each).err();
                None
            }
            Self::Truth => Some(roll_out_truth(what, each)),
        };
        Ok(RolledOut { on_the_way, failure: failure.map(|reason| reason.to_string()) })
    }
}

fn roll_out_baseline(
    baseline: Baseline,
    ballistic: &Ballistic,
    what: &Predicting<'_>,
    each: &mut dyn FnMut(usize, Rollout),
) -> OnTheWay {
    for (number, &start) in what.starts.iter().enumerate() {
        let states = baseline.roll_out(&what.stream.states[start], what.reach, ballistic);
        each(number, Rollout { states, diverged: false });
    }
    follow(what, |index| baseline.roll_out(&what.stream.states[index], 1, ballistic).swap_remove(0))
}

fn roll_out_truth(what: &Predicting<'_>, each: &mut dyn FnMut(usize, Rollout)) -> OnTheWay {
    let states = &what.stream.states;
    for (number, &start) in what.starts.iter().enumerate() {
        let mut after = states[start + 1..].iter();
        let mut last = &states[start];
        let next = || {
            last = after.next().unwrap_or(last);
            Some(last.clone())
        };
        each(number, Rollout::collect(&states[start], what.reach, next));
    }
    follow(what, |index| states[index + 1].clone())
}

/// Follows what is predicted for the frame after each frame.
fn follow(what: &Predicting<'_>, after: impl Fn(usize) -> State) -> OnTheWay {
    let mut follower = what.follower();
    for index in 0..=follower.end() {
        let State { position, velocity } = after(index);
        follower.add(index, &position, &velocity);
    }
    follower.finish()
}
