//! The `eddy` program: parses the command line and runs one of [`commands`].

mod cli;
mod commands;

use std::{io, process::ExitCode};

use clap::error::ErrorKind;
use eddy_node::ros::{RosArguments, RosNode};
use tracing_subscriber::EnvFilter;

use cli::{Cli, Command};
use commands::Interrupt;

/// Keeps freed memory: training and inference allocate the same large temporaries again and again.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

/// Exit code of a failure; wrong usage is 2, by clap.
const FAILED: u8 = 1;

fn main() -> ExitCode {
    match run(Cli::read()) {
        Ok(code) => code,
        Err(error) => {
            #[expect(
                clippy::print_stderr,
                reason = "the one place where an error reaches the user"
            )]
            {
                eprintln!("eddy: {error:#}");
            }
            ExitCode::from(FAILED)
        }
    }
}

/// The ROS node of the command; exits with wrong usage when its arguments are invalid.
fn ros_node(command: &Command) -> RosNode {
    let arguments = RosArguments::parse(command.ros_args());
    let usage = |error| cli::command().error(ErrorKind::ValueValidation, error).exit();
    arguments.unwrap_or_else(usage).node(command.node_name())
}

fn run(cli: Cli) -> anyhow::Result<ExitCode> {
    let ros = ros_node(&cli.command);
    let filter = EnvFilter::try_new(ros.log_filter(&cli.log_level))?;
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(io::stderr).init();
    let interrupt = Interrupt::install()?;
    let quiet = cli.quiet;
    match cli.command {
        Command::Demo(args) => commands::demo::run(args, quiet, &interrupt),
        Command::Simulate(args) => commands::simulate::run(args, quiet, &interrupt),
        Command::Record(args) => commands::record::run(args, &ros, quiet, &interrupt),
        Command::Replay(args) => commands::replay::run(args, &ros, quiet, &interrupt),
        Command::Train(args) => commands::train::run(args, quiet, &interrupt),
        Command::Node(args) => commands::node::run(args, &ros, quiet, &interrupt),
        Command::Predict(args) => commands::predict::run(args, quiet, &interrupt),
        Command::Eval(args) => commands::eval::run(args, quiet, &interrupt),
        Command::Study(args) => commands::lab::study(args, quiet, &interrupt),
        Command::Launch(args) => commands::launch::run(&args, quiet, &interrupt),
        Command::Bench(args) => commands::lab::bench(args, quiet, &interrupt),
        Command::Bag(args) => return commands::bag::run(args, quiet, &interrupt),
        Command::Topic(args) => commands::topic::run(args, &interrupt),
        Command::Devices => commands::devices::run(),
        Command::Completions(args) => commands::completions::run(&args),
        Command::Man(args) => commands::completions::man(&args, quiet),
    }
    .map(|()| ExitCode::SUCCESS)
}
