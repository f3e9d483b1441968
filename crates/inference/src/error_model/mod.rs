//! How far a prediction is expected to be off, from what its stream has shown so far.
//!
//! 1. `tracker`: the features of a stream: recent errors of one-step predictions, recent motion, and how far a rollout departs
//!    from a ballistic one ([`ErrorTracker`]).
//! 2. `regression`: linear functions of features, with the distribution of what they leave unexplained ([`Regression`]).
//! 3. `file`: `error_model.toml` in a checkpoint's directory.
//!
//! For each calibrated number of frames ahead there are two functions of the features: a linear regression of the logarithm of
//! the mean squared position error, and a logistic one of whether a ballistic prediction is better. `eddy calibrate` (crate
//! `eddy-evaluation`) fits both to free rollouts over scenes that the model was not trained on. Residuals are those of scenes
//! left out of the fit, so that their quantiles hold for new scenes of the same kinds (split conformal prediction, Vovk et al.
//! 2005, with cross-validation).

mod file;
mod regression;
mod tracker;

pub use file::ERROR_MODEL_FILE;
pub(crate) use file::{load, parse};
pub use regression::{LEVELS, Linear, Regression};
pub use tracker::{ErrorTracker, FEATURES, Features};

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
    /// Of ln(mean squared position error) (domain lengths squared).
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
    /// The root mean square position error is below this with a probability of [`UPPER_LEVEL`] (domain lengths).
    pub upper: f32,
    /// Probability that a ballistic prediction has a smaller error.
    pub worse_than_ballistic: f32,
}

impl ErrorModel {
    /// The estimate for a prediction `horizon` frames ahead: interpolated between calibrated numbers of frames in ln(horizon).
    /// `None` beyond the last of them.
    pub fn estimate(&self, features: &Features, horizon: u32) -> Option<ErrorEstimate> {
        let after = self.horizons.iter().position(|at| at.frames >= horizon)?;
        let [from, to] = [after.saturating_sub(1), after].map(|at| &self.horizons[at]);
        let part = match (horizon.checked_sub(from.frames), to.frames - from.frames) {
            (Some(beyond), 1..) if beyond > 0 => {
                let ln = |frames: u32| f64::from(frames).ln();
                ((ln(horizon) - ln(from.frames)) / (ln(to.frames) - ln(from.frames))) as f32
            }
            _ => 0.0,
        };
        // At or before the first calibrated number of frames, both are the same.
        let [from, to] = if to.frames == horizon { [to, to] } else { [from, to] };
        let mix = |[a, b]: [f32; 2]| a + part * (b - a);
        let quantile = |level: f32| {
            let of = |at: &CalibratedHorizon| at.error.quantile(features, level);
            (0.5 * mix([of(from), of(to)])).exp()
        };
        let probability = |at: &CalibratedHorizon| at.worse_than_ballistic.probability(features);
        Some(ErrorEstimate {
            horizon,
            expected: quantile(0.5),
            upper: quantile(UPPER_LEVEL),
            worse_than_ballistic: mix([probability(from), probability(to)]),
        })
    }
}
