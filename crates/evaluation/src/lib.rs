//! Evaluation of predictors by free rollouts.
//!
//! 1. [`context`]: settings, baselines' walls and error units, the same for all predictors; [`window`]: the frames
//!    of a stream from which rollouts start.
//! 2. [`predictor`]: everything that predicts: models ([`model_rollout`]: they see observed frames, then their
//!    own output), rollouts [`recorded`] by other programs, the trivial predictors ([`Baseline`](eddy_inference::engine::Baseline)), the solver [`restart`]ed from the same observation, and the truth from
//!    slightly displaced positions ([`chaos`]). [`task`] is what they predict, [`rollout`] the result.
//! 3. [`errors`]: squared errors summed over windows, by material and frame ahead; [`steps`]: the
//!    same for one-step predictions.
//! 4. [`measure`]: physical consistency: mass, energy, momentum, area, stretch, blow-ups.
//! 5. [`scene`]: all predictors on one scene, from the same frames; [`kind`]: the kind of a scene.
//! 6. [`skill`]: errors relative to the best baseline; [`bootstrap`]: confidence intervals over scenes.
//! 7. [`error_estimates`]: estimates of errors, fitted to rollouts, and how well they hold. [`cost`]: time per predicted frame.
//! 8. [`snapshot`]: frames of a rollout beside the true ones, for pictures.
//! 9. [`report`]: results as JSON, CSV, tables and a page; comparison of several reports.
//! 10. [`evaluation`]: from a request (checkpoints, streams) to the report; [`selection`]: the streams that no
//!     checkpoint was trained on; [`references`]: solvers that predict from the same frames.
//!
//! A thread evaluates one scene at a time, so at most one scene per thread is in memory; [`side_by_side`] says how many threads
//! there are.

pub mod bootstrap;
pub mod chaos;
mod context;
mod cost;
mod error_estimates;
mod errors;
mod evaluation;
mod kind;
mod linear_fit;
mod measure;
mod model_rollout;
mod normal_equations;
mod numbers;
mod predictor;
mod recorded;
mod references;
mod report;
mod reproduction;
mod restart;
mod rollout;
mod scene;
mod selection;
mod side_by_side;
mod skill;
mod snapshot;
mod steps;
mod task;
#[cfg(test)]
mod test_streams;
mod window;

pub use context::{Context, DEFAULT_STARTS, Settings};
pub use cost::{Cost, KindCost, time};
pub use error_estimates::{Bin, Calibration, CalibrationRequest, Outcome, Reliability, Sample};
pub use errors::{ErrorSums, Errors, Units};
pub use evaluation::{Evaluation, EvaluationError, EvaluationRequest, evaluate_model, short_names};
pub use kind::Kind;
pub use linear_fit::LinearFit;
pub use measure::{
    BlowUps, Bulk, FlightSums, Mean, Physics, SETTLED_AVERAGED, SETTLED_FRAMES, SETTLED_START,
    SHOWN_FRAMES, Settled, SettledState,
};
pub use predictor::Predictor;
pub use recorded::{Recorded, RecordedError};
pub use references::Reference;
pub use report::{
    Comparison, Entry, EvaluationResults, KindCount, Origin, PredictorInfo, Report, ReportError,
    Role, SCENE_FRAMES,
};
pub use restart::{Restart, Restarted};
pub use rollout::Rollout;
pub use scene::{Accumulator, SceneResult, evaluate_scene};
pub use side_by_side::rollout_threads;
pub use skill::{Interval, Skills, position_skill, skill_text};
pub use snapshot::{Snapshot, snapshot};
pub use steps::{StepResults, StepSums};
pub use window::starts;

use eddy_inference::engine::ModelError;
use eddy_mpm::MpmError;

/// Features of normalised errors: x, y, vx, vy.
const FEATURES: usize = 4;

/// Why streams cannot be evaluated.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "each variant's message shows its fields")]
pub enum EvalError {
    /// The model does not support the particles.
    #[error("stream {stream}: {reason}")]
    Model {
        /// Stream id.
        stream: u64,
        reason: ModelError,
    },
    /// The solver cannot reproduce the scene.
    #[error("stream {stream}: cannot simulate the scene again: {reason}")]
    Solver {
        /// Stream id.
        stream: u64,
        reason: MpmError,
    },
    /// Simulating the scene of a stream again does not reproduce the recorded frames.
    #[error(
        "stream {stream}: frame {frame}: simulating the scene again gives a different state than the recorded one"
    )]
    OtherTruth {
        /// Stream id.
        stream: u64,
        /// The frame, counted from the first of the stream.
        frame: usize,
    },
    /// The scene that a stream was simulated from is unknown.
    #[error("stream {stream}: no scene found to simulate it from")]
    NoScene {
        /// Stream id.
        stream: u64,
    },
    /// Recorded rollouts do not fit the stream.
    #[error("{name}: stream {stream}: {reason}")]
    Recorded {
        /// Name of the predictor.
        name: String,
        /// Stream id.
        stream: u64,
        reason: String,
    },
    /// Every stream is too short.
    #[error(
        "streams: the longest has {found} frames, expected at least {expected}: {warm_up} to observe and {horizon} to predict; choose a shorter horizon or longer scenes (with these, --horizon {} at most)",
        .found.saturating_sub(*.warm_up)
    )]
    TooShort {
        /// Frames of the longest stream.
        found: usize,
        /// Frames of one window.
        expected: usize,
        /// Frames observed.
        warm_up: usize,
        /// Frames predicted.
        horizon: usize,
    },
}

/// Compiles and runs the example of the README.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
