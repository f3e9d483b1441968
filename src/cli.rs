//! The command line. What its commands do is in [`crate::commands`].

mod bag;
mod calibrate;
mod eval;
mod examples;
mod node;
mod service;
mod simulate;
mod tools;
mod topic;
mod topics;

use std::{num::NonZeroUsize, path::PathBuf};

use clap::{
    Args, CommandFactory, Parser, Subcommand, ValueEnum,
    error::{ContextKind, ContextValue, ErrorKind},
};
use clap_complete::Shell;
use regex::Regex;

use eddy_bag::Compression;
use eddy_cli::{
    Device,
    arguments::{self, GlobalArgs},
    values,
};
use eddy_learning::{
    model::{Architecture, Core, DeviceKind, GpuOptions, Precision},
    train::Recipe,
};
use eddy_node::surrogate::PredictOptions;
use eddy_transport::{Link, ListenAddress, Reliability, TransportKind};

pub use bag::{
    BagArgs, BagCommand, CloudArgs, Color, CutArgs, ExportArgs, FilterArgs, ImportArgs, MergeArgs,
    NewBagArgs, RecoverArgs, RenderArgs,
};
pub use calibrate::CalibrateArgs;
pub use eval::{DEFAULT_HORIZON, EvalArgs, ReferenceName};
pub use node::NodeArgs;
pub use service::{
    ParamArgs, ParamCommand, SearchArgs, ServiceArgs, ServiceCallArgs, ServiceCommand,
    ServiceListArgs,
};
pub use simulate::SimulateArgs;
pub use tools::ToolsArgs;
pub use topic::{TopicArgs, TopicCommand, TopicEchoArgs, TopicHzArgs, TopicListArgs};

/// Recurrent surrogates for particle simulations, as ROS 2 / Zenoh nodes.
#[derive(Debug, Parser)]
#[command(name = "eddy", version, propagate_version = true, max_term_width = 100)]
pub struct Cli {
    #[command(flatten)]
    pub global: GlobalArgs,

    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Simulate scenes and predict them live, side by side on a page.
    ///
    /// The first scene and its predictions are recorded and evaluated.
    Demo(DemoArgs),
    /// Simulate scenes with the Material Point Method, one bag each.
    Simulate(SimulateArgs),
    /// Record topics into an MCAP bag.
    Record(RecordArgs),
    /// Publish the messages of a bag at their recorded times.
    Replay(ReplayArgs),
    /// Train a surrogate on bags.
    Train(TrainArgs),
    /// Predict frames of live streams.
    Node(NodeArgs),
    /// Publish where a robot's tools are at each frame.
    ///
    /// Their poses come from topics or from /tf, and are paired with frames of particles by their stamps.
    Tools(ToolsArgs),
    /// Predict frames of a bag, with the code of the node.
    Predict(PredictArgs),
    /// Evaluate checkpoints by free rollouts over bags.
    Eval(EvalArgs),
    /// Calibrate a checkpoint's estimates of its errors.
    ///
    /// Nodes and `eddy eval` state them. They come from free rollouts over bags.
    Calibrate(CalibrateArgs),
    /// Run several eddy processes from one file and restart those that fail.
    Launch(LaunchArgs),
    /// Inspect, check, repair, edit, convert and render bags.
    Bag(BagArgs),
    /// Inspect topics, without ROS.
    Topic(TopicArgs),
    /// List and call services of nodes, without ROS.
    Service(ServiceArgs),
    /// Read and set parameters of nodes, without ROS.
    Param(ParamArgs),
    /// List the devices that networks can be trained on.
    Devices,
    /// Print a shell completion script.
    Completions(CompletionsArgs),
    /// Write manual pages, one per command.
    Man(ManArgs),
}

/// The command line, with a first screen of commands in groups, topics of help, and examples at the end of each command's
/// long help.
pub fn command() -> clap::Command {
    arguments::prepared(topics::with_topics(Cli::command()), examples::EXAMPLES)
}

