//! The command line: what can be typed, with its defaults. What it means is in [`crate::commands`].

mod bag;
mod examples;
mod topic;

use std::{num::NonZeroUsize, path::PathBuf};

use clap::{Args, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum};
use clap_complete::Shell;
use regex::Regex;

use crate::commands::simulate;
use eddy_bag::Compression;
use eddy_lab::commands::{BenchArgs, StudyArgs};
use eddy_learning::model::{Architecture, Core, DeviceKind};
use eddy_mpm::Law;
use eddy_transport::{Link, ListenAddress, Reliability, TransportKind};

#[cfg(feature = "foxglove")]
use eddy_transport::FoxgloveAddress;

pub use bag::{
    BagArgs, BagCommand, CloudArgs, Color, CutArgs, ExportArgs, FilterArgs, ImportArgs, MergeArgs,
    NewBagArgs, RecoverArgs, RenderArgs,
};
pub use topic::{TopicArgs, TopicCommand, TopicEchoArgs, TopicHzArgs, TopicListArgs};

/// Recurrent surrogates for particle simulations, as ROS 2 / Zenoh nodes.
#[derive(Debug, Parser)]
#[command(name = "eddy", version, propagate_version = true)]
pub struct Cli {
    /// No progress bars, no live lines, no remarks on what was done.
    #[arg(long, short, global = true)]
    pub quiet: bool,

    /// What is logged to standard error: error, warn, info, debug or trace, or a filter such as `eddy=debug`.
    #[arg(
        long,
        global = true,
        // RustDDS logs the usual as errors, participants that come and go above all.
        default_value = "warn,zenoh=error,iceoryx2_bb_loggers=error,rustdds=off,ros2_client=error",
        env = "EDDY_LOG"
    )]
    pub log_level: String,

    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Simulates a scene, predicts it live, records both and judges the prediction.
    Demo(DemoArgs),
    /// Simulates ground truth with the Material Point Method and writes one bag a scene.
    Simulate(SimulateArgs),
    /// Records topics into an MCAP bag.
    Record(RecordArgs),
    /// Publishes the messages of a bag at their recorded times.
    Replay(ReplayArgs),
    /// Learns a surrogate from bags.
    Train(TrainArgs),
    /// Predicts the frames of live streams.
    Node(NodeArgs),
    /// Predicts the frames of a bag, with the node's own code.
    Predict(PredictArgs),
    /// Judges checkpoints by free rollouts over bags.
    Eval(EvalArgs),
    /// Runs the paper's comparisons: data, networks, judgement, one report.
    Study(StudyArgs),
    /// Runs several of these commands from one file, and restarts what fails.
    Launch(LaunchArgs),
    /// Looks into bags, and makes bags of bags.
    Bag(BagArgs),
    /// Looks at topics, without ROS.
    Topic(TopicArgs),
    /// Measures what this machine carries.
    Bench(BenchArgs),
    /// Prints a script that completes commands, options and values in a shell.
    Completions(CompletionsArgs),
    /// Writes manual pages, one a command.
    Man(ManArgs),
}

/// Everything that can be typed, with examples at the end of each command's long help.
pub fn command() -> clap::Command {
    examples::added(Cli::command())
}

impl Cli {
    /// What was typed; ends the process with help, or with what is wrong.
    pub fn read() -> Self {
        Self::from_arg_matches(&command().get_matches()).unwrap_or_else(|error| error.exit())
    }
}

/// `eddy completions`
#[derive(Debug, Args)]
pub struct CompletionsArgs {
    /// The shell; the script goes to standard output.
    pub shell: Shell,
}

/// `eddy man`
#[derive(Debug, Args)]
pub struct ManArgs {
    /// Where the pages go: eddy.1, eddy-node.1, eddy-bag-cut.1, ...
    pub output: PathBuf,
}

/// What ROS 2 gives to its nodes on the command line.
#[derive(Debug, Args)]
pub struct RosArgs {
    /// Arguments of ROS 2, up to `--` or the end: -r FROM:=TO (names of topics and services, __node, __ns),
    /// -p NAME:=VALUE, --params-file FILE, --log-level LEVEL.
    #[arg(
        long,
        num_args = 0..,
        allow_hyphen_values = true,
        value_terminator = "--",
        value_name = "ARGUMENTS"
    )]
    pub ros_args: Vec<String>,
}

