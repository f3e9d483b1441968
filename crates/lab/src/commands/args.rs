//! Arguments of `eddy-lab bench` and `eddy-lab study`.

use std::{num::NonZeroUsize, path::PathBuf};

use clap::{Args, Subcommand};

use crate::{bench::training::Step, study::Comparison};
use eddy_cli::RealTimeArgs;
use eddy_learning::{
    model::{Core, DeviceKind, Precision},
    train::step_benchmark::PARTICLES,
};
use eddy_mpm::Law;
use eddy_transport::TransportKind;

/// `eddy-lab bench`
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// The benchmark.
    #[command(subcommand)]
    pub command: BenchCommand,
    /// Also write the tables and plots to an HTML page [default: none].
    #[arg(long, global = true, value_name = "FILE")]
    pub html: Option<PathBuf>,
    /// Replace an existing HTML page.
    #[arg(long, global = true)]
    pub force: bool,
    #[command(flatten)]
    pub real_time: RealTimeArgs,
}

/// The benchmarks.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Time substeps of the Material Point Method, by particles and threads.
    Solver(BenchSolverArgs),
    /// Time the prediction of a frame, by core: the paper's frame model and the shipped particle model.
    Inference(BenchInferenceArgs),
    /// Time training steps of the paper's network, by core and window length (its Table 4).
    Training(BenchTrainingArgs),
    /// Measure latency from publisher to subscriber, compared with the middleware alone.
    Transport(BenchTransportArgs),
    /// Run a node on shared memory: measure its overhead over the model, and its latency with several streams.
    Node(BenchNodeArgs),
    /// Run nodes that share streams through a zenoh router on this machine: measure losses, latency and use of the processor.
    Group(BenchGroupArgs),
    /// Measure the delay of replayed frames, compared with a loop that only sleeps until each is due.
    Replay(BenchReplayArgs),
    /// Measure the live page's overhead and the frame rate that a browser receives.
    View(BenchViewArgs),
    /// Measure write and read rates of bags, and message loss of a live recording.
    Bag(BenchBagArgs),
}

/// `eddy-lab bench transport`
#[derive(Debug, Args)]
pub struct BenchTransportArgs {
    /// Transports to measure.
    #[arg(long, value_delimiter = ',', default_value = "shm,zenoh,dds")]
    pub transport: Vec<TransportKind>,
    /// Particles per frame.
    #[arg(
        long,
        value_name = "N",
        value_delimiter = ',',
        default_value = "2500,10000,100000,1000000"
    )]
    pub particles: Vec<usize>,
    /// Messages of each kind.
    #[arg(long, value_name = "N", default_value_t = 500)]
    pub messages: usize,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab bench node`
#[derive(Debug, Args)]
pub struct BenchNodeArgs {
    /// Checkpoint directory [default: the shipped particle model].
    #[arg(long, value_name = "DIR")]
    pub checkpoint: Option<PathBuf>,
    /// Number of streams.
    #[arg(long, value_name = "N", default_value_t = 1)]
    pub streams: u64,
    /// Particles per stream.
    #[arg(long, value_name = "N", default_value_t = 2500)]
    pub particles: usize,
    /// Frame rate per stream (Hz).
    #[arg(long, value_name = "HZ", default_value_t = 62.5)]
    pub hertz: f64,
    /// Approximate duration (s).
    #[arg(long, default_value_t = 10.0)]
    pub seconds: f64,
    /// Publish the frames of all streams at the same time, instead of evenly spaced.
    #[arg(long)]
    pub together: bool,
    /// Threads of the engine [default: one per core].
    #[arg(long, value_name = "N")]
    pub threads: Option<NonZeroUsize>,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab bench group`