impl Cli {
    /// Parses the arguments of this process; exits after printing help or an error.
    pub fn read() -> Self {
        let read = arguments::read::<Self>(command());
        read.unwrap_or_else(|error| rejected(&error)).without_aliases()
    }

    /// The commands of `ros2 bag` as what they are here.
    fn without_aliases(self) -> Self {
        let command = match self.command {
            Command::Bag(BagArgs { command: BagCommand::Play(args) }) => Command::Replay(*args),
            Command::Bag(BagArgs { command: BagCommand::Record(args) }) => Command::Record(*args),
            other => other,
        };
        Self { command, ..self }
    }
}

/// Commands that are now those of `eddy-lab`.
const OF_THE_LAB: [&str; 3] = ["bench", "plan", "study"];

/// Prints help or an error, and exits.
fn rejected(error: &clap::Error) -> ! {
    if let Some(ContextValue::String(word)) = error.get(ContextKind::InvalidSubcommand)
        && OF_THE_LAB.contains(&word.as_str())
    {
        eprintln!("eddy: {word} is a command of the program eddy-lab: `eddy-lab {word} ...`");
        std::process::exit(error.exit_code());
    }
    if error.kind() == ErrorKind::InvalidSubcommand {
        let _ = error.print();
        eprintln!("`eddy help TOPIC` explains {}.", topics::listed());
        std::process::exit(error.exit_code());
    }
    error.exit()
}

/// `eddy completions`
#[derive(Debug, Args)]
pub struct CompletionsArgs {
    /// Shell to complete for; the script goes to standard output.
    pub shell: Shell,
}

/// `eddy man`
#[derive(Debug, Args)]
pub struct ManArgs {
    /// Output directory for eddy.1, eddy-node.1, eddy-bag-cut.1, ...
    #[arg(value_name = "DIR")]
    pub output: PathBuf,
}

/// The ROS 2 arguments of a node.
#[derive(Debug, Args)]
pub struct RosArgs {
    /// ROS 2 arguments, up to `--` or the end: -r FROM:=TO (topics, services, __node, __ns), -p NAME:=VALUE,
    /// --params-file FILE, --log-level LEVEL [default: none].
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
    /// The ROS 2 arguments of the node that this command runs.
    pub fn ros_args(&self) -> &[String] {
        match self {
            Self::Node(NodeArgs { ros, .. })
            | Self::Record(RecordArgs { ros, .. })
            | Self::Replay(ReplayArgs { ros, .. })
            | Self::Tools(ToolsArgs { ros, .. }) => &ros.ros_args,
            _ => &[],
        }
    }

    /// Whether the log of this command is published on `/rosout`. A recorder would record its own.
    pub fn has_log_topic(&self) -> bool {
        matches!(self, Self::Node(_) | Self::Replay(_) | Self::Tools(_))
    }

    /// Default name of the node that this command runs.
    pub fn node_name(&self) -> &'static str {
        match self {
            Self::Record(_) => "eddy_record",
            Self::Replay(_) => "eddy_replay",
            Self::Tools(_) => "eddy_tools",
            _ => "eddy_node",
        }
    }
}

/// `eddy launch`
#[derive(Debug, Args)]
pub struct LaunchArgs {
    /// Launch file (TOML); launch_configs/launch/ has examples.
    pub file: PathBuf,
}

/// What `eddy demo` simulates.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, ValueEnum)]
pub enum DemoScene {
    /// Bodies of two materials that are thrown.
    #[default]
    Throw,
    /// The same, and a blade that follows the mouse or the arrow keys on the live page.
    Push,
}

