//! `eddy bench` and `eddy study`, from [`eddy_lab`].

use std::path::PathBuf;

use crate::cli::RealTimeBenchArgs;
use eddy_cli::{Interrupt, Output, OutputKind, TerminalProgress, keep_freed_memory};
use eddy_lab::commands::{self, BenchCommand, StudyArgs};

/// Runs one of the benchmarks.
pub fn bench(args: RealTimeBenchArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    // Before the first thread starts: threads inherit all of this.
    args.real_time.apply()?;
    let args = args.bench;
    if matches!(args.command, BenchCommand::Training(_)) {
        keep_freed_memory();
    }
    let room = |html: &PathBuf| Output::at(html, OutputKind::Page, args.force, &[]);
    let room = args.html.as_ref().map(room).transpose()?;
    commands::bench(args, &TerminalProgress::new(quiet, interrupt))?;
    room.into_iter().for_each(Output::replaced);
    Ok(())
}

/// Runs one of the paper's comparisons.
pub fn study(args: StudyArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    keep_freed_memory();
    commands::study(args, &TerminalProgress::new(quiet, interrupt))
}
