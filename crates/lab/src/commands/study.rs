//! `eddy study`: the paper's comparisons.

use anyhow::Context;

use super::{
    StudyArgs,
    output::{COLUMNS, print},
};
use crate::study::{self, StudyConfig, StudyRequest};
use eddy_frames::progress::Progress;
use eddy_settings::{Overrides, usage::Usage};

/// Runs a comparison and prints the summaries of its report.
///
/// # Errors
/// Settings out of range; errors of the comparison.
pub fn run(args: StudyArgs, progress: &dyn Progress) -> anyhow::Result<()> {
    let request = request(args)?;
    let warning = request.study.warning(request.comparison);
    if let Some(warning) = &warning {
        progress.message(warning);
    }
    let outcome = study::run(&request, progress)?;
    if let Some(warning) = &warning {
        print(&format!("\n{warning}"))?;
    }
    for (heading, table) in &outcome.summaries {
        print(&format!("\n{heading}: {}\n{}", table.caption(), table.plain(COLUMNS)))?;
    }
    print(&format!("\n{}", outcome.page.display()))
}

/// The settings of the preset, overridden by the file.
fn request(args: StudyArgs) -> anyhow::Result<StudyRequest> {
    let StudyArgs {
        comparison, paper, mended, config, output, jobs, device, gpus, precision, ..
    } = args;
    let defaults = match (paper, mended) {
        (true, _) => StudyConfig::paper(),
        (_, true) => StudyConfig::mended(),
        _ => StudyConfig::quick(),
    };
    let study = match &config {
        Some(file) => Overrides::read(file)?.over(&defaults)?,
        None => defaults,
    };
    let request = StudyRequest { comparison, study, output, jobs, device, gpus, precision };
    match &config {
        Some(file) => request.check().with_context(|| file.display().to_string())?,
        None => {
            request.check().map_err(|error| Usage::new(format_args!("command line: {error}")))?
        }
    }
    Ok(request)
}
