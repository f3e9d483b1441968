//! The `eddy` program: parses the command line and runs one of [`commands`].

#[macro_use(eprintln, print, println)]
extern crate eddy_cli;

mod cli;
mod commands;

use std::process::ExitCode;

use clap::error::ErrorKind;
use eddy_bag::BagError;
use eddy_node::ros::{RosArguments, RosNode, Rosout};
use tracing_subscriber::{
    EnvFilter, Layer as _, layer::SubscriberExt as _, util::SubscriberInitExt as _,
};

use cli::{Cli, Command};
use eddy_cli::{Interrupt, logs};

/// Keeps freed memory: training and inference allocate the same large temporaries again and again.
#[global_allocator]
static ALLOCATOR: mimalloc::MiMalloc = mimalloc::MiMalloc;

fn main() -> ExitCode {
    eddy_cli::exit_code("eddy", run(Cli::read()).map_err(with_advice))
}

/// Adds what can be done about a damaged bag.
fn with_advice(error: anyhow::Error) -> anyhow::Error {
    let is_damage = |cause: &(dyn std::error::Error + 'static)| {
        let damage = cause.downcast_ref::<BagError>();
        matches!(
            damage,
            Some(
                BagError::Unfinished { .. } | BagError::Truncated { .. } | BagError::Corrupt { .. }
            )
        )
    };
    match error.chain().any(is_damage) {
        true => error.context("damaged bag; `eddy bag recover` copies what can be read"),
        false => error,
    }
}

/// The ROS node of the command; exits with wrong usage when its arguments are invalid.
fn ros_node(command: &Command) -> RosNode {
    let arguments = RosArguments::parse(command.ros_args());
    let usage = |error| cli::command().error(ErrorKind::ValueValidation, error).exit();
    arguments.unwrap_or_else(usage).node(command.node_name())
}

/// What is published on `/rosout`: the log of eddy from level INFO on, as in ROS 2, unless arguments say otherwise.
fn rosout_filter(ros: &RosNode) -> EnvFilter {
    EnvFilter::new(ros.log_filter("off,eddy=info"))
}

fn run(cli: Cli) -> anyhow::Result<ExitCode> {
    let ros = ros_node(&cli.command);
    let filter = EnvFilter::try_new(ros.console_filter(&cli.global.log_level))?;
    let rosout =
        (cli.command.has_log_topic() && ros.has_rosout()).then(|| Rosout::new(ros.logger()));
    let published = rosout.clone().map(|rosout| rosout.with_filter(rosout_filter(&ros)));
    tracing_subscriber::registry().with(logs(filter)).with(published).init();
    let interrupt = Interrupt::install()?;
    let quiet = cli.global.quiet;
    match cli.command {
        Command::Demo(args) => commands::demo::run(args, quiet, &interrupt),
        Command::Simulate(args) => commands::simulate::run(args, quiet, &interrupt),
        Command::Record(args) => commands::record::run(args, &ros, quiet, &interrupt),
        Command::Replay(args) => {
            commands::replay::run(args, &ros, rosout.as_ref(), quiet, &interrupt)
        }
        Command::Train(args) => commands::train::run(args, quiet, &interrupt),
        Command::Node(args) => commands::node::run(args, &ros, rosout.as_ref(), quiet, &interrupt),
        Command::Tools(args) => {
            commands::tools::run(&args, &ros, rosout.as_ref(), quiet, &interrupt)
        }
        Command::Predict(args) => commands::predict::run(args, quiet, &interrupt),
        Command::Calibrate(args) => commands::calibrate::run(&args, quiet, &interrupt),
        Command::Eval(args) => commands::eval::run(args, quiet, &interrupt),
        Command::Launch(args) => commands::launch::run(&args, quiet, &interrupt),
        Command::Bag(args) => return commands::bag::run(args, quiet, &interrupt),
        Command::Topic(args) => commands::topic::run(args, &interrupt),
        Command::Service(args) => commands::service::run(args, &interrupt),
        Command::Param(args) => commands::param::run(args, &interrupt),
        Command::Devices => commands::devices::run(),
        Command::Completions(args) => commands::completions::run(&args),
        Command::Man(args) => commands::completions::man(&args, quiet),
    }
    .map(|()| ExitCode::SUCCESS)
}
