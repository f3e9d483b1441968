//! Several processes of eddy from one file: started together, restarted when they fail, ended together.
//!
//! 1. [`plan`](Plan): the file.
//! 2. `backoff`: whether and when what failed starts again.
//! 3. `process`: one process, its lines, its end.
//! 4. [`supervise`]: all of them.
//!
//! Each process has a process group of its own, so that Ctrl-C reaches it once, through here; and is told
//! by the system when this one is killed (on Linux).

mod backoff;
mod plan;
mod process;
mod supervise;

use std::io;

pub use plan::{InvalidPlan, OnExit, Plan, ProcessPlan, RestartPlan};
pub use process::Said;
pub use supervise::{Outcome, supervise};

/// Why a plan came to a bad end.
#[derive(Debug, thiserror::Error)]
pub enum LaunchError {
    /// A process cannot be started or looked after.
    #[error("{name}: {action}: {reason}")]
    System {
        /// Its name.
        name: String,
        /// What was tried.
        action: &'static str,
        /// What the system said.
        reason: io::Error,
    },
    /// A process does not understand its arguments; to start it again would change nothing.
    #[error("{name}: found wrong usage (exit code 2), expected the arguments of an eddy command")]
    Usage {
        /// Its name.
        name: String,
    },
    /// A process did not end well, and is not started again.
    #[error("{name}: found {found}, expected it to end well")]
    Ended {
        /// Its name.
        name: String,
        /// How it ended.
        found: String,
    },
    /// A process has failed too often.
    #[error("{name}: found {found}, expected no more than {limit} restarts in a row")]
    Failed {
        /// Its name.
        name: String,
        /// How it ended last.
        found: String,
        /// How often it was started again.
        limit: u32,
    },
}
