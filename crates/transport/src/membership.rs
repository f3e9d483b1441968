//! Membership of a group of processes that share work.

use std::{collections::BTreeSet, time::Duration};

use super::TransportError;

/// How others notice that this process is gone without a word: cut off from the network, or paused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Lease {
    /// Silence after which others consider this process dead.
    pub duration: Duration,
    /// Longest time between two signs of life of a process that runs.
    pub keep_alive: Duration,
}

/// This process in a group. A process whose connection is closed, as by its death, leaves at once; one that is silent
/// leaves after its [`Lease`].
pub trait Membership: Send {
    /// The id of this process, if it is announced or when it is announced next; it ends with `-` and the process's label.
    /// No id is used again after [`Membership::leave`].
    fn id(&self) -> &str;

    /// Announces this process to the group.
    ///
    /// # Errors
    /// [`TransportError`] when the middleware fails.
    fn join(&mut self) -> Result<(), TransportError>;

    /// Withdraws the announcement.
    fn leave(&mut self);

    /// The ids of the announced processes, as far as they are known here.
    fn members(&self) -> BTreeSet<String>;

    /// Whether this process is connected to any other, and has been since the last call.
    fn is_connected(&mut self) -> bool;

    /// How others notice the silence of this process.
    fn lease(&self) -> Lease;
}
