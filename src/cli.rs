//! The command line. What its commands do is in [`crate::commands`].

mod bag;
mod examples;
mod plan;
mod service;
mod topic;
mod values;

use std::{num::NonZeroUsize, path::PathBuf};

use clap::{
    Args, CommandFactory, FromArgMatches, Parser, Subcommand, ValueEnum,
    error::{ContextKind, ContextValue, ErrorKind},
};
use clap_complete::Shell;
use regex::Regex;

use crate::commands::{real_time::CpuList, simulate};
use eddy_bag::Compression;
use eddy_evaluation::DEFAULT_STARTS;
use eddy_inference::checkpoint::Rule;
use eddy_lab::commands::{BenchArgs, StudyArgs};
use eddy_learning::{
    model::{Architecture, Core, DeviceKind, Precision},
    train::Recipe,
};
use eddy_mpm::{Law, ParticleOrder};
use eddy_node::surrogate::{NodeOptions, PredictOptions};
use eddy_transport::{Link, ListenAddress, Reliability, TransportKind};

#[cfg(feature = "foxglove")]
use eddy_transport::FoxgloveAddress;

pub use bag::{
    BagArgs, BagCommand, CloudArgs, Color, CutArgs, ExportArgs, FilterArgs, ImportArgs, MergeArgs,
    NewBagArgs, RecoverArgs, RenderArgs,
};
pub use plan::{PlanArgs, PlanCommand, PlanSimulateArgs, PlanStudyArgs};
pub use service::{
    ParamArgs, ParamCommand, SearchArgs, ServiceArgs, ServiceCallArgs, ServiceCommand,
    ServiceListArgs,
};
pub use values::ComputeDevice;

pub use topic::{TopicArgs, TopicCommand, TopicEchoArgs, TopicHzArgs, TopicListArgs};

/// Heading of the options that every command has.
const GLOBAL: &str = "Global options";

/// Recurrent surrogates for particle simulations, as ROS 2 / Zenoh nodes.
#[derive(Debug, Parser)]
#[command(name = "eddy", version, propagate_version = true, max_term_width = 100)]
pub struct Cli {
    /// Print errors only: no progress bars, status lines or summaries.
    #[arg(long, short, global = true, help_heading = GLOBAL)]
    pub quiet: bool,

    /// Log level on standard error: error, warn, info, debug or trace, or a filter such as `eddy=debug` [default: warn].
    #[arg(
        long,
        value_name = "LEVEL",
        global = true,
        help_heading = GLOBAL,
        hide_default_value = true,
        hide_env_values = true,
        // RustDDS logs normal events as errors, such as participants that appear and disappear.
        default_value = "warn,zenoh=error,iceoryx2_bb_loggers=error,rustdds=off,ros2_client=error",
        env = "EDDY_LOG"
    )]
    pub log_level: String,

    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Simulate a scene, predict it live, record both and evaluate the predictions.
    Demo(DemoArgs),
    /// Simulate ground truth with the Material Point Method and write one bag per scene.
    Simulate(SimulateArgs),
    /// Record topics into an MCAP bag.
    Record(RecordArgs),
    /// Publish the messages of a bag at their recorded times.
    Replay(ReplayArgs),
    /// Train a surrogate on bags.
    Train(TrainArgs),
    /// Predict frames of live streams.
    Node(NodeArgs),
    /// Predict frames of a bag, with the code of the node.
    Predict(PredictArgs),
    /// Evaluate checkpoints by free rollouts over bags.
    Eval(EvalArgs),
    /// Run a comparison of the paper: simulate, train, evaluate, report.
    Study(StudyArgs),
    /// Divide a long job into tasks that several machines can share, and run them.
    Plan(PlanArgs),
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
    /// Run benchmarks on this machine.
    Bench(RealTimeBenchArgs),
    /// List the devices that networks can be trained on.
    Devices,
    /// Print a shell completion script.
    Completions(CompletionsArgs),
    /// Write manual pages, one per command.
    Man(ManArgs),
}

/// The command line, with examples at the end of each command's long help.
pub fn command() -> clap::Command {
    with_negative_numbers(examples::added(Cli::command()))
}

/// Takes `-1` for a value, which is then rejected with the range of the option, and not for an unknown option.
fn with_negative_numbers(command: clap::Command) -> clap::Command {
    let takes_value = |arg: &clap::Arg| arg.get_action().takes_values() && !arg.is_positional();
    let command = command.mut_args(|arg| match takes_value(&arg) {
        true => arg.allow_negative_numbers(true),
        false => arg,
    });
    command.mut_subcommands(with_negative_numbers)
}

