//! Judges predictions by free rollouts.
//!
//! 1. [`window`]: from which frames of a stream rollouts start.
//! 2. [`predictor`]: whatever predicts: models ([`rollout`]: fed with their own output, they see
//!    observed frames only), trivial [`baseline`]s, the solver [`restart`]ed from the same observation,
//!    the truth from positions that are slightly off ([`chaos`]).
//! 3. [`errors`]: squared errors summed over windows, for each material and frame ahead; [`steps`]: the
//!    same for predictions of the next frame only.
//! 4. [`measure`]: what physics asks for: mass, energy, momentum, area, stretch, no blow-up.
//! 5. [`scene`]: one scene judged, every predictor from the same frames; [`kind`]: its heading.
//! 6. [`skill`]: errors against the best baseline; [`bootstrap`]: intervals over scenes.
//! 7. [`cost`]: time of a predicted frame.
//! 8. [`snapshot`]: frames of a rollout beside the true ones, to look at.
//! 9. [`report`]: all of it as JSON, CSV, tables and a page; several reports side by side.
//! 10. [`evaluation`]: a request from its checkpoints and streams to the report; [`selection`]: the streams that no
//!     checkpoint has seen; [`references`]: solvers that predict from the same frames.
//!
//! Scenes are judged one at a time, so that no more than one is in memory for each thread.

mod arena;
mod baseline;
pub mod bootstrap;
pub mod chaos;
mod cost;
pub mod dataset;
mod errors;
mod evaluation;
mod kind;
mod measure;
mod numbers;
pub mod page;
pub mod picture;
mod predictor;
mod references;
mod report;
mod restart;
mod rollout;
mod scene;
mod selection;
mod skill;
mod snapshot;
mod steps;
mod window;

pub use arena::{Arena, Settings};
pub use baseline::Baseline;
pub use cost::{Cost, KindCost, time};
pub use errors::{ErrorSums, Errors, Units, mean_squared_distance};
pub use evaluation::{Evaluation, EvaluationError, EvaluationRequest, evaluate_model, short_names};
pub use kind::Kind;
pub use measure::{BlowUps, Bulk, FlightSums, Mean, Physics, SHOWN};
pub use predictor::Predictor;
pub use references::Reference;
pub use report::{
    Comparison, Contestant, Entry, Judged, KindCount, Origin, Report, ReportError, Role,
    SCENE_FRAMES,
};
pub use restart::{Restart, Restarted};
pub use rollout::Rollout;
pub use scene::{JudgedScene, Tally, judge_scene};
pub use skill::{Interval, Skills};
pub use snapshot::{Snapshot, snapshot};
pub use steps::{OnTheWay, StepSums};
pub use window::starts;

use eddy_inference::engine::ModelError;
use eddy_mpm::MpmError;

/// Features that normalised errors are taken of: x, y, vx, vy.
const FEATURES: usize = 4;

/// Why streams cannot be judged.
#[derive(Debug, thiserror::Error)]
pub enum EvalError {
    /// The model cannot take the particles.
    #[error("stream {stream}: {reason}")]
    Model {
        /// The stream.
        stream: u64,
        /// What the model says.
        reason: ModelError,
    },
    /// The solver cannot simulate the scene again.
    #[error("stream {stream}: simulating it again: {reason}")]
    Rival {
        /// The stream.
        stream: u64,
        /// What the solver says.
        reason: MpmError,
    },
    /// The scene of a stream does not come to what was recorded.
    #[error(
        "stream {stream}: frame {frame}: found another state than the recorded one when simulating it again, expected the same"
    )]
    OtherTruth {
        /// The stream.
        stream: u64,
        /// The frame, counted from the first of the stream.
        frame: usize,
    },
    /// It is not known what a stream was simulated from.
    #[error("stream {stream}: found no scene, expected what it was simulated from")]
    NoScene {
        /// The stream.
        stream: u64,
    },
    /// No stream is long enough.
    #[error(
        "streams: the longest has {found} frames, expected at least {expected}: {warm_up} to observe and {horizon} to predict"
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

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