/// `eddy demo`
#[derive(Debug, Args)]
pub struct DemoArgs {
    /// Run without live page and terminal: one scene, with a line per second instead of a live line.
    #[arg(long)]
    pub headless: bool,
    /// Port of the live page on the loopback interface; 0 takes any free port.
    #[arg(long, default_value_t = 8080, conflicts_with = "headless")]
    pub port: u16,
    /// Stop after one scene of this duration (s, in real time) [default: scenes of up to 5 s (push: 20 s) until SIGINT or SIGTERM, of
    /// which the first is recorded; with --headless only the first, of 5 s].
    #[arg(long, value_name = "SECONDS", value_parser = values::positive_seconds)]
    pub seconds: Option<f64>,
    /// What is simulated.
    #[arg(long, value_enum, default_value_t = DemoScene::Throw)]
    pub scene: DemoScene,
    /// Seed of the scene.
    #[arg(long, default_value_t = 3)]
    pub seed: u64,
    /// Checkpoint of the surrogate [default: the shipped particle model].
    #[arg(long, value_name = "DIR")]
    pub checkpoint: Option<PathBuf>,
    /// Output directory for bag and report [default: bags/demo, or the first of bags/demo-2, bags/demo-3, ... that does
    /// not exist].
    #[arg(long, short, value_name = "DIR")]
    pub output: Option<PathBuf>,
    /// Replace an existing output of a demo.
    #[arg(long)]
    pub force: bool,
}

/// `eddy record`
#[derive(Debug, Args)]
pub struct RecordArgs {
    /// Links to record, for example /particles zenoh:/prediction shm:/particles; transports are shm, zenoh and dds. Those that
    /// are not published yet are waited for.
    #[arg(value_name = "LINK", required_unless_present_any = ["all", "regex"], value_parser = Link::from_argument)]
    pub links: Vec<Link>,
    /// Record all topics, including those that appear later.
    #[arg(long, short)]
    pub all: bool,
    /// Record all topics whose name matches, including those that appear later [default: none].
    #[arg(long, short = 'e')]
    pub regex: Vec<Regex>,
    /// Exclude topics whose name matches [default: none].
    #[arg(long, short = 'x')]
    pub exclude: Vec<Regex>,
    /// Transports on which --all and --regex search; a topic on several transports is recorded once.
    #[arg(long, value_name = "TRANSPORT", value_delimiter = ',', default_values = ["zenoh", "shm"], env = "EDDY_TRANSPORT", hide_env_values = true)]
    pub from: Vec<TransportKind>,
    /// Output bag [default: eddy_DATE-TIME, in UTC].
    #[arg(long, short, value_name = "BAG")]
    pub output: Option<PathBuf>,
    /// Replace an existing bag.
    #[arg(long)]
    pub force: bool,
    /// Start a new file before one exceeds this size (bytes) [default: one file of any size].
    #[arg(long, short = 'b', value_name = "BYTES", visible_alias = "max-size", value_parser = clap::value_parser!(u64).range(1..))]
    pub max_bag_size: Option<u64>,
    /// Start a new file after this time (s) [default: one file of any duration].
    #[arg(long, short = 'd', value_name = "SECONDS", visible_alias = "max-duration", value_parser = values::positive_seconds)]
    pub max_bag_duration: Option<f64>,
    /// Stop after this time (s) [default: at SIGINT or SIGTERM].
    #[arg(long, value_name = "SECONDS", value_parser = values::positive_seconds)]
    pub stop_after: Option<f64>,
    /// Stop after this number of messages [default: at SIGINT or SIGTERM].
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub max_messages: Option<u64>,
    /// Memory for messages waiting to be written (bytes). When it is full, blocking publishers wait up to 5 s; after that,
    /// and from other publishers, messages are dropped and counted.
    #[arg(long, value_name = "BYTES", default_value_t = 100 << 20)]
    pub max_cache_size: usize,
    /// Compression of chunks.
    #[arg(long, value_enum, default_value_t = Compression::Zstd)]
    pub compression: Compression,
    /// Entries of custom_data in metadata.yaml, as for `ros2 bag record`; eddy_stiffness=E is Young's modulus of the recorded matter
    /// (density x velocity^2), for checkpoints that are conditioned on it; eddy_gravity=G is gravity along y, negative is down
    /// (domain lengths per s^2) [default: none].
    #[arg(long, value_name = "KEY=VALUE", num_args = 1.., value_parser = values::key_value)]
    pub custom_data: Vec<(String, String)>,
    /// Request these QoS policies on zenoh and dds: a YAML file with topics and their policies, as for `ros2 bag record`
    /// [default: what the publishers offer].
    #[arg(long, value_name = "FILE")]
    pub qos_profile_overrides_path: Option<PathBuf>,
    /// Installations of ROS 2 with definitions of message types, separated by colons [default: none].
    #[arg(
        long,
        value_name = "PATHS",
        env = "AMENT_PREFIX_PATH",
        hide_env_values = true,
        value_delimiter = ':'
    )]
    pub ament_prefix_path: Vec<PathBuf>,
    #[command(flatten)]
    pub ros: RosArgs,
}