/// Removes the tip to pass an unknown option as a value, which it hardly ever is.
fn without_escape_tip(mut error: clap::Error) -> clap::Error {
    if error.kind() == ErrorKind::UnknownArgument
        && let Some(ContextValue::StyledStrs(mut tips)) = error.remove(ContextKind::Suggested)
    {
        tips.retain(|tip| !tip.to_string().starts_with("to pass "));
        if !tips.is_empty() {
            error.insert(ContextKind::Suggested, ContextValue::StyledStrs(tips));
        }
    }
    error
}

impl Cli {
    /// Parses the arguments of this process; exits after printing help or an error.
    pub fn read() -> Self {
        let matches = command().try_get_matches().map_err(without_escape_tip);
        let read = matches.and_then(|matches| Self::from_arg_matches(&matches));
        read.unwrap_or_else(|error| error.exit()).without_aliases()
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
    /// --params-file FILE, --log-level LEVEL.
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
            | Self::Replay(ReplayArgs { ros, .. }) => &ros.ros_args,
            _ => &[],
        }
    }

    /// Whether the log of this command is published on `/rosout`. A recorder would record its own.
    pub fn has_log_topic(&self) -> bool {
        matches!(self, Self::Node(_) | Self::Replay(_))
    }

    /// Default name of the node that this command runs.
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
    /// Launch file (TOML); launch_configs/ has examples.
    pub file: PathBuf,
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
    /// Stop after one scene of this duration (s, in real time) [default: scenes of 8 s until SIGINT or SIGTERM, of which
    /// the first is recorded; with --headless only the first].
    #[arg(long, value_name = "SECONDS", value_parser = values::positive_seconds)]
    pub seconds: Option<f64>,
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

/// `eddy simulate`
#[derive(Debug, Args)]
pub struct SimulateArgs {
    #[command(flatten)]
    pub scenes: SceneArgs,
    /// Output directory; one bag per scene.
    #[arg(long, short, value_name = "DIR", required_unless_present = "publish")]
    pub output: Option<PathBuf>,
    /// Replace the scenes in the output directory; without it, the same command adds those that are missing.
    #[arg(long, requires = "output")]
    pub force: bool,
    /// Publish frames in real time, for example on zenoh:/particles, shm:/particles or dds:/particles, and the simulated
    /// time on /clock of the same transport.
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
    /// Number of threads: one per scene, the remaining ones work within the scenes [default: one per scene, at most one
    /// per core].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
}

/// Which scenes to simulate, and where the solver runs.
#[derive(Debug, Args)]
pub struct SceneArgs {
    /// Kind of random scenes, or one of the scenes shipped with eddy.
    #[arg(long, value_name = "NAME", value_parser = simulate::source::presets(), default_value = "multi-material")]
    pub preset: String,
    /// Scene file (TOML); launch_configs/scenes/ has examples.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["preset", "scenes", "seed"])]
    pub scene: Option<PathBuf>,
    /// Number of random scenes.
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    pub scenes: u32,
    /// Seed of random scenes; the same seed gives identical bags.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Particles of a random scene; more particles make the domain wider, at the same spacing and height [default: 2500].
    #[arg(long, value_name = "N", conflicts_with = "scene")]
    pub particles: Option<usize>,
    /// All random scenes have the bodies of the first: the same materials, shapes and places. Only their velocities and the
    /// attractor differ.
    #[arg(long, conflicts_with = "scene")]
    pub same_bodies: bool,
    /// How the particles of bodies are numbered: body by body, or along a Hilbert curve through their initial positions
    /// [default: the scene's; bodies].
    #[arg(long, value_enum, value_name = "ORDER")]
    pub particle_order: Option<ParticleOrder>,
    /// Duration of a scene (simulated s) [default: the scene's].
    #[arg(long, value_name = "SECONDS", value_parser = values::positive_seconds)]
    pub duration: Option<f64>,
    /// Solver substeps per frame; unstable values are rejected [default: from the CFL condition].
    #[arg(long, value_name = "N")]
    pub substeps: Option<u32>,
    /// Young's modulus of every material (density x velocity^2) [default: the scene's; 1000, preset stiff 1e5].
    #[arg(long, value_name = "E")]
    pub stiffness: Option<f32>,
    /// Constitutive law of liquids: water, or that of Taichi's mpm128 [default: the scene's; water].
    #[arg(long, value_enum)]
    pub law: Option<Law>,
    /// Kinematic viscosity of water (domain lengths^2/s) [default: the scene's; 0].
    #[arg(long, value_name = "NU")]
    pub viscosity: Option<f32>,
    /// Also record pressure and energy of every particle, as point clouds on /particles/fields.
    #[arg(long, requires = "output")]
    pub fields: bool,
    /// Where the solver runs: cpu, cuda for an NVIDIA GPU, cuda:1 for the second. A GPU simulates up to 256 scenes side by
    /// side, and its results differ from the processor's by rounding.
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = ComputeDevice::parse)]
    pub device: ComputeDevice,
}