impl Command {
    /// The arguments of ROS 2, for the node that this command is in the ROS graph.
    pub fn ros_args(&self) -> &[String] {
        match self {
            Self::Node(NodeArgs { ros, .. })
            | Self::Record(RecordArgs { ros, .. })
            | Self::Replay(ReplayArgs { ros, .. }) => &ros.ros_args,
            _ => &[],
        }
    }

    /// What the command is called in the ROS graph unless it is told otherwise.
    pub fn node_name(&self) -> &'static str {
        match self {
            Self::Record(_) => "eddy_record",
            Self::Replay(_) => "eddy_replay",
            _ => "eddy_node",
        }
    }
}

/// `eddy launch`
#[derive(Debug, Args)]
pub struct LaunchArgs {
    /// The launch file (TOML; launch_configs/ has examples).
    pub file: PathBuf,
}

/// `eddy demo`
#[derive(Debug, Args)]
pub struct DemoArgs {
    /// No page and no terminal needed: one scene, with a plain line every second instead of a live line.
    #[arg(long)]
    pub headless: bool,
    /// Port of the page, on the loopback interface; 0 takes any that is free.
    #[arg(long, default_value_t = 8080, conflicts_with = "headless")]
    pub port: u16,
    /// End after one scene of so many simulated seconds (it runs in real time) [default: scenes of 8 s, one after the
    /// other until SIGINT or SIGTERM, of which the first is recorded; only that one with --headless].
    #[arg(long)]
    pub seconds: Option<f64>,
    /// Seed of the scene.
    #[arg(long, default_value_t = 3)]
    pub seed: u64,
    /// The surrogate; the shipped particle model if not given.
    #[arg(long)]
    pub checkpoint: Option<PathBuf>,
    /// Where the bag and the report go.
    #[arg(long, short, default_value = "bags/demo")]
    pub output: PathBuf,
}

/// `eddy simulate`
#[derive(Debug, Args)]
pub struct SimulateArgs {
    /// Which random scenes, or which of the scenes that come with eddy.
    #[arg(long, value_parser = simulate::source::presets(), default_value = "multi-material")]
    pub preset: String,
    /// A scene of your own: a TOML file (launch_configs/scenes/ has examples).
    #[arg(long, value_name = "FILE", conflicts_with_all = ["preset", "scenes", "seed"])]
    pub scene: Option<PathBuf>,
    /// How many random scenes, with the ids 0, 1, 2, ...
    #[arg(long, default_value_t = 1)]
    pub scenes: u32,
    /// Seed of random scenes: the same seed gives the same bytes.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Particles of a random scene; 2500 if not given. The domain of more is wider, at the same
    /// spacing and height.
    #[arg(long, conflicts_with = "scene")]
    pub particles: Option<usize>,
    /// Length of a scene (simulated seconds); its own if not given.
    #[arg(long)]
    pub duration: Option<f64>,
    /// Substeps a frame; from the CFL rule if not given. An unstable number is refused.
    #[arg(long)]
    pub substeps: Option<u32>,
    /// Stiffness: Young's modulus E of every material (density x velocity^2); the scene's own if
    /// not given (1000, preset stiff: 1e5).
    #[arg(long)]
    pub stiffness: Option<f32>,
    /// How liquids resist: as water, or by the law of Taichi's mpm128; the scene's own (water) if not
    /// given.
    #[arg(long, value_enum)]
    pub law: Option<Law>,
    /// Kinematic viscosity of water (domain lengths^2 per s); the scene's own (0) if not given.
    #[arg(long)]
    pub viscosity: Option<f32>,
    /// Where the bags go: one directory a scene.
    #[arg(long, short, value_name = "DIR", required_unless_present = "publish")]
    pub output: Option<PathBuf>,
    /// Publish the frames at the pace of real time, for example on zenoh:/particles, shm:/particles or
    /// dds:/particles; the clock goes to /clock of the same transport.
    #[arg(long, value_name = "LINK")]
    pub publish: Option<Link>,
    /// How much faster than real time they are published.
    #[arg(long, default_value_t = 1.0, requires = "publish")]
    pub rate: f64,
    /// Wait for so many subscribers before the first frame (at most 30 s).
    #[arg(long, default_value_t = 0, requires = "publish")]
    pub wait_for: usize,
    /// What happens when a subscriber cannot keep up.
    #[arg(long, value_enum, default_value_t = Reliability::Block, requires = "publish")]
    pub reliability: Reliability,
    /// Threads: one a scene, and those left over share the work within the scenes. If not given, one a
    /// scene and at most one a core.
    #[arg(long)]
    pub threads: Option<NonZeroUsize>,
}

