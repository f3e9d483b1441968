//! Nodes that share streams: each stream is predicted by one member of a group.
//!
//! 1. [`ownership`]: the owner of a stream among the members, by rendezvous hashing.
//! 2. [`standing`]: what a node knows of its group, and what it may publish; time as an argument.
//! 3. [`member`]: a thread that keeps a node in its group.

mod member;
mod ownership;
mod standing;

pub use member::GroupMember;
pub(super) use standing::Epoch;
pub use standing::GroupCounts;
