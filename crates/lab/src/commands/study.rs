//! `eddy-lab study`: the paper's comparisons.

use std::num::NonZeroUsize;

use anyhow::Context;

use super::{StudyArgs, StudyChoice, output::COLUMNS};
use crate::study::{self, StudyConfig, StudyRequest};
use eddy_cli::keep_freed_memory;
use eddy_frames::progress::Progress;
use eddy_settings::{Overrides, usage::Usage};

/// Runs a comparison and prints the summaries of its report.
///
/// # Errors
/// Settings out of range; errors of the comparison.
pub fn run(args: StudyArgs, progress: &dyn Progress) -> anyhow::Result<()> {
    keep_freed_memory();
    let StudyArgs { choice, jobs, gpus } = args;
    let request = StudyRequest { jobs, gpus, ..request(choice)? };
    let warning = request.study.warning(request.comparison);
    if let Some(warning) = &warning {
        progress.message(warning);
    }
    let outcome = study::run(&request, progress)?;
    if let Some(warning) = &warning {
        println!("\n{warning}");
    }
    for (heading, table) in &outcome.summaries {
        println!("\n{heading}: {}\n{}", table.caption(), table.plain(COLUMNS));
    }
    println!("\n{}", outcome.page.display());
    Ok(())
}

/// The settings of the preset, overridden by the file; one job on one GPU.
///
/// # Errors
/// Settings out of range.
pub fn request(choice: StudyChoice) -> anyhow::Result<StudyRequest> {
    let StudyChoice { comparison, paper, mended, config, output, device, precision, .. } = choice;
    let (jobs, gpus) = (NonZeroUsize::MIN, NonZeroUsize::MIN);
    let defaults = match (paper, mended) {
        (true, _) => StudyConfig::paper(),
        (_, true) => StudyConfig::mended(),
        _ => StudyConfig::quick(),
    };
    let study = match &config {
        Some(file) => Overrides::read(file)?.renamed("judging", "evaluation").over(&defaults)?,
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
