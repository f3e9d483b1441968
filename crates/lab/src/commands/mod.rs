//! `eddy bench`, `eddy study` and `eddy plan`: arguments, and output as tables, JSON or HTML.

mod args;
mod bag;
mod group;
mod inference;
mod node;
mod output;
mod plan;
mod replay;
mod solver;
mod study;
mod training;
mod transport;
mod view;

pub use args::{BenchArgs, BenchCommand, PlanListArgs, PlanRunArgs, StudyArgs, StudyChoice};
pub use plan::{list as plan_list, run as plan_run, save as plan_save};
pub use study::{request as study_request, run as study};

use eddy_frames::progress::Progress;
use output::{BenchOutput, table};

/// Runs a benchmark and prints its results.
///
/// # Errors
/// Errors of the benchmark; an argument out of range.
pub fn bench(args: BenchArgs, progress: &dyn Progress) -> anyhow::Result<()> {
    let html = args.html.as_deref();
    match args.command {
        BenchCommand::Solver(args) => solver::run(args, html, progress),
        BenchCommand::Inference(args) => inference::run(args, html, progress),
        BenchCommand::Training(args) => training::run(args, html, progress),
        BenchCommand::Bag(args) => bag::run(args, html, progress),
        BenchCommand::Transport(args) => transport::run(args, html, progress),
        BenchCommand::Node(args) => node::run(args, html, progress),
        BenchCommand::Group(args) => group::run(args, html, progress),
        BenchCommand::Replay(args) => replay::run(args, html, progress),
        BenchCommand::View(args) => view::run(args, html, progress),
    }
}
