//! `eddy bag`: its subcommands.

use std::path::PathBuf;

use clap::{Args, Subcommand, ValueEnum};
use regex::Regex;

use super::CompressionArg;
use eddy_bag::Moment;
use eddy_evaluation::dataset::TRUTH_TOPIC;
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
    /// Prints what is in a bag.
    Info {
        /// The bag: a directory with metadata.yaml, or an MCAP file.
        bag: PathBuf,
    },
    /// Reads every message of a bag and says what is wrong with it; exit code 1 if anything is.
    Check {
        /// The bag: a directory with metadata.yaml, or an MCAP file.
        bag: PathBuf,
    },
    /// Copies what can be read of a damaged or unfinished bag into a new one; exit code 3 if something
    /// is missing, 1 if nothing is left.
    Recover(RecoverArgs),
    /// Copies a part of the time of a bag into a new one.
    Cut(CutArgs),
    /// Copies several bags into one, in the order of time.
    Merge(MergeArgs),
    /// Copies some topics of a bag into a new one.
    Filter(FilterArgs),
    /// As `export --cloud`.
    #[command(hide = true)]
    Cloud(CloudArgs),
    /// Writes metadata.yaml anew, and the summaries that files lack, from the messages that are there.
    Reindex {
        /// The bag: a directory with MCAP files, or one of them.
        bag: PathBuf,
    },
    /// Writes the frames of bags as files of other programs, or as point clouds beside them.
    Export(ExportArgs),
    /// Writes the trajectories of other programs' files as bags, one a stream.
    Import(ImportArgs),
    /// Draws a stream: a strip of frames (PNG), an animation (GIF or animated PNG).
    Render(RenderArgs),
}

/// The bag that a command writes.
#[derive(Debug, Args)]
pub struct NewBagArgs {
    /// The new bag: a directory that does not exist yet.
    #[arg(long, short)]
    pub output: PathBuf,
    /// How chunks are compressed [default: as in the bag that is read; zstd if it is mixed].
    #[arg(long, value_enum)]
    pub compression: Option<CompressionArg>,
}

