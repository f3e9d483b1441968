//! `eddy eval`: judges checkpoints by free rollouts over bags.
//!
//! 1. [`survey`]: the streams, what they have in common, which of them no checkpoint has seen.
//! 2. [`rivals`]: what the streams were simulated from, for solvers that start from the same frames.
//! 3. [`contest`]: who is judged; scenes in parallel, then the time of a frame, then the report.
//! 4. [`compare`]: reports that were written before, side by side.

mod compare;
mod contest;
mod rivals;
mod survey;

use std::path::Path;

use anyhow::{Context, ensure};

use super::{Interrupt, surrogate};
use crate::cli::EvalArgs;
use eddy::{
    checkpoint::Checkpoint,
    dataset,
    eval::{Report, Settings},
    page::Provenance,
};

pub(super) use contest::judge_alone;

use contest::Contest;
use survey::Survey;

/// Judges all checkpoints on the same frames, prints the tables and writes the report.
pub fn run(args: EvalArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    if !args.compare.is_empty() {
        return compare::run(&args.compare, args.output.as_deref());
    }
    // Wrong usage without it.
    let folder = args.output.as_deref().context("--output: found none, expected a folder")?;
    keep(folder)?;
    let report = judge(&args, quiet, interrupt)?;
    report.save(folder).with_context(|| format!("cannot write to {}", folder.display()))?;
    println!(
        "{} free rollouts over {} streams, compared for {} frames, watched for {}",
        report.windows, report.streams, report.horizon, report.reach
    );
    println!("{}", report.tables());
    println!("{}", folder.join("report.html").display());
    Ok(())
}

/// Refuses a folder with the report of another command; that of the same one is made again.
fn keep(folder: &Path) -> anyhow::Result<()> {
    if !folder.join("report.json").exists() {
        return Ok(());
    }
    let found = Report::load(folder)?.made.command;
    ensure!(
        found == Provenance::here().command,
        "{}: found the report of `{found}`, expected none, or one of this command",
        folder.display()
    );
    Ok(())
}

/// The judgement alone.
pub(super) fn judge(args: &EvalArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<Report> {
    ensure!(args.horizon > 0, "--horizon: found 0, expected at least 1 frame");
    ensure!(args.starts > 0, "--starts: found 0, expected at least 1 a stream");
    let settings = Settings::full(args.horizon, args.starts);
    let checkpoints: Vec<(String, Checkpoint)> = args
        .checkpoint
        .iter()
        .map(|path| Ok((path.display().to_string(), surrogate::checkpoint(Some(path))?)))
        .collect::<anyhow::Result<_>>()?;
    let streams =
        dataset::load_trajectories(&args.data, dataset::available_memory() / 2, &mut |_, _| ())?;
    let descriptions: Vec<_> = checkpoints.iter().map(|(_, c)| &c.description).collect();
    let survey = Survey::new(settings, &descriptions, streams)?;
    let contest = Contest::new(args, checkpoints, survey, interrupt)?;
    contest.judge(quiet, interrupt)
}
