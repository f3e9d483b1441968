//! Arguments of `eddy bench` and `eddy study`.

use std::{num::NonZeroUsize, path::PathBuf};

use clap::{Args, Subcommand};

use crate::{bench::training::Step, study::Comparison};
use eddy_learning::{
    model::{Core, DeviceKind},
    train::step_benchmark::PARTICLES,
};
use eddy_mpm::Law;
use eddy_transport::TransportKind;

/// `eddy bench`
#[derive(Debug, Args)]
pub struct BenchArgs {
    /// Which benchmark.
    #[command(subcommand)]
    pub command: BenchCommand,
    /// Also writes the tables, with curves, as a page of its own.
    #[arg(long, global = true, value_name = "FILE")]
    pub html: Option<PathBuf>,
}

/// The benchmarks.
#[derive(Debug, Subcommand)]
pub enum BenchCommand {
    /// Times substeps of the Material Point Method by particles and threads.
    Solver(BenchSolverArgs),
    /// Times the prediction of a frame by core: the paper's frame model, the shipped particle model.
    Inference(BenchInferenceArgs),
    /// Times training steps of the paper's network by core and length of the window (its Table 4).
    Training(BenchTrainingArgs),
    /// Times frames on their way from a publisher to a subscriber, beside the middleware alone.
    Transport(BenchTransportArgs),
    /// Runs a node on shared memory: what it adds to its model's time, how many streams it carries.
    Node(BenchNodeArgs),
    /// Times how late replayed frames are, beside a loop that only sleeps until each is due.
    Replay(BenchReplayArgs),
    /// What the live page costs who is looked at, and how many frames arrive at a browser.
    View(BenchViewArgs),
    /// Times the writing and reading of bags, and counts what a live recording loses.
    Bag(BenchBagArgs),
}

