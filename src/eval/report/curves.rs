//! Errors over the frames ahead.

use serde::Serialize;

use crate::eval::{Errors, StepSums};

/// Error curves of free rollouts; one number a frame ahead.
#[derive(Clone, Debug, Serialize)]
pub struct Curves {
    /// Root mean square of |x - x'| (domain lengths).
    pub position_rmse: Vec<f64>,
    /// Root mean square of |v - v'| (domain lengths per second).
    pub velocity_rmse: Vec<f64>,
    /// Mean squared error of the features x, y, vx, vy, each divided by its range in the training of
    /// the first checkpoint.
    pub minmax_mse: Vec<f64>,
}

/// Position errors of predicted next frames beside those of free rollouts; one number a frame ahead.
#[derive(Clone, Debug, Serialize)]
pub struct StepCurves {
    /// Root mean square of |r_k| (domain lengths): the frame k ahead of the start, predicted from the
    /// true one before.
    pub one_step_rmse: Vec<f64>,
    /// Root mean square of |r_1 + ... + r_k| (domain lengths).
    pub cumulated_rmse: Vec<f64>,
}

impl Curves {
    /// The curves of sums, one a frame ahead.
    pub(super) fn new(errors: &[Errors]) -> Self {
        let curve = |f: fn(&Errors) -> f64| errors.iter().map(f).collect();
        Self {
            position_rmse: curve(Errors::position_rmse),
            velocity_rmse: curve(Errors::velocity_rmse),
            minmax_mse: curve(Errors::minmax_mse),
        }
    }
}

impl StepCurves {
    /// The curves of sums.
    pub(super) fn new(steps: &StepSums) -> Self {
        Self { one_step_rmse: steps.single_rmse(), cumulated_rmse: steps.cumulated_rmse() }
    }
}
