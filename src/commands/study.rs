//! `eddy study`: the paper's comparisons, from nothing to a report.

use anyhow::Context;

use super::{Interrupt, TerminalProgress, bench::printed, pages};
use crate::cli::StudyArgs;
use eddy::{
    config::Overrides,
    study::{self, StudyConfig, StudyRequest},
};

/// Runs a comparison, and prints the summaries of its report.
pub fn run(args: StudyArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let request = request(args)?;
    pages::keep_freed();
    let outcome = study::run(&request, &TerminalProgress::new(quiet, interrupt))?;
    for (heading, table) in &outcome.summaries {
        println!("\n{heading}: {}\n{}", table.caption(), printed(table));
    }
    println!("\n{}", outcome.page.display());
    Ok(())
}

/// A preset's settings, then those of the file.
fn request(args: StudyArgs) -> anyhow::Result<StudyRequest> {
    let StudyArgs { comparison, paper, config, output, jobs, device, .. } = args;
    let defaults = if paper { StudyConfig::paper() } else { StudyConfig::quick() };
    let study = match &config {
        Some(file) => Overrides::read(file)?.over(&defaults)?,
        None => defaults,
    };
    let request = StudyRequest { comparison, study, output, jobs, device };
    request.check().with_context(|| match &config {
        Some(file) => file.display().to_string(),
        None => "command line".to_owned(),
    })?;
    Ok(request)
}
