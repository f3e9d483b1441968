//! `eddy-lab bench`, `eddy-lab study` and `eddy-lab plan`: arguments, and output as tables, JSON or HTML.

mod args;
mod bag;
mod group;
mod inference;
mod node;
mod output;
mod plan;
mod plan_args;
mod replay;
mod solver;
mod study;
mod training;
mod transport;
mod view;

pub use args::{BenchArgs, BenchCommand, StudyArgs, StudyChoice};
pub use plan::run as plan;
pub use plan_args::{PlanArgs, PlanCommand};
pub use study::run as study;

use eddy_cli::{Output, OutputKind, keep_freed_memory};
use eddy_frames::progress::Progress;
use output::{BenchOutput, table};

/// Runs a benchmark and prints its results.
pub fn bench(args: BenchArgs, progress: &dyn Progress) -> anyhow::Result<()> {
    // Before the first thread starts: threads inherit all of this.
    args.real_time.apply()?;
    let html = args.html.as_deref();
    let room = html.map(|html| Output::at(html, OutputKind::Page, args.force, &[])).transpose()?;
    match args.command {
        BenchCommand::Solver(args) => solver::run(args, html, progress),
        BenchCommand::Inference(args) => inference::run(args, html, progress),
        BenchCommand::Training(args) => {
            keep_freed_memory();
            training::run(args, html, progress)
        }
        BenchCommand::Bag(args) => bag::run(args, html, progress),
        BenchCommand::Transport(args) => transport::run(args, html, progress),
        BenchCommand::Node(args) => node::run(args, html, progress),
        BenchCommand::Group(args) => group::run(args, html, progress),
        BenchCommand::Replay(args) => replay::run(args, html, progress),
        BenchCommand::View(args) => view::run(args, html, progress),
    }?;
    room.into_iter().for_each(Output::replaced);
    Ok(())
}
