//! The `eddy-lab` program: tools that measure and study eddy.
//!
//! 1. [`mod@cli`]: the command line.
//! 2. [`commands`]: arguments and tables of `eddy-lab bench`, `eddy-lab study` and `eddy-lab plan`.
//! 3. [`mod@bench`]: what `eddy-lab bench` measures.
//! 4. [`study`]: the paper's comparisons.
//! 5. [`mod@dense`]: the network of its comparison of activations.
//! 6. [`plans`]: data sets and comparisons as tasks for several machines.

#[macro_use(println)]
extern crate eddy_cli;

mod bench;
mod cli;
mod commands;
mod dense;
mod plans;
mod study;

use std::process::ExitCode;

use tracing_subscriber::{EnvFilter, layer::SubscriberExt as _, util::SubscriberInitExt as _};

use cli::{Cli, Command};
use eddy_cli::{Interrupt, TerminalProgress, logs};

/// Keeps freed memory: training and inference allocate the same large temporaries again and again.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    eddy_cli::exit_code("eddy-lab", run(Cli::read()))
}

fn run(cli: Cli) -> anyhow::Result<ExitCode> {
    let filter = EnvFilter::try_new(&cli.global.log_level)?;
    tracing_subscriber::registry().with(logs(filter)).init();
    let interrupt = Interrupt::install()?;
    let progress = TerminalProgress::new(cli.global.quiet, &interrupt);
    match cli.command {
        Command::Bench(args) => commands::bench(args, &progress),
        Command::Study(args) => commands::study(args, &progress),
        Command::Plan(args) => commands::plan(args, &progress),
    }
    .map(|()| ExitCode::SUCCESS)
}
