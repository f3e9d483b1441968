//! Everything that predicts: models, other programs, baselines, reference solvers, and the truth itself.

use super::{
    Context, EvalError, LinearFit, Outcome, Recorded, Restart, Rollout, chaos,
    error_estimates::Sampler,
    model_rollout::{roll_out_from_first, roll_out_joined_late},
    steps::StepResults,
    task::RolloutTask,
};
use eddy_frames::State;
use eddy_inference::{
    engine::{Baseline, ModelError, Surrogate},
    error_model::CalibratedHorizon,
};
use eddy_mpm::MpmError;

/// A predictor.
#[derive(Clone, Copy)]
pub enum Predictor<'a> {
    /// A model that has observed the stream from its first frame on.
    Model(&'a Surrogate),
    /// A model that joined the stream in the middle and has observed its warm-up only.
    JoinedLate(&'a Surrogate),
    /// Another program, by the rollouts that it has recorded.
    Recorded(&'a Recorded),
    /// A trivial predictor.
    Baseline(Baseline),
    /// All particles in the mean state of the training data: the reference of z-score errors.
    Mean,
    /// Ten numbers fitted to the training data.
    LinearFit(LinearFit),
    /// The solver, restarted from the observed frame.
    Restart(Restart),
    /// The true simulation, slightly displaced.
    Chaos,
    /// The truth, for comparison of physical measures.
    Truth,
}

/// Frames ahead at which estimates of errors are compared with the errors: those of other results, and some in between, of which
/// 7, 30 and 70 are interpolated.
const JUDGED_FRAMES: [u32; 10] = [1, 3, 5, 7, 10, 20, 30, 50, 70, 100];

/// Results beside the rollouts themselves.
pub(super) struct RolloutOutcome {
    /// One-step predictions, for predictors that make them.
    pub(super) step_results: Option<StepResults>,
    /// Estimates of the errors of the rollouts, for models that make them.
    pub(super) estimates: Vec<Outcome>,
    /// Why rollouts failed.
    pub(super) failure: Option<String>,
}

impl Predictor<'_> {
    /// Rolls out from every start. `each` receives the index of the start and its rollout.
    pub(super) fn roll_out(
        &self,
        context: &Context,
        task: &RolloutTask<'_>,
        each: &mut dyn FnMut(usize, Rollout),
    ) -> Result<RolloutOutcome, EvalError> {
        let RolloutTask { stream, starts, reach, .. } = *task;
        let model_error = |reason: ModelError| EvalError::Model { stream: stream.id, reason };
        let solver_error = |reason: MpmError| EvalError::Solver { stream: stream.id, reason };
        let scene = || task.scene.ok_or(EvalError::NoScene { stream: stream.id });
        let (mut failure, mut estimates) = (None, Vec::new());
        let step_results = match *self {
            Self::Model(surrogate) => {
                let shown = JUDGED_FRAMES.iter();
                let calibrated: Vec<CalibratedHorizon> = surrogate
                    .error_model()
                    .map(|model| shown.filter_map(|&ahead| model.at(ahead)).collect())
                    .unwrap_or_default();
                let horizons: Vec<u32> = calibrated.iter().map(|at| at.frames).collect();
                let mut sampler = Sampler::new(surrogate, stream, &horizons);
                let steps = roll_out_from_first(surrogate, task, &mut sampler, each);
                let outcome = |sample| calibrated.iter().find_map(|at| Outcome::new(at, sample));
                estimates = sampler.finish().iter().filter_map(outcome).collect();
                Some(steps.map_err(model_error)?)
            }
            Self::JoinedLate(surrogate) => {
                roll_out_joined_late(surrogate, task, each).map_err(model_error)?;
                None
            }
            Self::Recorded(recorded) => {
                recorded.roll_out(task, each)?;
                None
            }
            Self::Baseline(baseline) => {
                let step = |state: &mut State, index| {
                    baseline.step(state, &context.ballistic, stream.sweep(index).as_ref());
                };
                Some(roll_out_simple(step, task, each))
            }
            Self::LinearFit(fit) => {
                let step = |state: &mut State, _| fit.step(state, context.ballistic.dt);
                Some(roll_out_simple(step, task, each))
            }
            Self::Mean => {
                let state = context.mean_state(stream.material.len());
                for (number, &start) in starts.iter().enumerate() {
                    let observed = &stream.states[start];
                    each(number, Rollout::collect(observed, reach, || Some(state.clone())));
                }
                None
            }
            Self::Restart(restart) => {
                let scene = scene()?;
                let outcome = restart.roll_out(scene, stream, starts, reach, each);
                failure = outcome.map_err(solver_error).err();
                let flight = restart.fly(scene, stream, task.flights);
                Some(StepResults { steps: None, flight })
            }
            Self::Chaos => {
                failure = chaos::roll_out(scene()?, stream, starts, reach, each).err();
                None
            }
            Self::Truth => Some(roll_out_truth(task, each)),
        };
        let failure = failure.map(|reason| reason.to_string());
        Ok(RolloutOutcome { step_results, estimates, failure })
    }
}

/// A predictor without a memory, which advances a state by a frame, from the frame with this index.
fn roll_out_simple(
    step: impl Fn(&mut State, usize),
    task: &RolloutTask<'_>,
    each: &mut dyn FnMut(usize, Rollout),
) -> StepResults {
    let states = &task.stream.states;
    for (number, &start) in task.starts.iter().enumerate() {
        let (mut state, mut frames) = (states[start].clone(), start..);
        let next = || {
            step(&mut state, frames.next()?);
            Some(state.clone())
        };
        each(number, Rollout::collect(&states[start], task.reach, next));
    }
    observe_steps(task, |index| {
        let mut state = states[index].clone();
        step(&mut state, index);
        state
    })
}

fn roll_out_truth(task: &RolloutTask<'_>, each: &mut dyn FnMut(usize, Rollout)) -> StepResults {
    let states = &task.stream.states;
    for (number, &start) in task.starts.iter().enumerate() {
        let mut after = states[start + 1..].iter();
        let mut last = &states[start];
        let next = || {
            last = after.next().unwrap_or(last);
            Some(last.clone())
        };
        each(number, Rollout::collect(&states[start], task.reach, next));
    }
    observe_steps(task, |index| states[index + 1].clone())
}

/// Accumulates the predictions of the frame after each frame.
fn observe_steps(task: &RolloutTask<'_>, after: impl Fn(usize) -> State) -> StepResults {
    let mut observer = task.observer();
    for index in 0..=observer.end() {
        let State { position, velocity } = after(index);
        observer.add(index, &position, &velocity);
    }
    observer.finish()
}
