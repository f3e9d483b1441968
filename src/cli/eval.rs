//! `eddy eval`: predictors, data and the report.

use std::{num::NonZeroUsize, path::PathBuf};

use clap::{Args, ValueEnum};

use eddy_cli::Device;
use eddy_evaluation::DEFAULT_STARTS;
use eddy_inference::checkpoint::Rule;

/// Frames of each free rollout that are compared, by default.
pub const DEFAULT_HORIZON: usize = 100;

/// `eddy eval`
#[derive(Debug, Args)]
pub struct EvalArgs {
    /// Checkpoints to evaluate side by side, with the gain of each model over the first; those of one network from trainings on
    /// the same data with different seeds, all or none of them with --from, count as seeds of one model. particle-mingru is the
    /// shipped one [default: none; required without --compare].
    #[arg(long, value_name = "DIR", required_unless_present = "compare", num_args = 1..)]
    pub checkpoint: Vec<PathBuf>,
    /// Bags, or directories of bags [default: none; required without --compare].
    #[arg(long, value_name = "BAG", required_unless_present = "compare", num_args = 1..)]
    pub data: Vec<PathBuf>,
    /// Skip streams with a frame that cannot be used (not finite, outside of the domain, far too fast, of another dt or domain
    /// than the first stream), instead of refusing the data; they are counted and named.
    #[arg(long, conflicts_with = "compare")]
    pub skip_streams: bool,
    /// Output directory for report.html, report.json, curves.csv and cost_error.png; with --compare, an HTML file [default: none; required
    /// without --compare and --list-starts].
    #[arg(long, short, value_name = "DIR", required_unless_present_any = ["compare", "list_starts"])]
    pub output: Option<PathBuf>,
    /// Replace an existing report.
    #[arg(long)]
    pub force: bool,
    /// Also evaluate rollouts that another program has recorded, in a bag or a directory of bags: frames on /prediction and,
    /// for each, its first frame and horizon on /prediction/status, as a node publishes them [default: none].
    #[arg(long, value_name = "NAME=BAG", num_args = 1.., value_parser = recorded)]
    pub predictions: Vec<(String, PathBuf)>,
    /// Print the sequence numbers that rollouts start from as JSON and exit.
    #[arg(long, conflicts_with_all = ["output", "predictions"])]
    pub list_starts: bool,
    /// Print all tables of the report, not only the skill.
    #[arg(long)]
    pub tables: bool,
    /// Compare existing reports (directories, or their report.json) of the same data [default: none].
    #[arg(
        long,
        value_name = "REPORT",
        num_args = 2..,
        conflicts_with_all = [
            "checkpoint", "data", "predictions", "list_starts", "horizon", "starts", "stiffness", "references", "join_late", "without_rules", "threads", "device"
        ]
    )]
    pub compare: Vec<PathBuf>,
    /// Frames of each free rollout to compare with the truth; rollouts continue to frame 200 to detect divergence.
    #[arg(long, value_name = "N", default_value_t = DEFAULT_HORIZON)]
    pub horizon: usize,
    /// Start frames per stream, evenly spaced over its first 80 %.
    #[arg(long, value_name = "N", default_value_t = DEFAULT_STARTS)]
    pub starts: usize,
    /// Young's modulus of all streams (density x velocity^2), for checkpoints that are conditioned on the stiffness [default: what
    /// metadata.yaml of each bag states, otherwise the manifest.json of eddy simulate beside it, otherwise what the checkpoint assumes].
    #[arg(long, value_name = "E")]
    pub stiffness: Option<f32>,
    /// Reference predictors, started from the same frames; requires manifest.json beside the bags [default: none].
    #[arg(long, alias = "rivals", value_name = "NAME", value_enum, value_delimiter = ',')]
    pub references: Vec<ReferenceName>,
    /// Also evaluate each checkpoint on streams joined in the middle: it observes its warm-up, but no earlier frames.
    #[arg(long)]
    pub join_late: bool,
    /// Evaluate the checkpoints with these rules switched off; compare the report with one without this option to see the
    /// effect of the rules [default: none].
    #[arg(long, value_enum, value_name = "NAME", value_delimiter = ',', num_args = 1..)]
    pub without_rules: Vec<Rule>,
    /// Number of scenes to evaluate in parallel; inference times are those of one thread [default: one per core].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
    /// Where the checkpoints run: cpu, cuda for an
    /// NVIDIA GPU, cuda:1 for the second.
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = Device::parse)]
    pub device: Device,
}

/// Name and bag of recorded rollouts.
fn recorded(text: &str) -> Result<(String, PathBuf), String> {
    match text.split_once('=') {
        Some((name, bag)) if !name.is_empty() && !bag.is_empty() => Ok((name.into(), bag.into())),
        _ => Err(format!("found {text}, expected NAME=BAG")),
    }
}

/// A reference predictor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum ReferenceName {
    /// The solver restarted from positions and velocities: unchanged, with half the substeps, and with cells twice and
    /// four times as wide.
    Mpm,
    /// The solver from positions displaced by up to 1e-4: the limit of predictability.
    Chaos,
}