/// `eddy record`
#[derive(Debug, Args)]
pub struct RecordArgs {
    /// The links to record, for example zenoh:/particles zenoh:/prediction; the transports are shm,
    /// zenoh and dds.
    #[arg(required_unless_present_any = ["all", "regex"])]
    pub links: Vec<Link>,
    /// Record every topic that is published, also those that appear later.
    #[arg(long, short)]
    pub all: bool,
    /// Record every topic in whose name this is found, also those that appear later.
    #[arg(long, short = 'e')]
    pub regex: Vec<Regex>,
    /// Of those, leave out the topics in whose name this is found.
    #[arg(long, short = 'x')]
    pub exclude: Vec<Regex>,
    /// Where --all and --regex look for topics; a topic on several is recorded once.
    #[arg(long, value_delimiter = ',', default_values = ["zenoh", "shm"])]
    pub from: Vec<TransportKind>,
    /// The bag: a directory that does not exist yet.
    #[arg(long, short)]
    pub output: PathBuf,
    /// Begin a new file before one is larger than this (bytes).
    #[arg(long, short = 'b', visible_alias = "max-size", value_parser = clap::value_parser!(u64).range(1..))]
    pub max_bag_size: Option<u64>,
    /// Begin a new file when one is so long (seconds).
    #[arg(long, short = 'd', visible_alias = "max-duration")]
    pub max_bag_duration: Option<f64>,
    /// End after so many seconds; at SIGINT or SIGTERM if not given.
    #[arg(long)]
    pub stop_after: Option<f64>,
    /// End after so many messages.
    #[arg(long)]
    pub max_messages: Option<u64>,
    /// Memory for messages that wait to be written (bytes). When it is full, publishers that block wait
    /// up to 5 s; then, and from those that drop, messages are lost and counted.
    #[arg(long, default_value_t = 100 << 20)]
    pub max_cache_size: usize,
    /// How chunks are compressed.
    #[arg(long, value_enum, default_value_t = CompressionArg::Zstd)]
    pub compression: CompressionArg,
    #[command(flatten)]
    pub ros: RosArgs,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum CompressionArg {
    None,
    Lz4,
    Zstd,
}

impl From<CompressionArg> for Compression {
    fn from(arg: CompressionArg) -> Self {
        match arg {
            CompressionArg::None => Self::None,
            CompressionArg::Lz4 => Self::Lz4,
            CompressionArg::Zstd => Self::Zstd,
        }
    }
}

/// `eddy replay`
#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// The bag: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    /// The transport to publish on: zenoh, shm or dds.
    #[arg(long, default_value = "zenoh")]
    pub to: TransportKind,
    /// How much faster than recorded.
    #[arg(long, default_value_t = 1.0)]
    pub rate: f64,
    /// Start again at the end, until SIGINT or SIGTERM.
    #[arg(long = "loop")]
    pub looped: bool,
    /// Skip so many recorded seconds.
    #[arg(long, default_value_t = 0.0)]
    pub start_offset: f64,
    /// End after so many recorded seconds.
    #[arg(long)]
    pub duration: Option<f64>,
    /// Only these topics; all if not given.
    #[arg(long, num_args = 1..)]
    pub topics: Vec<String>,
    /// Publish the recorded time on /clock, so often a second [without a number: 40].
    #[arg(long, value_name = "HZ", num_args = 0..=1, default_missing_value = "40")]
    pub clock: Option<f64>,
    /// Wait for the space bar (on a terminal) before the first message.
    #[arg(long, short = 'p')]
    pub start_paused: bool,
    /// Publish a topic under another name: /particles:=/truth.
    #[arg(long, value_name = "FROM:=TO")]
    pub remap: Vec<String>,
    /// Wait for so many subscribers of every topic before the first message (at most 30 s).
    #[arg(long, default_value_t = 0)]
    pub wait_for: usize,
    /// What happens when a subscriber cannot keep up.
    #[arg(long, value_enum, default_value_t = Reliability::Block)]
    pub reliability: Reliability,
    /// Serve a live page of what is played on this port, address or both [without one: 127.0.0.1:8080]; port 0 takes any
    /// that is free.
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1:8080")]
    pub view: Option<ListenAddress>,
    #[command(flatten)]
    pub ros: RosArgs,
}