#[derive(Debug, Args)]
pub struct BenchGroupArgs {
    /// Number of nodes, each a process.
    #[arg(long, value_name = "N", default_value_t = 10)]
    pub nodes: usize,
    /// Number of streams that the nodes share.
    #[arg(long, value_name = "N", default_value_t = 1000)]
    pub streams: u64,
    /// Particles per stream.
    #[arg(long, value_name = "N", default_value_t = 500)]
    pub particles: usize,
    /// Frame rate per stream (Hz); the frames of the streams are evenly spaced.
    #[arg(long, value_name = "HZ", default_value_t = 1.0)]
    pub hertz: f64,
    /// Approximate duration (s), after the warm-up.
    #[arg(long, default_value_t = 20.0)]
    pub seconds: f64,
    /// Kill a node after half of the time.
    #[arg(long)]
    pub kill: bool,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab bench replay`
#[derive(Debug, Args)]
pub struct BenchReplayArgs {
    /// Particles per frame.
    #[arg(long, value_name = "N", default_value_t = 2500)]
    pub particles: usize,
    /// Frame rate (Hz).
    #[arg(long, value_name = "HZ", default_value_t = 250.0)]
    pub hertz: f64,
    /// Approximate duration of each of the two (s).
    #[arg(long, default_value_t = 15.0)]
    pub seconds: f64,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab bench view`
#[derive(Debug, Args)]
pub struct BenchViewArgs {
    /// Particles per frame.
    #[arg(long, value_name = "N", default_value_t = 100_000)]
    pub particles: usize,
    /// Frame rate (Hz).
    #[arg(long, value_name = "HZ", default_value_t = 62.5)]
    pub hertz: f64,
    /// Approximate duration of each case (s).
    #[arg(long, default_value_t = 5.0)]
    pub seconds: f64,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab bench bag`
#[derive(Debug, Args)]
pub struct BenchBagArgs {
    /// Particles per frame.
    #[arg(long, value_name = "N", default_value_t = 100_000)]
    pub particles: usize,
    /// Frame rate of the live recording (Hz).
    #[arg(long, value_name = "HZ", default_value_t = 100.0)]
    pub hertz: f64,
    /// Approximate duration of each measurement (s).
    #[arg(long, default_value_t = 5.0)]
    pub seconds: f64,
    /// Directory on the disk to measure; files written there are removed.
    #[arg(long, value_name = "DIR", default_value = ".")]
    pub directory: PathBuf,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab bench solver`
#[derive(Debug, Args)]
pub struct BenchSolverArgs {
    /// Numbers of particles, from 1000, 2500, 10000, 100000 and 1000000 [default: all].
    #[arg(long, value_name = "N", value_delimiter = ',')]
    pub particles: Vec<usize>,
    /// Numbers of threads.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "1,2")]
    pub threads: Vec<usize>,
    /// Constitutive law of liquids: water, settling (water that comes to rest), or that of Taichi's mpm128.
    #[arg(long, value_enum, default_value_t = Law::default())]
    pub law: Law,
    /// Three blocks of sand instead of liquid, snow and jelly.
    #[arg(long)]
    pub sand: bool,
    /// Approximate duration of each case (s).
    #[arg(long, default_value_t = 1.0)]
    pub seconds: f64,
    /// Write the initial states and the states after 20 and 200 substeps to bags, for comparison with other programs
    /// [default: none].
    #[arg(long, value_name = "DIR", short)]
    pub output: Option<PathBuf>,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab bench inference`
#[derive(Debug, Args)]
pub struct BenchInferenceArgs {
    /// Particles per frame.
    #[arg(long, value_name = "N", default_value_t = PARTICLES)]
    pub particles: usize,
    /// Cores of the frame model; the particle model is always included.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "mlp,lstm,gru,minlstm,mingru")]
    pub core: Vec<Core>,
    /// Numbers of threads of the engine.
    #[arg(long, value_name = "N", value_delimiter = ',', default_value = "1,2")]
    pub threads: Vec<NonZeroUsize>,
    /// Devices on which to also time the network in burn.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "flex")]
    pub device: Vec<DeviceKind>,
    /// Time the engine only.
    #[arg(long)]
    pub engine_only: bool,
    /// Approximate duration of each measurement (s); at least a hundred frames.
    #[arg(long, default_value_t = 1.0)]
    pub seconds: f64,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab bench training`
#[derive(Debug, Args)]
pub struct BenchTrainingArgs {
    /// A kind of step, `WHAT:CORE:FRAMES[:WINDOWS]`, for example frame:mingru:2 (the whole network) or
    /// core:lstm:16 (its core alone); can be repeated [default: all recurrent cores, in the network at 2 frames and
    /// alone at 2, 16, 64 and 256].
    #[arg(long, value_name = "STEP")]
    pub step: Vec<Step>,
    /// Windows per batch, for steps that do not specify it.
    #[arg(long, value_name = "N", default_value_t = 16)]
    pub windows: usize,
    /// Approximate duration per kind of step (s); at least three steps.
    #[arg(long, default_value_t = 3.0)]
    pub seconds: f64,
    /// Device.
    #[arg(long, value_enum, default_value_t = DeviceKind::Flex)]
    pub device: DeviceKind,
    /// Precision of products on an NVIDIA GPU: factors rounded to TF32 on tensor cores, or FP32.
    #[arg(long, value_enum, default_value_t)]
    pub precision: Precision,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab study`
#[derive(Debug, Args)]
pub struct StudyArgs {
    /// What to compare, and how.
    #[command(flatten)]
    pub choice: StudyChoice,
    /// Number of networks to train in parallel.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::MIN)]
    pub jobs: NonZeroUsize,
    /// NVIDIA GPUs that networks are spread over, from that of --device on: each is trained on one of them.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::MIN)]
    pub gpus: NonZeroUsize,
}

/// What `eddy-lab study` and `eddy-lab plan study` compare, and how.
#[derive(Debug, Args)]
pub struct StudyChoice {
    /// The comparison.
    #[arg(value_enum)]
    pub comparison: Comparison,
    /// Use few short scenes, narrow networks and two seeds: minutes on two cores (the default).
    #[arg(long, conflicts_with_all = ["paper", "mended"])]
    pub quick: bool,
    /// Use the paper's setup and training as published: 60 scenes per preset, its network widths, three seeds, at least 600
    /// steps of 4,096 windows; minutes per network on an NVIDIA GPU.
    #[arg(long, conflicts_with = "mended")]
    pub paper: bool,
    /// Use the paper's networks with a training that lets them learn, on 600 scenes per preset.
    #[arg(long)]
    pub mended: bool,
    /// Read settings from a TOML file; it overrides --quick, --paper or --mended [default: no file].
    #[arg(long, value_name = "FILE")]
    pub config: Option<PathBuf>,
    /// Directory of data, networks, evaluations and reports. Comparisons with the same output share data and networks;
    /// the same command resumes an interrupted study.
    #[arg(long, value_name = "DIR", short)]
    pub output: PathBuf,
    /// Device for training and for the timed steps; with cuda also for the simulation of the scenes.
    #[arg(long, value_enum, default_value_t = DeviceKind::Flex)]
    pub device: DeviceKind,
    /// Precision of products on an NVIDIA GPU: factors rounded to TF32 on tensor cores, or FP32.
    #[arg(long, value_enum, default_value_t)]
    pub precision: Precision,
}
