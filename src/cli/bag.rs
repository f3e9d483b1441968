//! `eddy bag`: its subcommands.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use regex::Regex;

use super::{RecordArgs, ReplayArgs};
use eddy_bag::{BagTime, Compression};
use eddy_dataset::TRUTH_TOPIC;
use eddy_exchange::{ExportFormat, ImportFormat};
use eddy_frames::Material;
use eddy_settings::near;

/// `eddy bag`
#[derive(Debug, Args)]
pub struct BagArgs {
    #[command(subcommand)]
    pub command: BagCommand,
}

#[derive(Debug, Subcommand)]
pub enum BagCommand {
    /// Print topics, streams, size and times of a bag.
    Info {
        /// Bags (a directory with metadata.yaml, or an MCAP file), or directories of bags.
        #[arg(required = true, value_name = "BAG")]
        bags: Vec<PathBuf>,
        /// Print JSON instead of text: an object for each bag.
        #[arg(long)]
        json: bool,
    },
    /// Read every message of bags and list all problems; exit code 1 if there are any.
    Check {
        /// Bags, or directories of bags.
        #[arg(required = true, value_name = "BAG")]
        bags: Vec<PathBuf>,
    },
    /// Copy what can be read of a damaged or unfinished bag into a new one; exit code 3 if data was lost, 1 if nothing can
    /// be read.
    Recover(RecoverArgs),
    /// Copy a time range of a bag into a new one.
    Cut(CutArgs),
    /// Merge several bags into one, in the order of time.
    Merge(MergeArgs),
    /// Copy selected topics of a bag into a new one.
    Filter(FilterArgs),
    /// Same as `eddy replay`.
    #[command(hide = true)]
    Play(Box<ReplayArgs>),
    /// Same as `eddy record`.
    #[command(hide = true)]
    Record(Box<RecordArgs>),
    /// Same as `export --cloud`.
    #[command(hide = true)]
    Cloud(CloudArgs),
    /// Rewrite metadata.yaml, and missing or wrong summaries and indexes of files, from the messages.
    Reindex {
        /// Bag: a directory with MCAP files, or one of them.
        bag: PathBuf,
    },
    /// Export frames to formats of other programs, or add them to a bag as point clouds.
    Export(ExportArgs),
    /// Import trajectories from formats of other programs, as one bag per stream.
    Import(ImportArgs),
    /// Render a stream as a strip of frames (PNG) or an animation (GIF, animated PNG or MP4).
    Render(RenderArgs),
}

/// The output bag of a command.
#[derive(Debug, Args)]
pub struct NewBagArgs {
    /// Output bag.
    #[arg(long, short, value_name = "BAG")]
    pub output: PathBuf,
    /// Replace an existing bag.
    #[arg(long)]
    pub force: bool,
    /// Compression of chunks [default: as in the input; zstd if mixed].
    #[arg(long, value_enum)]
    pub compression: Option<Compression>,
    /// Entries of custom_data in metadata.yaml, beside those of the input; eddy_stiffness=E is Young's modulus of the recorded matter
    /// (density x velocity^2), eddy_gravity=G is gravity along y, negative is down (domain lengths per s^2) [default: none].
    #[arg(long, value_name = "KEY=VALUE", num_args = 1.., value_parser = eddy_cli::values::key_value)]
    pub custom_data: Vec<(String, String)>,
}

