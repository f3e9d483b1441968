//! Why processes cannot train together.

use std::{io, time::Duration};

/// Why processes cannot train together.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum RankError {
    /// A variable of the environment is missing or invalid.
    #[error("{name}: found {found}, expected {expected}")]
    Variable {
        /// The variable.
        name: &'static str,
        /// Its value, or nothing.
        found: String,
        /// The expected value.
        expected: String,
    },
    /// Rank 0 cannot listen.
    #[error(
        "rank 0 cannot listen on {address}: {reason}; set MASTER_PORT to another port (the next one above it is used)"
    )]
    Listen {
        /// Address and port.
        address: String,
        /// The system's error.
        reason: String,
    },
    /// Not all processes have connected to rank 0.
    #[error("rank 0 waited {} s at {address}: found {found} of {expected} processes ({variable}), missing rank {missing}", deadline.as_secs_f64())]
    Missing {
        /// Where rank 0 listened.
        address: String,
        /// How long it waited.
        deadline: Duration,
        /// Processes that are there.
        found: usize,
        /// Processes of the run.
        expected: usize,
        /// The variable that says so.
        variable: &'static str,
        /// Ranks that are not there.
        missing: String,
    },
    /// Rank 0 cannot be reached.
    #[error("rank {rank} found no rank 0 at {address} within {} s: {reason}", deadline.as_secs_f64())]
    NoAnswer {
        /// This process.
        rank: usize,
        /// Where rank 0 should listen.
        address: String,
        /// How long was tried.
        deadline: Duration,
        /// The last error.
        reason: String,
    },
    /// Processes have different data or settings.
    #[error("{who}: {field}: found {found}, expected {expected} as in rank 0")]
    Differs {
        /// The process that differs from rank 0.
        who: String,
        /// What differs.
        field: String,
        /// Its value there.
        found: String,
        /// Its value in rank 0.
        expected: String,
    },
    /// A process has a rank that another one has, or that is not one of this run.
    #[error("{who}: rank: found {found}, expected {expected}")]
    Rank {
        /// The process.
        who: String,
        /// Its rank.
        found: String,
        /// The ranks that it may have.
        expected: String,
    },
    /// Rank 0 has ended the rendezvous.
    #[error("rank 0 ended the rendezvous: {reason}")]
    Refused {
        /// What rank 0 says.
        reason: String,
    },
    /// A connection broke, or its process gave no sign of life.
    #[error("{who} was lost")]
    Lost {
        /// The process.
        who: String,
    },
    /// Another process ended with an error of its own.
    #[error("{who} ended: {reason}")]
    Failed {
        /// The process.
        who: String,
        /// Its error.
        reason: String,
    },
    /// This system does not start threads or share sockets between them.
    #[error("cannot watch the connections to other processes: {reason}")]
    System {
        /// The system's error.
        reason: String,
    },
}

impl RankError {
    pub(super) fn system(error: &io::Error) -> Self {
        Self::System { reason: error.to_string() }
    }
}
