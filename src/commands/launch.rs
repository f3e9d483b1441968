//! `eddy launch`: several processes of eddy from one file.

use anyhow::Context;

use super::Interrupt;
use crate::cli::LaunchArgs;
use eddy::{
    config,
    launch::{Plan, supervise},
};

/// Runs the file's processes until they have ended, or a signal comes.
pub fn run(args: &LaunchArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let plan: Plan = config::load(&args.file)?;
    plan.check().with_context(|| args.file.display().to_string())?;
    let program = std::env::current_exe().context("cannot find the program itself")?;
    let outcome = supervise(&plan, &program, interrupt.flag(), |line| {
        if !quiet {
            println!("{line}");
        }
    })?;
    if !quiet {
        println!("all ended: {} restarts, {} killed", outcome.restarts, outcome.killed);
    }
    Ok(())
}
