//! Estimates of the errors of rollouts, and how well they hold.
//!
//! 1. [`Sample`]: features of a prediction, its error and that of the ballistic prediction.
//! 2. [`Calibration`] fits an [`ErrorModel`](eddy_inference::error_model::ErrorModel) to samples of many scenes, by the
//!    regressions of `fit`.
//! 3. [`Outcome`]: an estimate beside the error that it is about; [`Reliability`]: how well many of them hold.

mod calibration;
mod fit;
mod reliability;
mod sample;

pub use calibration::{Calibration, CalibrationRequest};
pub use reliability::{Bin, Outcome, Reliability};
pub use sample::Sample;
pub(crate) use sample::Sampler;
