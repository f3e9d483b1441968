//! (under construction)

pub use crate::checkpoint::{Architecture, Core};

/// What computes.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum DeviceKind {
    /// burn-flex: this machine's CPU, the default.
    #[default]
    Flex,
    /// burn-ndarray: this machine's CPU; deprecated upstream, kept for comparison.
    Ndarray,
}
