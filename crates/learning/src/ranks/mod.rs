//! Processes that train one network together, each on a GPU of its own, as torchrun and Slurm start them.
//!
//! 1. `environment`: which of them this process is.
//! 2. `message`: what processes send each other.
//! 3. `rendezvous`: they find each other at rank 0, which checks that all train the same.
//! 4. `group`: the connections stay open: rank 0 decides when to stop, and all learn when one is lost.

mod environment;
mod error;
mod group;
mod message;
mod rendezvous;

pub use environment::Process;
pub use error::RankError;
pub use group::{Group, Timing};

/// A process of this run, with how it uses the others.
#[derive(Clone, Copy)]
pub struct ProcessOptions<'a> {
    /// Its place among the processes.
    pub process: &'a Process,
    /// How long to wait for the others.
    pub timing: Timing,
    /// Called with a sentence when another process was lost and this one does not come back from a library within
    /// [`Timing::abandon`]: it should print the sentence and end the process.
    pub abandon: &'static (dyn Fn(&str) + Sync),
}

impl std::fmt::Debug for ProcessOptions<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ProcessOptions").field("process", self.process).finish_non_exhaustive()
    }
}
