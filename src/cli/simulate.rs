//! `eddy simulate`: scenes, and where they go.

use std::{num::NonZeroUsize, path::PathBuf};

use clap::Args;

use eddy_cli::{SceneArgs, values};
use eddy_transport::{Link, Reliability};

/// `eddy simulate`
#[derive(Debug, Args)]
pub struct SimulateArgs {
    #[command(flatten)]
    pub scenes: SceneArgs,
    /// Output directory; one bag per scene [default: none; required without --publish].
    #[arg(long, short, value_name = "DIR", required_unless_present = "publish")]
    pub output: Option<PathBuf>,
    /// Replace the scenes in the output directory; without it, the same command adds those that are missing.
    #[arg(long, requires = "output")]
    pub force: bool,
    /// Publish frames in real time, for example on zenoh:/particles, shm:/particles or dds:/particles, and the simulated
    /// time on /clock of the same transport [default: nowhere].
    #[arg(long, value_name = "LINK", value_parser = Link::from_argument)]
    pub publish: Option<Link>,
    /// Simulated time per real time when publishing.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, requires = "publish", value_parser = values::positive)]
    pub rate: f64,
    /// Wait for N subscribers before the first frame (at most 30 s).
    #[arg(long, value_name = "N", default_value_t = 0, requires = "publish")]
    pub wait_for: usize,
    /// What happens when a subscriber cannot keep up.
    #[arg(long, value_enum, default_value_t = Reliability::Block, requires = "publish")]
    pub reliability: Reliability,
    /// TOML file as `eddy tools` has: tools in place of the scene's, which move to the newest pose that has come on the transport of
    /// --publish [default: the tools of the scene].
    #[arg(long, value_name = "FILE", requires = "publish", conflicts_with = "output")]
    pub tools: Option<PathBuf>,
    /// Number of threads: one per scene, the remaining ones work within the scenes [default: one per scene, at most one
    /// per core].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
}
