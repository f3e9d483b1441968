//! The command line. What its commands do is in [`crate::commands`].

use clap::{CommandFactory as _, Parser, Subcommand};
use eddy_cli::arguments::{self, Examples, GlobalArgs};

use crate::commands::{BenchArgs, PlanArgs, StudyArgs};

/// The laboratory of eddy: benchmarks, the paper's study, and plans of long jobs.
#[derive(Debug, Parser)]
#[command(name = "eddy-lab", version, propagate_version = true, max_term_width = 100)]
pub struct Cli {
    #[command(flatten)]
    pub global: GlobalArgs,

    #[command(subcommand)]
    pub command: Command,
}

#[derive(Debug, Subcommand)]
pub enum Command {
    /// Run benchmarks on this machine.
    Bench(BenchArgs),
    /// Run a comparison of the paper: simulate, train, evaluate, report.
    Study(StudyArgs),
    /// Divide a long job into tasks that several machines can share, and run them.
    Plan(PlanArgs),
}

impl Cli {
    /// Parses the arguments of this process; exits after printing help or an error.
    pub fn read() -> Self {
        let command = arguments::prepared(Self::command(), EXAMPLES);
        arguments::read(command).unwrap_or_else(|error| error.exit())
    }
}

/// The examples at the end of `--help`; a test runs all of them.
const EXAMPLES: &[Examples] = &[
    (
        "study",
        &[
            "eddy-lab study cores --output reports/study",
            "eddy-lab study activations --output reports/study",
        ],
    ),
    (
        "plan simulate",
        &["eddy-lab plan simulate plan.json --preset kinds --scenes 4 --output bags/planned"],
    ),
    ("plan list", &["eddy-lab plan list plan.json", "eddy-lab plan list plan.json --arrays"]),
    (
        "plan run",
        &["eddy-lab plan run plan.json --task scene-0002", "eddy-lab plan run plan.json --jobs 2"],
    ),
    ("plan study", &["eddy-lab plan study study.json cores --output reports/study"]),
    ("bench solver", &["eddy-lab bench solver --particles 2500,10000 --threads 1,2"]),
    ("bench inference", &["eddy-lab bench inference --core mingru,lstm --engine-only"]),
    ("bench training", &["eddy-lab bench training --step frame:mingru:2 --step core:lstm:16"]),
    ("bench transport", &["eddy-lab bench transport --transport shm,zenoh --particles 2500"]),
    ("bench node", &["eddy-lab bench node --streams 16 --hertz 20"]),
    ("bench group", &["eddy-lab bench group --nodes 10 --streams 1000"]),
    ("bench replay", &["eddy-lab bench replay --hertz 250 --seconds 15"]),
    ("bench view", &["eddy-lab bench view --particles 100000 --seconds 4"]),
    ("bench bag", &["eddy-lab bench bag --seconds 4 --json"]),
];