/// `eddy replay`
#[derive(Debug, Args)]
pub struct ReplayArgs {
    /// Bag to play: a directory with metadata.yaml, or an MCAP file.
    pub bag: PathBuf,
    /// Transport to publish on: zenoh, shm or dds.
    #[arg(
        long,
        value_name = "TRANSPORT",
        default_value = "zenoh",
        env = "EDDY_TRANSPORT",
        hide_env_values = true
    )]
    pub to: TransportKind,
    /// Recorded time per real time.
    #[arg(long, short, value_name = "FACTOR", default_value_t = 1.0, value_parser = values::positive)]
    pub rate: f64,
    /// Restart at the end, until SIGINT or SIGTERM.
    #[arg(long = "loop", short)]
    pub looped: bool,
    /// Skip this much recorded time at the start (s).
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, value_parser = values::seconds)]
    pub start_offset: f64,
    /// Stop after this much recorded time (s) [default: at the end].
    #[arg(long, value_name = "SECONDS", value_parser = values::positive_seconds)]
    pub duration: Option<f64>,
    /// Topics to play [default: all].
    #[arg(long, value_name = "TOPIC", num_args = 1..)]
    pub topics: Vec<String>,
    /// Publish the recorded time on /clock at this rate [without a value: 40].
    #[arg(long, value_name = "HZ", num_args = 0..=1, default_missing_value = "40", value_parser = values::positive)]
    pub clock: Option<f64>,
    /// Start paused; the space bar, a service or the live page resumes.
    #[arg(long, short = 'p')]
    pub start_paused: bool,
    /// Publish a topic under another name, for example /particles:=/truth [default: as recorded].
    #[arg(long, value_name = "FROM:=TO")]
    pub remap: Vec<String>,
    /// Wait for N subscribers of each topic before the first message (at most 30 s).
    #[arg(long, value_name = "N", default_value_t = 0)]
    pub wait_for: usize,
    /// What happens when a subscriber cannot keep up.
    #[arg(long, value_enum, default_value_t = Reliability::Block)]
    pub reliability: Reliability,
    /// Offer these QoS policies on zenoh and dds: a YAML file with topics and their policies, as for `ros2 bag play`
    /// [default: what was recorded].
    #[arg(long, value_name = "FILE")]
    pub qos_profile_overrides_path: Option<PathBuf>,
    /// Serve a live page of the bag on this port, address or both; port 0 takes any free port
    /// [without a value: 127.0.0.1:8080].
    #[arg(long, value_name = "ADDRESS", num_args = 0..=1, default_missing_value = "127.0.0.1:8080")]
    pub view: Option<ListenAddress>,
    #[command(flatten)]
    pub ros: RosArgs,
}