/// `eddy bag recover`
#[derive(Debug, Args)]
pub struct RecoverArgs {
    /// The bag: a directory, an .mcap file or an .mcap.active file. It is not touched.
    pub bag: PathBuf,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag cut`
#[derive(Debug, Args)]
pub struct CutArgs {
    /// The bag: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    /// The first moment to keep: recorded seconds from the start, such as 2.5, or a log time, such as
    /// 1700000000000000000ns [default: the start].
    #[arg(long)]
    pub start: Option<Moment>,
    /// The first moment not to keep any more, in the same words [default: none].
    #[arg(long, conflicts_with = "duration")]
    pub end: Option<Moment>,
    /// Keep so many recorded seconds from the first moment on.
    #[arg(long)]
    pub duration: Option<f64>,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag merge`
#[derive(Debug, Args)]
pub struct MergeArgs {
    /// The bags. Of messages of the same time, those of the first bag come first.
    #[arg(required = true, num_args = 2..)]
    pub bags: Vec<PathBuf>,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag filter`
#[derive(Debug, Args)]
pub struct FilterArgs {
    /// The bag: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    /// Keep these topics; without this and --regex, all that are not excluded.
    #[arg(long, num_args = 1..)]
    pub topics: Vec<String>,
    /// Keep topics in whose name this is found.
    #[arg(long, short = 'e')]
    pub regex: Vec<Regex>,
    /// Leave out topics in whose name this is found.
    #[arg(long, short = 'x')]
    pub exclude: Vec<Regex>,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag cloud`
#[derive(Debug, Args)]
pub struct CloudArgs {
    /// The bag: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    #[command(flatten)]
    pub new: NewBagArgs,
}

/// `eddy bag export`
#[derive(Debug, Args)]
pub struct ExportArgs {
    /// Bags, or directories of bags.
    #[arg(required = true)]
    pub bags: Vec<PathBuf>,
    /// What to write.
    #[arg(long, short, value_enum, required_unless_present = "cloud")]
    pub format: Option<ExportFormat>,
    /// Copy a bag with its frames also as sensor_msgs/PointCloud2, on TOPIC/cloud, which Foxglove, RViz
    /// and Rerun draw.
    #[arg(long, conflicts_with_all = ["format", "topic", "stream", "frames"])]
    pub cloud: bool,
    /// How chunks of the bag with the clouds are compressed [default: as in the bag that is read].
    #[arg(long, value_enum, requires = "cloud")]
    pub compression: Option<CompressionArg>,
    /// A path where nothing is yet; named after the bag if not given. A file for csv, otherwise a directory; npz (of one stream) and gns write a lone file when the name ends in .npz.
    #[arg(long, short)]
    pub output: Option<PathBuf>,
    /// The topic with the frames.
    #[arg(long, default_value = TRUTH_TOPIC)]
    pub topic: String,
    /// Only this stream.
    #[arg(long)]
    pub stream: Option<u64>,
    /// Only the first so many frames of each stream.
    #[arg(long, value_parser = clap::value_parser!(u32).range(1..))]
    pub frames: Option<u32>,
}

/// `eddy bag import`
#[derive(Debug, Args)]
pub struct ImportArgs {
    /// A file, or a directory of files. Object arrays are pickles and are refused.
    pub path: PathBuf,
    /// What they are.
    #[arg(long, short, value_enum)]
    pub format: ImportFormat,
    /// Where the bags go, one directory a stream: a directory that does not exist yet.
    #[arg(long, short)]
    pub output: PathBuf,
    /// Time between two frames (s) [default: what the files say].
    #[arg(long)]
    pub dt: Option<f32>,
    /// The box that holds the particles [default: what the files say, or the unit square].
    #[arg(long, num_args = 4, value_names = ["LEFT", "BOTTOM", "RIGHT", "TOP"], allow_negative_numbers = true)]
    pub domain: Option<Vec<f32>>,
    /// What all particles are made of: liquid, snow, jelly or rope [default: what the files say].
    #[arg(long, value_parser = material)]
    pub material: Option<Material>,
}

fn material(word: &str) -> Result<Material, String> {
    let named = Material::ALL.into_iter().find(|material| material.name() == word);
    named.ok_or_else(|| {
        let hint = near::hint(word, Material::ALL.map(Material::name));
        format!("found {word}, expected liquid, snow, jelly or rope{hint}")
    })
}

/// `eddy bag render`
#[derive(Debug, Args)]
pub struct RenderArgs {
    /// The bag: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    /// A path where nothing is yet: *.png for a strip, *.gif or *.apng for an animation, any other name for a directory with strip.png and animation.gif.
    #[arg(long, short)]
    pub output: PathBuf,
    /// What the colours mean.
    #[arg(long, value_enum, default_value_t = Color::Material)]
    pub color: Color,
    /// How many frames the strip shows, evenly spaced.
    #[arg(long, default_value_t = 8, value_parser = clap::value_parser!(u32).range(1..=64))]
    pub frames: u32,
    /// How much faster than simulated the animation runs.
    #[arg(long, default_value_t = 1.0)]
    pub rate: f64,
    /// Longer side of the domain in the pictures (pixels) [default: 240 in the strip, 480 in the animation].
    #[arg(long, value_parser = clap::value_parser!(u32).range(16..=4096))]
    pub size: Option<u32>,
    /// The topics with the frames. Several are drawn side by side: frames of the same sequence number as
    /// those of the first one.
    #[arg(long, default_values = [TRUTH_TOPIC], num_args = 1..)]
    pub topic: Vec<String>,
    /// The stream [default: the one with the lowest number].
    #[arg(long)]
    pub stream: Option<u64>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Color {
    /// What particles are made of.
    Material,
    /// How fast they are.
    Speed,
}
