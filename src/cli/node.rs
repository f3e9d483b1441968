//! `eddy node`: links, settings, and how the node shows itself.

use std::{num::NonZeroUsize, path::PathBuf};

use clap::Args;

use super::RosArgs;
use eddy_cli::{Device, RealTimeArgs};
use eddy_node::surrogate::NodeOptions;
use eddy_transport::{Link, ListenAddress, Reliability};

#[cfg(feature = "foxglove")]
use eddy_transport::FoxgloveAddress;

/// `eddy node`
#[derive(Debug, Args)]
pub struct NodeArgs {
    /// Checkpoint of the surrogate [default: the shipped particle model].
    #[arg(long, value_name = "DIR")]
    pub checkpoint: Option<PathBuf>,
    /// Read settings from a TOML file; command-line options override it [default: no file].
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Link to observe, on shm, zenoh or dds, for example dds:/particles, or dds:particles in the namespace of --ros-args
    /// [default: /particles in that namespace].
    #[arg(long, value_name = "LINK", value_parser = Link::parse_of_node)]
    pub input: Option<Link>,
    /// Link to publish predictions on; may be repeated [default: /prediction in the namespace of --ros-args].
    #[arg(long, value_name = "LINK", value_parser = Link::parse_of_node)]
    pub output: Vec<Link>,
    #[command(flatten)]
    pub settings: NodeOptions,
    /// What happens when a subscriber cannot keep up [default: drop].
    #[arg(long, value_enum)]
    pub reliability: Option<Reliability>,
    /// Number of threads for prediction [default: one per core]; on a GPU, of those that copy frames to it and back
    /// [default: one per core, at most 8].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
    /// Where the network runs: cpu, cuda for an
    /// NVIDIA GPU, cuda:1 for the second.
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = Device::parse)]
    pub device: Device,
    /// Serve a live page of truth and prediction on this port, address or both; port 0 takes any free port
    /// [without a value: 127.0.0.1:8080].
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1:8080")]
    pub view: Option<ListenAddress>,
    /// Serve point clouds, status and diagnostics to Foxglove on this port, address or both
    /// [without a value: 127.0.0.1:8765].
    #[cfg(feature = "foxglove")]
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1:8765")]
    pub foxglove: Option<FoxgloveAddress>,
    /// Also let pages of this origin connect to --foxglove, for example http://localhost:8080; may be repeated
    /// [default: Foxglove's application only].
    #[cfg(feature = "foxglove")]
    #[arg(long, value_name = "ORIGIN", requires = "foxglove")]
    pub foxglove_origin: Vec<String>,
    /// Start unconfigured and predict only while a ROS 2 lifecycle manager has the node active (zenoh and dds).
    #[arg(long)]
    pub lifecycle: bool,
    #[command(flatten)]
    pub real_time: RealTimeArgs,
    #[command(flatten)]
    pub ros: RosArgs,
}
