//! `eddy bench` and `eddy study`, which [`eddy_lab`] runs.

use super::{Interrupt, TerminalProgress, pages};
use eddy_lab::commands::{self, BenchArgs, BenchCommand, StudyArgs};

/// Runs one of the benchmarks.
pub fn bench(args: BenchArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    if matches!(args.command, BenchCommand::Training(_)) {
        pages::keep_freed();
    }
    commands::bench(args, &TerminalProgress::new(quiet, interrupt))
}

/// Runs one of the paper's comparisons.
pub fn study(args: StudyArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    pages::keep_freed();
    commands::study(args, &TerminalProgress::new(quiet, interrupt))
}