/// `eddy train`
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Bags, or directories of bags.
    #[arg(long, value_name = "BAG", required = true, num_args = 1..)]
    pub data: Vec<PathBuf>,
    /// Skip streams with a frame that cannot be used (not finite, outside of the domain, far too fast, of another dt or domain
    /// than the first stream), instead of refusing the data; they are counted and named.
    #[arg(long)]
    pub skip_streams: bool,
    /// Output directory for the best checkpoint, the last epoch (last/), metrics.csv and TensorBoard event files.
    #[arg(long, short, value_name = "DIR")]
    pub output: PathBuf,
    /// Replace an existing training output.
    #[arg(long, conflicts_with = "resume")]
    pub force: bool,
    /// Continue the run in --output from its last complete epoch, with bit-identical results, or start one if there is
    /// none. Data and settings must be the same, except --epochs and patience; schedules follow the new number of
    /// epochs.
    #[arg(long)]
    pub resume: bool,
    /// Start from the weights of a checkpoint. Its layers are kept; its gravity and observed frames are the defaults, and a
    /// fifth of the usual learning rate [default: random weights].
    #[arg(long, value_name = "CHECKPOINT")]
    pub from: Option<PathBuf>,
    /// Read settings from a TOML file; command-line options override it [default: those of --recipe].
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Defaults of all settings: eddy's for the architecture, or the paper's network and training as published.
    #[arg(long, value_enum, default_value_t = Recipe::Default)]
    pub recipe: Recipe,
    /// Network architecture [default: particle].
    #[arg(long, value_enum)]
    pub architecture: Option<Architecture>,
    /// Recurrent core [default: mingru].
    #[arg(long, value_enum)]
    pub core: Option<Core>,
    /// Maximum number of epochs [default: that of the settings].
    #[arg(long, value_name = "N")]
    pub epochs: Option<u32>,
    /// Seed of initial weights, data order and dropout. With several seeds, each run is written to DIR/seed-N, and a table
    /// compares them [default: 1].
    #[arg(long, num_args = 1..)]
    pub seed: Vec<u64>,
    /// Memory for the frames of the data; frames beyond it are read from disk when needed, with the same results
    /// [default: half of the available memory].
    #[arg(long, value_name = "GIB")]
    pub memory: Option<f64>,
    /// Compute device.
    #[arg(long, value_enum, default_value_t = DeviceKind::Flex)]
    pub device: DeviceKind,
    /// Precision of products on an NVIDIA GPU: factors rounded to TF32 on tensor cores, or FP32.
    #[arg(long, value_enum, default_value_t = Precision::default())]
    pub precision: Precision,
    /// NVIDIA GPUs that train together, from that of --device on, each on its part of every batch: windows.batch must be a
    /// multiple. Needs libnccl.
    #[arg(long, value_name = "N", default_value_t = GpuOptions::default().count)]
    pub gpus: NonZeroUsize,
}

/// `eddy predict`
#[derive(Debug, Args)]
pub struct PredictArgs {
    /// Checkpoint of the surrogate [default: the shipped particle model].
    #[arg(long, value_name = "DIR")]
    pub checkpoint: Option<PathBuf>,
    /// Bag with the frames.
    #[arg(long, value_name = "BAG")]
    pub input: PathBuf,
    /// Output bag for the predictions.
    #[arg(long, short, value_name = "BAG")]
    pub output: PathBuf,
    /// Replace an existing bag.
    #[arg(long)]
    pub force: bool,
    /// Topic with the frames.
    #[arg(long, default_value = "/particles")]
    pub topic: String,
    /// Skip streams with a frame that cannot be used (not finite, outside of the domain, far too fast), instead of refusing the
    /// bag; they are counted and named.
    #[arg(long)]
    pub skip_streams: bool,
    #[command(flatten)]
    pub settings: PredictOptions,
    /// Number of threads for prediction [default: one per core]; on a GPU, of those that copy frames to it and back
    /// [default: one per core, at most 8].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
    /// Where the network runs: cpu, cuda for an
    /// NVIDIA GPU, cuda:1 for the second.
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = Device::parse)]
    pub device: Device,
}