/// `eddy bag recover`
#[derive(Debug, Args)]
pub struct RecoverArgs {
    /// Bag: a directory, an .mcap file or an .mcap.active file. It is not modified.
    pub bag: PathBuf,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag cut`
#[derive(Debug, Args)]
pub struct CutArgs {
    /// Bag: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    /// Start time: recorded seconds since the first message, such as 2.5, or a log time as `eddy bag info` prints it, such as
    /// 2023-11-14T22:13:20Z, 1700000000.25 or 1700000000250000000ns [default: the first message].
    #[arg(long, value_name = "TIME")]
    pub start: Option<BagTime>,
    /// End time (exclusive), in the same format as --start [default: after the last message].
    #[arg(long, value_name = "TIME", conflicts_with = "duration")]
    pub end: Option<BagTime>,
    /// Duration from the start time (recorded s) [default: to the end].
    #[arg(long, value_name = "SECONDS", value_parser = eddy_cli::values::positive_seconds)]
    pub duration: Option<f64>,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag merge`
#[derive(Debug, Args)]
pub struct MergeArgs {
    /// Bags to merge; messages of the same time are written in the order of the bags.
    #[arg(value_name = "BAG", required = true, num_args = 2..)]
    pub bags: Vec<PathBuf>,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag filter`
#[derive(Debug, Args)]
pub struct FilterArgs {
    /// Bag: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    /// Topics to keep [default, without --regex: all that are not excluded].
    #[arg(long, value_name = "TOPIC", num_args = 1..)]
    pub topics: Vec<String>,
    /// Keep topics whose name matches [default: none beside --topics].
    #[arg(long, short = 'e')]
    pub regex: Vec<Regex>,
    /// Exclude topics whose name matches [default: none].
    #[arg(long, short = 'x')]
    pub exclude: Vec<Regex>,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag cloud`
#[derive(Debug, Args)]
pub struct CloudArgs {
    /// Bag: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag export`
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Bags, or directories of bags.
    #[arg(value_name = "BAG", required = true)]
    pub bags: Vec<PathBuf>,
    /// Output format [default: none; required without --cloud].
    #[arg(long, short, value_enum, required_unless_present = "cloud")]
    pub format: Option<ExportFormat>,
    /// Copy a bag and add its frames as sensor_msgs/PointCloud2 on TOPIC/cloud, for Foxglove, RViz and Rerun.
    #[arg(long, conflicts_with_all = ["format", "topic", "truth", "stream", "frames"])]
    pub cloud: bool,
    /// Compression of chunks with --cloud [default: as in the input].
    #[arg(long, value_enum, requires = "cloud")]
    pub compression: Option<Compression>,
    /// Output path: a file for csv, otherwise a directory; npz and vtkhdf (one stream) and gns write a single file if the
    /// name ends in .npz or .vtkhdf [default: named after the bag].
    #[arg(long, short, value_name = "PATH")]
    pub output: Option<PathBuf>,
    /// Replace an existing export.
    #[arg(long)]
    pub force: bool,
    /// Topic with the frames.
    #[arg(long, default_value = TRUTH_TOPIC)]
    pub topic: String,
    /// Bag with the true frames, on /particles: vtu and vtkhdf then have the error of each particle [default: the exported
    /// bag, if it has them and another topic is exported].
    #[arg(long, value_name = "BAG")]
    pub truth: Option<PathBuf>,
    /// Export only this stream [default: all].
    #[arg(long, value_name = "ID")]
    pub stream: Option<u64>,
    /// Export only the first N frames of each stream [default: all].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub frames: Option<u32>,
}

/// `eddy bag import`
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// File, or directory of files. Object arrays (pickles) are rejected.
    pub path: PathBuf,
    /// Input format.
    #[arg(long, short, value_enum)]
    pub format: ImportFormat,
    /// Output directory; one bag per stream.
    #[arg(long, short, value_name = "DIR")]
    pub output: PathBuf,
    /// Replace an existing directory of bags.
    #[arg(long)]
    pub force: bool,
    /// Time between two frames (s) [default: from the files].
    #[arg(long, value_name = "SECONDS")]
    pub dt: Option<f32>,
    /// Domain of particles in the plane (domain lengths) [default: from the files, or the unit square or cube].
    #[arg(long, num_args = 4, value_names = ["LEFT", "BOTTOM", "RIGHT", "TOP"], allow_negative_numbers = true)]
    pub domain: Option<Vec<f32>>,
    /// Material of all particles: liquid, snow, jelly, rope or sand [default: from the files].
    #[arg(long, value_parser = material)]
    pub material: Option<Material>,
    /// Entries of custom_data in metadata.yaml of each bag; eddy_stiffness=E is Young's modulus of the matter (density x velocity^2),
    /// eddy_gravity=G is gravity along y, negative is down (domain lengths per s^2) [default: from npz files].
    #[arg(long, value_name = "KEY=VALUE", num_args = 1.., value_parser = eddy_cli::values::key_value)]
    pub custom_data: Vec<(String, String)>,
}

fn material(word: &str) -> Result<Material, String> {
    let named = Material::ALL.into_iter().find(|material| material.name() == word);
    named.ok_or_else(|| {
        let hint = near::hint(word, Material::ALL.map(Material::name));
        format!("found {word}, expected liquid, snow, jelly, rope or sand{hint}")
    })
}

/// `eddy bag render`
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// Bag: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    /// Output path: *.png for a strip, *.gif, *.apng or *.mp4 (with ffmpeg) for an animation, otherwise a directory for
    /// strip.png and animation.gif.
    #[arg(long, short, value_name = "PATH")]
    pub output: PathBuf,
    /// Replace an existing picture or animation.
    #[arg(long)]
    pub force: bool,
    /// What colours show.
    #[arg(long, value_enum, default_value_t = Color::Material)]
    pub color: Color,
    /// Number of frames in the strip, evenly spaced.
    #[arg(long, value_name = "N", default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub frames: u32,
    /// Simulated time per time of the animation.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, value_parser = eddy_cli::values::positive)]
    pub rate: f64,
    /// Longer side of the domain (pixels) [default: 240 in the strip, 480 in the animation].
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(16..=4096))]
    pub size: Option<u32>,
    /// Topics with the frames; several are drawn as rows of the strip and side by side in an animation, matched by sequence
    /// number with the first.
    #[arg(long, default_values = [TRUTH_TOPIC], num_args = 1..)]
    pub topic: Vec<String>,
    /// Stream to render [default: the lowest].
    #[arg(long, value_name = "ID")]
    pub stream: Option<u64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Color {
    /// Material of the particles.
    Material,
    /// Speed of the particles.
    Speed,
}