/// `eddy record`
#[derive(Debug, Args)]
pub struct RecordArgs {
    /// Links to record, for example /particles zenoh:/prediction shm:/particles; transports are shm, zenoh and dds.
    #[arg(value_name = "LINK", required_unless_present_any = ["all", "regex"], value_parser = Link::from_argument)]
    pub links: Vec<Link>,
    /// Record all topics, including those that appear later.
    #[arg(long, short)]
    pub all: bool,
    /// Record all topics whose name matches, including those that appear later.
    #[arg(long, short = 'e')]
    pub regex: Vec<Regex>,
    /// Exclude topics whose name matches.
    #[arg(long, short = 'x')]
    pub exclude: Vec<Regex>,
    /// Transports on which --all and --regex search; a topic on several transports is recorded once.
    #[arg(long, value_name = "TRANSPORT", value_delimiter = ',', default_values = ["zenoh", "shm"])]
    pub from: Vec<TransportKind>,
    /// Output bag [default: eddy_DATE-TIME, in UTC].
    #[arg(long, short, value_name = "BAG")]
    pub output: Option<PathBuf>,
    /// Replace an existing bag.
    #[arg(long)]
    pub force: bool,
    /// Start a new file before one exceeds this size (bytes).
    #[arg(long, short = 'b', value_name = "BYTES", visible_alias = "max-size", value_parser = clap::value_parser!(u64).range(1..))]
    pub max_bag_size: Option<u64>,
    /// Start a new file after this time (s).
    #[arg(long, short = 'd', value_name = "SECONDS", visible_alias = "max-duration", value_parser = values::positive_seconds)]
    pub max_bag_duration: Option<f64>,
    /// Stop after this time (s) [default: at SIGINT or SIGTERM].
    #[arg(long, value_name = "SECONDS", value_parser = values::positive_seconds)]
    pub stop_after: Option<f64>,
    /// Stop after this number of messages.
    #[arg(long, value_name = "N")]
    pub max_messages: Option<u64>,
    /// Memory for messages waiting to be written (bytes). When it is full, blocking publishers wait up to 5 s; after that,
    /// and from other publishers, messages are dropped and counted.
    #[arg(long, value_name = "BYTES", default_value_t = 100 << 20)]
    pub max_cache_size: usize,
    /// Compression of chunks.
    #[arg(long, value_enum, default_value_t = Compression::Zstd)]
    pub compression: Compression,
    /// Request these QoS policies on zenoh and dds: a YAML file with topics and their policies, as for `ros2 bag record`
    /// [default: what the publishers offer].
    #[arg(long, value_name = "FILE")]
    pub qos_profile_overrides_path: Option<PathBuf>,
    /// Installations of ROS 2 with definitions of message types, separated by colons.
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
    /// Stop after this much recorded time (s).
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
    /// Publish a topic under another name, for example /particles:=/truth.
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
    /// Read settings from a TOML file; command-line options override it.
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Defaults of all settings: eddy's for the architecture, or the paper's network and training as published.
    #[arg(long, value_enum, default_value_t = Recipe::Default)]
    pub recipe: Recipe,
    /// Network architecture.
    #[arg(long, value_enum)]
    pub architecture: Option<Architecture>,
    /// Recurrent core.
    #[arg(long, value_enum)]
    pub core: Option<Core>,
    /// Maximum number of epochs.
    #[arg(long, value_name = "N")]
    pub epochs: Option<u32>,
    /// Seed of initial weights, data order and dropout. With several seeds, each run is written to DIR/seed-N, and a table
    /// compares them.
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
    #[arg(long, value_enum, default_value_t = Precision::Tf32)]
    pub precision: Precision,
    /// NVIDIA GPUs that train together, from that of --device on, each on its part of every batch: windows.batch must be a
    /// multiple. Needs libnccl.
    #[arg(long, value_name = "N", default_value = "1")]
    pub gpus: NonZeroUsize,
    /// Longest wait for the other processes that torchrun or Slurm have started (s). Each trains on one GPU: that of
    /// --device, plus LOCAL_RANK or SLURM_LOCALID.
    #[arg(long, value_name = "S", default_value = "60", value_parser = values::positive_seconds)]
    pub rendezvous_timeout: f64,
}

/// `eddy node`
#[derive(Debug, Args)]
pub struct NodeArgs {
    /// Checkpoint of the surrogate [default: the shipped particle model].
    #[arg(long, value_name = "DIR")]
    pub checkpoint: Option<PathBuf>,
    /// Read settings from a TOML file; command-line options override it.
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
    /// Where the network runs: cpu, cuda for an NVIDIA GPU, cuda:1 for the second.
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = ComputeDevice::parse)]
    pub device: ComputeDevice,
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

