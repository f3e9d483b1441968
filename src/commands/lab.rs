//! `eddy bench` and `eddy study`, from [`eddy_lab`].

use super::{Interrupt, TerminalProgress, allocator};
use eddy_lab::commands::{self, BenchArgs, BenchCommand, StudyArgs};

/// Runs one of the benchmarks.
pub fn bench(args: BenchArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    if matches!(args.command, BenchCommand::Training(_)) {
        allocator::keep_freed_memory();
    }
    commands::bench(args, &TerminalProgress::new(quiet, interrupt))
}

/// Runs one of the paper's comparisons.
pub fn study(args: StudyArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    allocator::keep_freed_memory();
    commands::study(args, &TerminalProgress::new(quiet, interrupt))
}
