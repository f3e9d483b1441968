//! What takes the steps of a run: the network on the run's device through burn, batch by batch, or a GPU, many batches
//! at once.

use std::sync::Arc;

#[cfg(feature = "cuda")]
use super::cuda;
use super::{
    Run, TrainConfig, TrainError,
    gradients::{BatchGradient, GradientTask},
    knots,
    schedule::Batches,
    state::RunState,
    validate,
    window::{self, Sampler, Window},
};
#[cfg(feature = "cuda")]
use crate::model::DeviceKind;
use eddy_dataset::Dataset;
use eddy_inference::{
    checkpoint::{Checkpoint, Description},
    engine::Surrogate,
};

/// What came of a batch.
pub(super) struct Step {
    /// The loss before the step.
    pub(super) loss: f32,
    pub(super) learning_rate: f64,
    /// Norm of the gradient, before clipping.
    pub(super) gradient_norm: f64,
    /// Whether the gradient is finite. Through burn, it is 0 where it was not.
    pub(super) finite: bool,
    /// Stream and first frame of each window.
    pub(super) windows: Vec<(u64, usize)>,
}

impl Step {
    /// Rejects a loss or a gradient that is not finite; epoch and batch are counted from 1.
    pub(super) fn check(&self, epoch: u32, batch: usize) -> Result<(), TrainError> {
        let windows = || window::names(&self.windows);
        if !self.loss.is_finite() {
            let found = self.loss;
            return Err(TrainError::NotFinite { epoch, batch, windows: windows(), found });
        }
        if !self.finite {
            return Err(TrainError::GradientNotFinite { epoch, batch, windows: windows() });
        }
        Ok(())
    }
}

/// What takes the steps.
pub(super) enum Learner {
    /// burn, with the weights in the run's state.
    Burn,
    /// A GPU, with weights of its own.
    #[cfg(feature = "cuda")]
    Cuda(Box<cuda::Learner>),
}

impl Learner {
    /// For a run on its device.
    pub(super) fn new(
        run: &Run,
        config: &TrainConfig,
        description: &Description,
        dataset: &Dataset,
    ) -> Result<Self, TrainError> {
        match run.device {
            #[cfg(feature = "cuda")]
            DeviceKind::Cuda(number) => {
                let (number, streams) = (number.into(), &dataset.train);
                let (gpu, free) = (run.gpu, run.machine.memory);
                let learner = cuda::Learner::new(number, gpu, free, config, description, streams)?;
                Ok(Self::Cuda(Box::new(learner)))
            }
            _ => {
                let _ = (config, description, dataset);
                Ok(Self::Burn)
            }
        }
    }

    /// Whether an epoch may take less time than saving it.
    pub(super) fn is_fast(&self) -> bool {
        !matches!(self, Self::Burn)
    }

    /// Batches that are prepared and run at once.
    pub(super) fn group(&self) -> usize {
        match self {
            Self::Burn => 1,
            #[cfg(feature = "cuda")]
            Self::Cuda(_) => cuda::BATCHES,
        }
    }

    /// Begins a stage with the weights of the run's state.
    #[cfg_attr(not(feature = "cuda"), expect(clippy::unnecessary_wraps, reason = "a GPU can fail"))]
    pub(super) fn begin(
        &mut self,
        task: &GradientTask,
        state: &RunState,
    ) -> Result<(), TrainError> {
        match self {
            Self::Burn => {
                let _ = (task, state);
                Ok(())
            }
            #[cfg(feature = "cuda")]
            Self::Cuda(learner) => learner.begin(task, state),
        }
    }

    /// Takes the steps of batches of a stage: draws windows, computes gradients, changes the weights.
    pub(super) fn steps(
        &mut self,
        task: &GradientTask,
        sampler: &mut Sampler,
        batches: &Batches,
        state: &mut RunState,
    ) -> Result<Vec<Step>, TrainError> {
        let Batches { rates, left, .. } = batches;
        match self {
            Self::Burn => {
                rates.iter().map(|&rate| step(task, sampler, *left, rate, state)).collect()
            }
            #[cfg(feature = "cuda")]
            Self::Cuda(learner) => learner.steps(task, sampler, rates, state),
        }
    }

    /// A model with the weights of `checkpoint`, which were those of the run's state when it was brought up to date last.
    pub(super) fn surrogate(&mut self, checkpoint: &Checkpoint) -> Result<Surrogate, TrainError> {
        match self {
            Self::Burn => validate::one_thread(checkpoint),
            #[cfg(feature = "cuda")]
            Self::Cuda(learner) => learner.surrogate(checkpoint),
        }
    }

    /// Brings the run's state up to date with the weights.
    #[cfg_attr(not(feature = "cuda"), expect(clippy::unnecessary_wraps, reason = "a GPU can fail"))]
    pub(super) fn sync(&self, state: &mut RunState) -> Result<(), TrainError> {
        match self {
            Self::Burn => {
                let _ = state;
                Ok(())
            }
            #[cfg(feature = "cuda")]
            Self::Cuda(learner) => learner.sync(state),
        }
    }
}

/// A step through burn: batch, loss, backward, clip, Adam.
fn step(
    task: &GradientTask,
    sampler: &mut Sampler,
    left: usize,
    learning_rate: f64,
    state: &mut RunState,
) -> Result<Step, TrainError> {
    let windows = sampler.batch(task.config.windows.batch, || left, &mut state.order)?;
    let stiffnesses = windows.iter().map(|window| window.stiffness);
    let of_knots = &task.config.network.stiffness_knots;
    let shares = knots::shares(of_knots, stiffnesses);
    let weights = state.weights_of_step(of_knots, &shares);
    let BatchGradient { loss, gradients } = task.compute(&weights, &windows, &mut state.dropout);
    drop(weights);
    let windows = windows.iter().map(Window::origin).collect();
    if !loss.is_finite() {
        return Ok(Step { loss, learning_rate, gradient_norm: f64::NAN, finite: true, windows });
    }
    let mut step = state.optimizer.step(learning_rate, &task.config.optimizer).measured();
    for (tensor, values) in Arc::make_mut(&mut state.weights).iter_mut().enumerate() {
        let gradient = &gradients[tensor % gradients.len()];
        let share = shares[tensor / gradients.len()];
        if !gradient.is_empty() && share > 0.0 {
            step.change_by_share(tensor, values, gradient, share); // clips it first
        }
    }
    Ok(Step { loss, learning_rate, gradient_norm: step.gradient_norm(), finite: true, windows })
}
