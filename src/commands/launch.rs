//! `eddy launch`: several processes of eddy from one file.

use std::io::{self, Write as _};

use anyhow::Context;

use super::Interrupt;
use crate::cli::LaunchArgs;
use eddy::{
    config,
    launch::{Plan, Said, supervise},
};

/// Runs the file's processes until they have ended, or a signal comes.
pub fn run(args: &LaunchArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let plan: Plan = config::load(&args.file)?;
    plan.check().with_context(|| args.file.display().to_string())?;
    let program = std::env::current_exe().context("cannot find the program itself")?;
    let outcome = supervise(&plan, &program, interrupt.flag(), |said| tell(said, quiet))?;
    let summary = format!("all ended: {} restarts, {} killed", outcome.restarts, outcome.killed);
    tell(Said::Output(summary), quiet);
    Ok(())
}

/// Hands a line on. That nobody listens any more is no reason to end what runs.
fn tell(said: Said, quiet: bool) {
    let _ = match said {
        Said::Output(_) if quiet => Ok(()),
        Said::Output(line) => writeln!(io::stdout(), "{line}"),
        Said::Error(line) => writeln!(io::stderr(), "{line}"),
    };
}