/// `eddy bench transport`
#[derive(Debug, Args)]
pub struct BenchTransportArgs {
    /// What carries them.
    #[arg(long, value_delimiter = ',', default_value = "shm,zenoh,dds")]
    pub transport: Vec<TransportKind>,
    /// Particles of a frame.
    #[arg(long, value_delimiter = ',', default_value = "2500,10000,100000,1000000")]
    pub particles: Vec<usize>,
    /// Messages of each kind.
    #[arg(long, default_value_t = 500)]
    pub messages: usize,
    /// Prints JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// `eddy bench node`
#[derive(Debug, Args)]
pub struct BenchNodeArgs {
    /// Directory of the checkpoint; the shipped particle model if not given.
    #[arg(long)]
    pub checkpoint: Option<PathBuf>,
    /// Streams at once.
    #[arg(long, default_value_t = 1)]
    pub streams: u64,
    /// Particles of each stream.
    #[arg(long, default_value_t = 2500)]
    pub particles: usize,
    /// Frames a second of each stream.
    #[arg(long, default_value_t = 62.5)]
    pub hertz: f64,
    /// About how long it runs (s).
    #[arg(long, default_value_t = 10.0)]
    pub seconds: f64,
    /// All streams have their frame at the same instant, instead of one after the other.
    #[arg(long)]
    pub together: bool,
    /// Threads of the engine; as many as there are cores if not given.
    #[arg(long)]
    pub threads: Option<NonZeroUsize>,
    /// Prints JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// `eddy bench replay`
#[derive(Debug, Args)]
pub struct BenchReplayArgs {
    /// Particles of a frame.
    #[arg(long, default_value_t = 2500)]
    pub particles: usize,
    /// Frames a second.
    #[arg(long, default_value_t = 250.0)]
    pub hertz: f64,
    /// About how long each of the two runs (s).
    #[arg(long, default_value_t = 15.0)]
    pub seconds: f64,
    /// Prints JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// `eddy bench view`
#[derive(Debug, Args)]
pub struct BenchViewArgs {
    /// Particles of a frame.
    #[arg(long, default_value_t = 100_000)]
    pub particles: usize,
    /// Frames a second.
    #[arg(long, default_value_t = 62.5)]
    pub hertz: f64,
    /// About how long each case is timed (s).
    #[arg(long, default_value_t = 5.0)]
    pub seconds: f64,
    /// Prints JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// `eddy bench bag`
#[derive(Debug, Args)]
pub struct BenchBagArgs {
    /// Particles of a frame.
    #[arg(long, default_value_t = 100_000)]
    pub particles: usize,
    /// Frames a second, live.
    #[arg(long, default_value_t = 100.0)]
    pub hertz: f64,
    /// About how long each is measured (s).
    #[arg(long, default_value_t = 5.0)]
    pub seconds: f64,
    /// A directory on the disk that is measured; what is written there is removed.
    #[arg(long, default_value = ".")]
    pub directory: PathBuf,
    /// Prints JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// `eddy bench solver`
#[derive(Debug, Args)]
pub struct BenchSolverArgs {
    /// Particles: some of 1000, 2500, 10000, 100000, 1000000; all if not given.
    #[arg(long, value_delimiter = ',')]
    pub particles: Vec<usize>,
    /// Numbers of threads.
    #[arg(long, value_delimiter = ',', default_value = "1,2")]
    pub threads: Vec<usize>,
    /// How liquids resist: as water, or by the law of Taichi's mpm128.
    #[arg(long, value_enum, default_value_t = Law::Water)]
    pub law: Law,
    /// About how long each case is timed (s).
    #[arg(long, default_value_t = 1.0)]
    pub seconds: f64,
    /// Writes the start and the states after 20 and 200 substeps as bags, for other programs.
    #[arg(long, short)]
    pub output: Option<PathBuf>,
    /// Prints JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// `eddy bench inference`
#[derive(Debug, Args)]
pub struct BenchInferenceArgs {
    /// Particles of a frame.
    #[arg(long, default_value_t = PARTICLES)]
    pub particles: usize,
    /// Cores of the frame model; the particle model is always there.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "mlp,lstm,gru,minlstm,mingru")]
    pub core: Vec<Core>,
    /// Numbers of threads of the engine.
    #[arg(long, value_delimiter = ',', default_value = "1,2")]
    pub threads: Vec<NonZeroUsize>,
    /// Devices on which the network in burn is timed beside it.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "flex,ndarray")]
    pub device: Vec<DeviceKind>,
    /// Times the engine alone.
    #[arg(long)]
    pub engine_only: bool,
    /// About how long each is timed (s); a hundred frames at least.
    #[arg(long, default_value_t = 1.0)]
    pub seconds: f64,
    /// Prints JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// `eddy bench training`
#[derive(Debug, Args)]
pub struct BenchTrainingArgs {
    /// One kind of step, WHAT:CORE:FRAMES[:WINDOWS], for example frame:mingru:2 (the whole network) or
    /// core:lstm:16 (its core alone); may be given several times. If not given: all
    /// recurrent cores, in the network at 2 frames and alone at 2, 16, 64 and 256.
    #[arg(long, value_name = "STEP")]
    pub step: Vec<Step>,
    /// Windows a batch, where a step does not say.
    #[arg(long, default_value_t = 16)]
    pub windows: usize,
    /// About how long each kind of step is timed (s); at least three steps are.
    #[arg(long, default_value_t = 3.0)]
    pub seconds: f64,
    /// What computes.
    #[arg(long, value_enum, default_value_t = DeviceKind::Flex)]
    pub device: DeviceKind,
    /// Prints JSON instead of a table.
    #[arg(long)]
    pub json: bool,
}

/// `eddy study`
#[derive(Debug, Args)]
pub struct StudyArgs {
    /// What is compared.
    #[arg(value_enum)]
    pub comparison: Comparison,
    /// Minutes on two cores: few short scenes, narrow networks, two seeds (the default).
    #[arg(long, conflicts_with = "paper")]
    pub quick: bool,
    /// The paper's: 60 scenes of each preset, its widths, three seeds. Many hours on two cores.
    #[arg(long)]
    pub paper: bool,
    /// A TOML file with what differs from that.
    #[arg(long)]
    pub config: Option<PathBuf>,
    /// Data, networks, judgements and reports. Comparisons with the same output share data and networks; the same
    /// command goes on where it was stopped.
    #[arg(long, short)]
    pub output: PathBuf,
    /// Networks that are trained at a time.
    #[arg(long, default_value_t = NonZeroUsize::MIN)]
    pub jobs: NonZeroUsize,
    /// What trains the networks of cores, loss and window, and takes the timed steps.
    #[arg(long, value_enum, default_value_t = DeviceKind::Flex)]
    pub device: DeviceKind,
}
