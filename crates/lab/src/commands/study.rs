//! `eddy study`: the paper's comparisons.

use anyhow::Context;

use super::{StudyArgs, plain_text};
use crate::study::{self, StudyConfig, StudyRequest};
use eddy_frames::progress::Progress;
use eddy_settings::Overrides;

/// Runs a comparison and prints the summaries of its report.
///
/// # Errors
/// Settings out of range; errors of the comparison.
pub fn run(args: StudyArgs, progress: &dyn Progress) -> anyhow::Result<()> {
    let request = request(args)?;
    let outcome = study::run(&request, progress)?;
    for (heading, table) in &outcome.summaries {
        println!("\n{heading}: {}\n{}", table.caption(), plain_text(table));
    }
    println!("\n{}", outcome.page.display());
    Ok(())
}

/// The settings of the preset, overridden by the file.
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
