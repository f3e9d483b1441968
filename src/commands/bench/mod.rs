//! `eddy bench`: tables for this machine.

mod bag;
mod inference;
mod node;
mod replay;
mod sheet;
mod solver;
mod training;
mod transport;
mod view;

use super::Interrupt;
use crate::cli::{BenchArgs, BenchCommand};
pub(super) use sheet::printed;
use sheet::{Sheet, table};

/// Runs one of the benchmarks.
pub fn run(args: BenchArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let html = args.html.as_deref();
    match args.command {
        BenchCommand::Solver(args) => solver::run(args, quiet, html, interrupt),
        BenchCommand::Inference(args) => inference::run(args, quiet, html, interrupt),
        BenchCommand::Training(args) => training::run(args, quiet, html, interrupt),
        BenchCommand::Bag(args) => bag::run(args, quiet, html, interrupt),
        BenchCommand::Transport(args) => transport::run(args, quiet, html, interrupt),
        BenchCommand::Node(args) => node::run(args, html, interrupt),
        BenchCommand::Replay(args) => replay::run(args, html, interrupt),
        BenchCommand::View(args) => view::run(args, html, interrupt),
    }
}