/// `eddy train`
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Bags, or directories of bags.
    #[arg(long, required = true, num_args = 1..)]
    pub data: Vec<PathBuf>,
    /// Where everything goes: the best checkpoint, the last epoch (last/), metrics.csv, TensorBoard's
    /// event files.
    #[arg(long, short)]
    pub output: PathBuf,
    /// Go on, bit for bit, with the run in the output, from its last finished epoch; begin one if there
    /// is none. Data, settings and device must be the same; only --epochs and patience may be others,
    /// and the schedules are then those of the new number.
    #[arg(long)]
    pub resume: bool,
    /// Settings from a TOML file; what is given here on the command line goes first.
    #[arg(long)]
    pub config: Option<PathBuf>,
    /// Which network.
    #[arg(long, value_enum)]
    pub architecture: Option<Architecture>,
    /// Which recurrent core.
    #[arg(long, value_enum)]
    pub core: Option<Core>,
    /// Most epochs.
    #[arg(long)]
    pub epochs: Option<u32>,
    /// Seed of initial weights, of the order of the data and of dropout. With several, each has a run
    /// of its own in OUTPUT/seed-N, and a table compares them.
    #[arg(long, num_args = 1..)]
    pub seed: Vec<u64>,
    /// Memory for the frames of the data (GiB); frames beyond it stay on disk and are read when they
    /// are needed, which changes nothing but the time [default: half of the memory that is available].
    #[arg(long, value_name = "GIB")]
    pub memory: Option<f64>,
    /// What computes.
    #[arg(long, value_enum, default_value_t = DeviceKind::Flex)]
    pub device: DeviceKind,
}

/// `eddy node`
#[derive(Debug, Args)]
pub struct NodeArgs {
    /// The surrogate; the shipped particle model if not given.
    #[arg(long)]
    pub checkpoint: Option<PathBuf>,
    /// Settings from a TOML file; what is given here on the command line goes first.
    #[arg(long)]
    pub config: Option<PathBuf>,
    /// Where frames come from, by shm, zenoh or dds [default: zenoh:/particles, in the namespace that
    /// --ros-args gives].
    #[arg(long)]
    pub input: Option<Link>,
    /// Where predictions go, by shm, zenoh or dds; several may be given
    /// [default: zenoh:/prediction, likewise].
    #[arg(long)]
    pub output: Vec<Link>,
    /// Frames predicted ahead of each observed frame [default: 1].
    #[arg(long)]
    pub horizon: Option<u32>,
    /// Which of the frames up to the horizon are published [default: last].
    #[arg(long, value_enum)]
    pub publish: Option<eddy_node::Publish>,
    /// Observe so many frames of a stream, then simulate it alone.
    #[arg(long)]
    pub free_run: Option<u64>,
    /// Publish observed and predicted frames also as sensor_msgs/PointCloud2 on INPUT/cloud and
    /// OUTPUT/cloud, for RViz, Foxglove and Rerun.
    #[arg(long)]
    pub cloud: bool,
    /// What happens when a subscriber cannot keep up [default: drop].
    #[arg(long, value_enum)]
    pub reliability: Option<Reliability>,
    /// Threads that predict; as many as there are cores if not given.
    #[arg(long)]
    pub threads: Option<NonZeroUsize>,
    /// Serve a live page of truth and prediction on this port, address or both [without one: 127.0.0.1:8080]; port 0 takes any
    /// that is free.
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1:8080")]
    pub view: Option<ListenAddress>,
    /// Show clouds, status and diagnostics to Foxglove's application, which connects to this port, address or both
    /// [without one: 127.0.0.1:8765].
    #[cfg(feature = "foxglove")]
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1:8765")]
    pub foxglove: Option<FoxgloveAddress>,
    #[command(flatten)]
    pub ros: RosArgs,
}

