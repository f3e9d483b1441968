//! `eddy eval`: judges checkpoints by free rollouts over bags.
//!
//! 1. [`eddy::eval::Evaluation`]: the streams, the models, the rollouts and the report.
//! 2. [`compare`]: reports that were written before, side by side.

mod compare;

use std::path::Path;

use anyhow::{Context, ensure};

use super::{Interrupt, TerminalProgress, surrogate};
use crate::cli::{EvalArgs, Rival};
use eddy::{
    dataset,
    eval::{Evaluation, EvaluationRequest, Reference, Report, Settings},
    page::Provenance,
};

/// Judges all checkpoints on the same frames, prints the tables and writes the report.
pub fn run(args: EvalArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    if !args.compare.is_empty() {
        return compare::run(&args.compare, args.output.as_deref());
    }
    // Wrong usage without it.
    let folder = args.output.as_deref().context("--output: found none, expected a folder")?;
    keep(folder)?;
    let progress = TerminalProgress::new(quiet, interrupt);
    let evaluation = Evaluation::new(request(&args)?, &progress)?;
    evaluation.remarks().iter().for_each(|remark| println!("{remark}"));
    let report = evaluation.run(&progress)?;
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

/// What was asked for.
fn request(args: &EvalArgs) -> anyhow::Result<EvaluationRequest> {
    let checkpoints = args
        .checkpoint
        .iter()
        .map(|path| Ok((path.display().to_string(), surrogate::checkpoint(Some(path))?)))
        .collect::<anyhow::Result<_>>()?;
    let memory = dataset::available_memory() / 2;
    let reference = |rival: &Rival| match rival {
        Rival::Mpm => Reference::Restart,
        Rival::Chaos => Reference::Chaos,
    };
    Ok(EvaluationRequest {
        checkpoints,
        streams: dataset::load_trajectories(&args.data, memory, &mut |_, _| ())?,
        settings: Settings::full(args.horizon, args.starts),
        references: args.rivals.iter().map(reference).collect(),
        join_late: args.join_late,
        threads: args.threads,
    })
}
