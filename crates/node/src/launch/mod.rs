//! Several eddy processes from one file: started together, restarted on failure, shut down together.
//!
//! 1. [`plan`](Plan): the launch file.
//! 2. `backoff`: whether and when to restart a failed process.
//! 3. `process`: one process and its output.
//! 4. [`supervise`]: all processes, from start to shutdown.
//!
//! Each process has its own process group, so that Ctrl-C reaches it once, through the supervisor. On Linux the system
//! interrupts it when the supervisor is killed.

mod backoff;
mod plan;
mod process;
mod supervise;

use std::io;

pub use plan::{InvalidPlan, OnExit, Plan, ProcessPlan, RestartPlan};
pub use process::OutputLine;
pub use supervise::{LaunchSummary, supervise};

/// Why a launch failed.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum LaunchError {
    /// A process cannot be started or controlled.
    #[error("{name}: cannot {action}: {reason}")]
    System { name: String, action: &'static str, reason: io::Error },
    /// A process rejects its arguments, so that a restart is useless.
    #[error("{name}: wrong usage (exit code 2); check its `run` arguments")]
    Usage { name: String },
    /// A process failed and is not restarted.
    #[error("{name}: failed: {found}")]
    Ended { name: String, found: String },
    /// A process has failed too often.
    #[error("{name}: failed again after {limit} consecutive restarts: {found}")]
    Failed { name: String, found: String, limit: u32 },
}
