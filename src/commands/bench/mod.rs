//! `eddy bench`: tables for this machine.

mod bag;
mod inference;
mod node;
mod replay;
mod solver;
mod training;
mod transport;
mod view;

use comfy_table::{CellAlignment, Table, presets};

use super::Interrupt;
use crate::cli::{BenchArgs, BenchCommand};

/// Runs one of the benchmarks.
pub fn run(args: BenchArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    match args.command {
        BenchCommand::Solver(args) => solver::run(args, quiet, interrupt),
        BenchCommand::Inference(args) => inference::run(args, quiet, interrupt),
        BenchCommand::Training(args) => training::run(args, quiet, interrupt),
        BenchCommand::Bag(args) => bag::run(args, quiet, interrupt),
        BenchCommand::Transport(args) => transport::run(args, quiet, interrupt),
        BenchCommand::Node(args) => node::run(args, interrupt),
        BenchCommand::Replay(args) => replay::run(args, interrupt),
        BenchCommand::View(args) => view::run(args, interrupt),
    }
}

/// A table of numbers without lines.
fn table<T: ToString>(header: impl IntoIterator<Item = T>, rows: Vec<Vec<String>>) -> Table {
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(header.into_iter().map(|title| title.to_string()));
    table.add_rows(rows);
    for column in table.column_iter_mut() {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table
}
