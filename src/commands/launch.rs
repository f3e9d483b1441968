//! `eddy launch`: several processes of eddy from one file.

use std::io::{self, Write as _};

use anyhow::Context;

use super::Interrupt;
use crate::cli::LaunchArgs;
use eddy_node::launch::{Plan, Said, supervise};
use eddy_settings as config;

/// Runs the file's processes until they have ended, or a signal comes. When it is to be quiet, so are they;
/// what they still say, they were asked for.
pub fn run(args: &LaunchArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let mut plan: Plan = config::load(&args.file)?;
    plan.check().with_context(|| args.file.display().to_string())?;
    let program = std::env::current_exe().context("cannot find the program itself")?;
    if quiet {
        plan.process.iter_mut().for_each(|process| process.run.insert(0, "--quiet".to_owned()));
    }
    let outcome = supervise(&plan, &program, interrupt.flag(), tell)?;
    if !quiet {
        let (restarts, killed) = (outcome.restarts, outcome.killed);
        tell(Said::Output(format!("all ended: {restarts} restarts, {killed} killed")));
    }
    Ok(())
}

/// Hands a line on. That nobody listens any more is no reason to end what runs.
fn tell(said: Said) {
    let _ = match said {
        Said::Output(line) => writeln!(io::stdout(), "{line}"),
        Said::Error(line) => writeln!(io::stderr(), "{line}"),
    };
}
