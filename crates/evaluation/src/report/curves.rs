//! Errors over the frames ahead.

use serde::{Deserialize, Serialize};

use super::Report;
use crate::{Bulk, Errors, Mean, StepSums, numbers};

/// Error curves of free rollouts; one number per frame ahead.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Curves {
    /// Root mean square of |x - x'| (domain lengths).
    #[serde(deserialize_with = "numbers::list")]
    pub position_rmse: Vec<f64>,
    /// Root mean square of |v - v'| (domain lengths per second).
    #[serde(deserialize_with = "numbers::list")]
    pub velocity_rmse: Vec<f64>,
    /// Mean squared error of the features x, y, vx, vy, each divided by its range in the first checkpoint's training
    /// data.
    #[serde(deserialize_with = "numbers::list")]
    pub minmax_mse: Vec<f64>,
    /// As `minmax_mse`, divided by the standard deviation.
    #[serde(deserialize_with = "numbers::list")]
    pub zscore_mse: Vec<f64>,
}

/// Position errors of one-step predictions, for comparison with free rollouts; one number per frame ahead.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct StepCurves {
    /// Root mean square of |r_k| (domain lengths), the error of the frame k ahead of the start predicted from the true
    /// frame before it.
    #[serde(deserialize_with = "numbers::list")]
    pub one_step_rmse: Vec<f64>,
    /// Root mean square of |r_1 + ... + r_k| (domain lengths).
    #[serde(deserialize_with = "numbers::list")]
    pub cumulated_rmse: Vec<f64>,
}

/// Bulk quantities, means over windows; one number per frame ahead.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct BulkCurves {
    /// Kinetic energy per mass (domain lengths^2 per s^2).
    #[serde(deserialize_with = "numbers::list")]
    pub kinetic_energy: Vec<f64>,
    /// Root mean square distance of the centre of mass from the true one (domain lengths).
    #[serde(deserialize_with = "numbers::list")]
    pub centre_rmse: Vec<f64>,
    /// Share of the particles beyond an effective wall by more than half a spacing (0 to 1).
    #[serde(deserialize_with = "numbers::list")]
    pub outside: Vec<f64>,
}

impl BulkCurves {
    /// The curves from sums; `None` without sums.
    pub(super) fn new(sums: &[Bulk]) -> Option<Self> {
        let curve = |of: fn(&Bulk) -> &Mean| sums.iter().map(move |sums| of(sums).value());
        (!sums.is_empty()).then(|| Self {
            kinetic_energy: curve(|sums| &sums.kinetic_energy).collect(),
            centre_rmse: curve(|sums| &sums.centre).map(f64::sqrt).collect(),
            outside: curve(|sums| &sums.outside).collect(),
        })
    }
}

impl Report {
    /// Frames ahead up to which mean curves are drawn: beyond, the mean is of fewer rollouts, and a step would look like a
    /// failure of every predictor. Tables have all frames, with the number of rollouts.
    pub fn drawn_frames(&self) -> usize {
        match self.complete {
            0 => {
                let all =
                    self.shown.iter().zip(&self.compared).filter(|(_, n)| **n == self.windows);
                all.map(|(&ahead, _)| ahead).next_back().unwrap_or(self.horizon)
            }
            complete => complete,
        }
    }

    /// The part of a curve over frames ahead that is drawn.
    pub(super) fn drawn<'a>(&self, curve: &'a [f64]) -> &'a [f64] {
        &curve[..curve.len().min(self.drawn_frames())]
    }

    /// A sentence on curves that end before the horizon.
    pub(super) fn curves_note(&self) -> Option<String> {
        let drawn = self.drawn_frames();
        (drawn < self.horizon).then(|| {
            format!(
                "Mean curves end at frame {drawn}, the last at which all {} rollouts have a true frame; the tables go on \
                 with fewer rollouts.",
                self.windows
            )
        })
    }
}

impl Curves {
    /// The curves from sums, one per frame ahead.
    pub(super) fn new(errors: &[Errors]) -> Self {
        let curve = |f: fn(&Errors) -> f64| errors.iter().map(f).collect();
        Self {
            position_rmse: curve(Errors::position_rmse),
            velocity_rmse: curve(Errors::velocity_rmse),
            minmax_mse: curve(Errors::minmax_mse),
            zscore_mse: curve(Errors::zscore_mse),
        }
    }
}

impl StepCurves {
    /// The curves from sums.
    pub(super) fn new(steps: &StepSums) -> Self {
        Self { one_step_rmse: steps.single_rmse(), cumulated_rmse: steps.cumulated_rmse() }
    }
}
