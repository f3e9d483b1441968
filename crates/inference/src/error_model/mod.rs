//! How far a prediction is expected to be off, from what its stream has shown so far.
//!
//! 1. `tracker`: the features of a stream: recent errors of one-step predictions, recent motion, and how far a rollout departs
//!    from a ballistic one ([`ErrorTracker`]).
//! 2. `regression`: linear functions of features, with the distribution of what they leave unexplained ([`Regression`]).
//! 3. `file`: `error_model.toml` in a checkpoint's directory.
//!
//! For each calibrated number of frames ahead there are two functions of the features: a linear regression of the logarithm of
//! the mean squared position error, and a logistic one of whether a ballistic prediction is better. `eddy calibrate` (crate
//! `eddy-evaluation`) fits both to free rollouts over scenes that the model was not trained on. The quantiles of the residuals are
//! those of scenes left out of the fit, so that they hold, about, for new scenes of the same kinds (as CV+ of Barber et al. 2021,
//! without its correction for the number of scenes).

mod file;
mod regression;
mod tracker;

pub use file::ERROR_MODEL_FILE;
pub(crate) use file::{load, parse};
pub use regression::{LEVELS, Linear, Regression};
pub use tracker::{ErrorTracker, FEATURES, Features, log_square};

#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

/// The level of [`ErrorEstimate::upper`].
pub const UPPER_LEVEL: f32 = 0.9;

/// Calibrated estimates of the error of one checkpoint.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ErrorModel {
    /// Version of the format: 1.
    pub format_version: u32,
    /// Digest of the checkpoint, `Checkpoint::digest`.
    pub checkpoint: String,
    /// Digest of the streams it was calibrated on.
    pub data: String,
    /// Streams it was calibrated on.
    pub streams: usize,
    /// Free rollouts of the calibration.
    pub rollouts: usize,
    /// Fingerprints of the streams (`Trajectory::fingerprint`).
    pub seen: Vec<String>,
    /// In increasing order of frames ahead.
    pub horizons: Vec<CalibratedHorizon>,
}

/// Estimates for one number of frames ahead.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CalibratedHorizon {
    /// Frames ahead.
    pub frames: u32,
    /// Of [`log_square`] of the mean squared position error.
    pub error: Regression,
    /// The logit of the probability that a ballistic prediction has a smaller error.
    pub worse_than_ballistic: Linear,
}

/// The expected error of a prediction.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ErrorEstimate {
    /// Frames ahead.
    pub horizon: u32,
    /// Median of the root mean square position error over the particles (domain lengths).
    pub expected: f32,
    /// About [`UPPER_LEVEL`] of the root mean square position errors of such predictions are below this (domain lengths).
    pub upper: f32,
    /// Probability that a ballistic prediction has a smaller error.
    pub worse_than_ballistic: f32,
}

impl ErrorModel {
    /// The estimates `horizon` frames ahead: interpolated between calibrated numbers of frames in ln(horizon), those of the first
    /// before it. `None` beyond the last.
    pub fn at(&self, horizon: u32) -> Option<CalibratedHorizon> {
        let after = self.horizons.iter().position(|at| at.frames >= horizon)?;
        let to = &self.horizons[after];
        let Some(from) = after.checked_sub(1).map(|before| &self.horizons[before]) else {
            return Some(CalibratedHorizon { frames: horizon, ..to.clone() });
        };
        let [ln, ln_from, ln_to] = [horizon, from.frames, to.frames].map(|n| f64::from(n).ln());
        let part = ((ln - ln_from) / (ln_to - ln_from)) as f32;
        Some(CalibratedHorizon {
            frames: horizon,
            error: from.error.towards(&to.error, part),
            worse_than_ballistic: from.worse_than_ballistic.towards(&to.worse_than_ballistic, part),
        })
    }
}

impl CalibratedHorizon {
    /// The estimate for a prediction.
    pub fn estimate(&self, features: &Features) -> ErrorEstimate {
        let quantile = |level: f32| (0.5 * self.error.quantile(features, level)).exp();
        ErrorEstimate {
            horizon: self.frames,
            expected: quantile(0.5),
            upper: quantile(UPPER_LEVEL),
            worse_than_ballistic: self.worse_than_ballistic.probability(features),
        }
    }
}
