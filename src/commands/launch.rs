//! `eddy launch`: several eddy processes from one file.

use std::io::{self, Write as _};

use anyhow::Context;

use crate::cli::LaunchArgs;
use eddy_cli::Interrupt;
use eddy_node::launch::{OutputLine, Plan, supervise};
use eddy_settings as config;

/// Runs the processes of a launch file until they have ended or a signal comes. `quiet` applies to them as well.
pub fn run(args: &LaunchArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let mut plan: Plan = config::load(&args.file)?;
    plan.check().with_context(|| args.file.display().to_string())?;
    let program = std::env::current_exe().context("cannot find the path of this program")?;
    if quiet {
        plan.process.iter_mut().for_each(|process| process.run.insert(0, "--quiet".to_owned()));
    }
    let outcome = supervise(&plan, &program, interrupt.flag(), print)?;
    if !quiet {
        let (restarts, killed) = (outcome.restarts, outcome.killed);
        let text = format!("all processes ended: {restarts} restarts, {killed} killed");
        print(OutputLine::Stdout(text));
    }
    Ok(())
}

/// Prints a line. A closed pipe does not end the processes.
fn print(line: OutputLine) {
    let _ = match line {
        OutputLine::Stdout(line) => writeln!(io::stdout(), "{line}"),
        OutputLine::Stderr(line) => writeln!(io::stderr(), "{line}"),
    };
}