/// `eddy predict`
#[derive(Debug, Args)]
pub struct PredictArgs {
    /// The surrogate; the shipped particle model if not given.
    #[arg(long)]
    pub checkpoint: Option<PathBuf>,
    /// The bag with the frames.
    #[arg(long)]
    pub input: PathBuf,
    /// The bag with the predictions: a directory that does not exist yet.
    #[arg(long, short)]
    pub output: PathBuf,
    /// The topic with the frames.
    #[arg(long, default_value = "/particles")]
    pub topic: String,
    /// Frames predicted ahead of each observed frame.
    #[arg(long, default_value_t = 1)]
    pub horizon: u32,
    /// Which of the frames up to the horizon are published.
    #[arg(long, value_enum, default_value_t = eddy_node::Publish::Last)]
    pub publish: eddy_node::Publish,
    /// Threads that predict; as many as there are cores if not given.
    #[arg(long)]
    pub threads: Option<NonZeroUsize>,
}

/// `eddy eval`
#[derive(Debug, Args)]
pub struct EvalArgs {
    /// The checkpoints to judge, side by side; those that differ only in their training count as seeds
    /// of one model.
    #[arg(long, required_unless_present = "compare", num_args = 1..)]
    pub checkpoint: Vec<PathBuf>,
    /// Bags, or directories of bags.
    #[arg(long, required_unless_present = "compare", num_args = 1..)]
    pub data: Vec<PathBuf>,
    /// Where report.html, report.json, curves.csv and cost_error.png go; of a comparison, the HTML file.
    #[arg(long, short, required_unless_present = "compare")]
    pub output: Option<PathBuf>,
    /// Put reports of the same data side by side, folders or their report.json, instead of judging.
    #[arg(
        long,
        value_name = "REPORT",
        num_args = 2..,
        conflicts_with_all = [
            "checkpoint", "data", "horizon", "starts", "rivals", "join_late", "without_rules", "threads"
        ]
    )]
    pub compare: Vec<PathBuf>,
    /// Frames of the free rollouts that are compared with the truth; they go on to frame 200 to see
    /// whether they blow up.
    #[arg(long, default_value_t = 100)]
    pub horizon: usize,
    /// Start frames a stream, spread evenly over its first 80 %.
    #[arg(long, default_value_t = 7)]
    pub starts: usize,
    /// Who else predicts, from the same frames; needs the manifest.json beside the bags.
    #[arg(long, value_enum, value_delimiter = ',')]
    pub rivals: Vec<Rival>,
    /// Judge each checkpoint also on streams joined in the middle: it sees its warm-up, not the
    /// frames before.
    #[arg(long)]
    pub join_late: bool,
    /// Evaluate the checkpoints with these rules off, in place of the checkpoints as they are: what a rule is worth is the
    /// difference between the two reports. The report names each checkpoint with the rules it is without.
    #[arg(long, value_enum, value_name = "NAME", value_delimiter = ',', num_args = 1..)]
    pub without_rules: Vec<RuleName>,
    /// Scenes that are judged at a time; as many as there are cores if not given. The time of a frame
    /// is that of one thread.
    #[arg(long)]
    pub threads: Option<NonZeroUsize>,
}

/// A rule that corrects the particle model's predictions.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum RuleName {
    /// Liquids keep their area.
    Area,
    /// Jelly and rope keep their shape.
    Shape,
    /// Bodies that touch nothing keep momentum and spin.
    Flight,
    /// Bodies that touch a wall and hardly move come to rest.
    Rest,
}

/// Who predicts beside checkpoints and trivial predictors.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Rival {
    /// The solver restarted from positions and velocities: as it was, with half the substeps, with
    /// cells twice as wide.
    Mpm,
    /// The truth itself from positions that are off by up to 1e-4: how well anyone could predict.
    Chaos,
}

/// A time that may be waited for.
fn seconds(text: &str) -> Result<f64, String> {
    let seconds: f64 = text.parse().map_err(|error| format!("{error}"))?;
    if (0.0..=1e9).contains(&seconds) { Ok(seconds) } else { Err("expected 0 to 1e9 s".to_owned()) }
}
