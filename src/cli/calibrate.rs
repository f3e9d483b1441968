//! `eddy calibrate`: the checkpoint and the data.

use std::{num::NonZeroUsize, path::PathBuf};

use clap::Args;

use eddy_cli::Device;
use eddy_evaluation::DEFAULT_STARTS;

/// `eddy calibrate`
#[derive(Debug, Args)]
pub struct CalibrateArgs {
    /// Checkpoint whose errors to estimate; error_model.toml is written beside its files.
    #[arg(long, value_name = "DIR")]
    pub checkpoint: PathBuf,
    /// Bags, or directories of bags, with at least 10 streams that the checkpoint was not trained on.
    #[arg(long, value_name = "BAG", required = true, num_args = 1..)]
    pub data: Vec<PathBuf>,
    /// Skip streams with a frame that cannot be used (not finite, outside of the domain, far too fast, of another dt or domain
    /// than the first stream), instead of refusing the data; they are counted and named.
    #[arg(long)]
    pub skip_streams: bool,
    /// Replace an existing error_model.toml.
    #[arg(long)]
    pub force: bool,
    /// Largest number of frames ahead to estimate errors for.
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub horizon: usize,
    /// Start frames per stream, evenly spaced over its first 80 %.
    #[arg(long, value_name = "N", default_value_t = DEFAULT_STARTS)]
    pub starts: usize,
    /// Young's modulus of all streams (density x velocity^2), for a checkpoint that is conditioned on the stiffness [default: what
    /// metadata.yaml of each bag states, otherwise the manifest.json of eddy simulate beside it, otherwise what the checkpoint assumes].
    #[arg(long, value_name = "E")]
    pub stiffness: Option<f32>,
    /// Number of scenes to roll out in parallel [default: one per core].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
    /// Where the checkpoint runs: cpu, cuda for an
    /// NVIDIA GPU, cuda:1 for the second.
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = Device::parse)]
    pub device: Device,
}