/// `eddy bench`
#[derive(Debug, Args)]
pub struct RealTimeBenchArgs {
    #[command(flatten)]
    pub bench: BenchArgs,
    #[command(flatten)]
    pub real_time: RealTimeArgs,
}

/// How the operating system treats a process.
#[derive(Debug, Args)]
pub struct RealTimeArgs {
    /// Run on these processors only, for example 2,3 or 4-7.
    #[arg(long, value_name = "LIST", value_parser = CpuList::parse)]
    pub cpu: Option<CpuList>,
    /// Run all threads with this real-time priority (SCHED_FIFO), 1 to 99: before all ordinary processes. Requires the right
    /// to do so.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=99))]
    pub priority: Option<u8>,
    /// Keep all memory in RAM: nothing is swapped out. Requires the right to do so.
    #[arg(long)]
    pub lock_memory: bool,
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
    #[command(flatten)]
    pub settings: PredictOptions,
    /// Number of threads for prediction [default: one per core]; on a GPU, of those that copy frames to it and back
    /// [default: one per core, at most 8].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
    /// Where the network runs: cpu, cuda for an NVIDIA GPU, cuda:1 for the second.
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = ComputeDevice::parse)]
    pub device: ComputeDevice,
}

/// `eddy eval`
#[derive(Debug, Args)]
pub struct EvalArgs {
    /// Checkpoints to evaluate side by side; those that differ only in their training count as seeds of one model.
    #[arg(long, value_name = "DIR", required_unless_present = "compare", num_args = 1..)]
    pub checkpoint: Vec<PathBuf>,
    /// Bags, or directories of bags.
    #[arg(long, value_name = "BAG", required_unless_present = "compare", num_args = 1..)]
    pub data: Vec<PathBuf>,
    /// Output directory for report.html, report.json, curves.csv and cost_error.png; with --compare, an HTML file.
    #[arg(long, short, value_name = "DIR", required_unless_present_any = ["compare", "list_starts"])]
    pub output: Option<PathBuf>,
    /// Replace an existing report.
    #[arg(long)]
    pub force: bool,
    /// Also evaluate rollouts that another program has recorded, in a bag or a directory of bags: frames on /prediction and,
    /// for each, its first frame and horizon on /prediction/status, as a node publishes them.
    #[arg(long, value_name = "NAME=BAG", num_args = 1.., value_parser = recorded)]
    pub predictions: Vec<(String, PathBuf)>,
    /// Print the sequence numbers that rollouts start from as JSON and exit.
    #[arg(long, conflicts_with_all = ["output", "predictions"])]
    pub list_starts: bool,
    /// Print all tables of the report, not only the skill.
    #[arg(long)]
    pub tables: bool,
    /// Compare existing reports (directories, or their report.json) of the same data.
    #[arg(
        long,
        value_name = "REPORT",
        num_args = 2..,
        conflicts_with_all = [
            "checkpoint", "data", "predictions", "list_starts", "horizon", "starts", "references", "join_late", "without_rules", "threads", "device"
        ]
    )]
    pub compare: Vec<PathBuf>,
    /// Frames of each free rollout to compare with the truth; rollouts continue to frame 200 to detect divergence.
    #[arg(long, value_name = "N", default_value_t = 100)]
    pub horizon: usize,
    /// Start frames per stream, evenly spaced over its first 80 %.
    #[arg(long, value_name = "N", default_value_t = DEFAULT_STARTS)]
    pub starts: usize,
    /// Reference predictors, started from the same frames; requires manifest.json beside the bags.
    #[arg(long, alias = "rivals", value_name = "NAME", value_enum, value_delimiter = ',')]
    pub references: Vec<ReferenceName>,
    /// Also evaluate each checkpoint on streams joined in the middle: it observes its warm-up, but no earlier frames.
    #[arg(long)]
    pub join_late: bool,
    /// Evaluate the checkpoints with these rules switched off. Compare the report with one without this option to see the
    /// effect of the rules.
    #[arg(long, value_enum, value_name = "NAME", value_delimiter = ',', num_args = 1..)]
    pub without_rules: Vec<Rule>,
    /// Number of scenes to evaluate in parallel; inference times are those of one thread [default: one per core].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
    /// Where the checkpoints run: cpu, cuda for an NVIDIA GPU, cuda:1 for the second.
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = ComputeDevice::parse)]
    pub device: ComputeDevice,
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
    /// The solver restarted from positions and velocities: unchanged, with half the substeps, and with cells twice as
    /// wide.
    Mpm,
    /// The solver from positions displaced by up to 1e-4: the limit of predictability.
    Chaos,
}
