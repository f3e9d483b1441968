//! `eddy eval`: judges checkpoints by free rollouts over bags.
//!
//! 1. [`eddy_evaluation::Evaluation`]: the streams, the models, the rollouts and the report.
//! 2. [`compare`]: reports that were written before, side by side.

mod compare;

use std::path::Path;

use anyhow::{Context, ensure};

use super::{Interrupt, TerminalProgress};
use crate::cli::{EvalArgs, Rival, RuleName};
use eddy_evaluation::{
    Evaluation, EvaluationRequest, Reference, Report, Settings, dataset, page::Provenance,
};
use eddy_inference::checkpoint::{Checkpoint, Rule};

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
    ensure!(args.horizon > 0, "--horizon: found 0, expected at least 1 frame");
    ensure!(args.starts > 0, "--starts: found 0, expected at least 1 a stream");
    let mut checkpoints: Vec<(String, Checkpoint)> = args
        .checkpoint
        .iter()
        .map(|path| Ok((path.display().to_string(), Checkpoint::load_or_shipped(Some(path))?)))
        .collect::<anyhow::Result<_>>()?;
    switch_off(&args.without_rules, &mut checkpoints)?;
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

/// Switches rules off, and says so in the names of the checkpoints that had them.
fn switch_off(names: &[RuleName], checkpoints: &mut [(String, Checkpoint)]) -> anyhow::Result<()> {
    let rules: Vec<Rule> = names.iter().map(|&name| name.into()).collect();
    for rule in &rules {
        ensure!(
            checkpoints.iter().any(|(_, checkpoint)| checkpoint.description.rules.has(*rule)),
            "--without-rules: found {rule}, expected a rule that one of the checkpoints has"
        );
    }
    for (name, Checkpoint { description, .. }) in checkpoints {
        let on = Rule::ALL.into_iter().filter(|rule| rules.contains(rule));
        let on: Vec<_> = on.filter(|rule| description.rules.has(*rule)).collect();
        on.iter().for_each(|rule| description.rules.remove(*rule));
        if !on.is_empty() {
            let words: Vec<_> = on.iter().map(|rule| rule.name()).collect();
            name.push_str(&format!(" without {}", words.join(", ")));
        }
    }
    Ok(())
}

impl From<RuleName> for Rule {
    fn from(name: RuleName) -> Self {
        match name {
            RuleName::Area => Self::Area,
            RuleName::Shape => Self::Shape,
            RuleName::Flight => Self::Flight,
            RuleName::Rest => Self::Rest,
        }
    }
}
