//! `eddy eval`: evaluates checkpoints by free rollouts over bags.
//!
//! 1. [`eddy_evaluation::Evaluation`]: the streams, the models, the rollouts and the report.
//! 2. [`compare`]: existing reports side by side.

mod compare;

use std::{num::NonZeroUsize, path::Path};

use anyhow::{Context, ensure};
use serde_json::json;

use super::{counted, streams, surrogate};
use crate::cli::{EvalArgs, ReferenceName};
use eddy_cli::{Interrupt, Output, OutputKind, TerminalProgress, terminal};
use eddy_evaluation::{Evaluation, EvaluationRequest, Recorded, Reference, Report, Settings};
use eddy_inference::checkpoint::{Checkpoint, Rule};
use eddy_pages::wrapped;
use eddy_settings::ensure_usage;

/// Before what is said of a model.
const INDENT: &str = "    ";

/// Evaluates all checkpoints on the same frames, prints the tables and writes the report.
pub fn run(args: EvalArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    if !args.compare.is_empty() {
        return compare::run(&args);
    }
    if args.list_starts {
        return list_starts(&args, interrupt);
    }
    // Required by the command line.
    let folder = args.output.as_deref().context("--output: expected a directory")?;
    let room = Output::at(folder, OutputKind::Report, args.force, &[])?;
    let progress = TerminalProgress::new(quiet, interrupt);
    let load = |checkpoint: &Checkpoint| {
        surrogate::on_device(checkpoint, Some(NonZeroUsize::MIN), args.device)
    };
    let evaluation = Evaluation::with_models(request(&args)?, &load, &progress)?;
    evaluation.remarks().iter().for_each(|remark| println!("{remark}"));
    evaluation.warnings().iter().for_each(|warning| tracing::warn!("{warning}"));
    let report = evaluation.run(&progress)?;
    report.save(folder).with_context(|| format!("cannot write to {}", folder.display()))?;
    room.replaced();
    println!(
        "{} over {}, compared for {}",
        counted(report.windows as u64, "free rollout"),
        counted(report.streams as u64, "stream"),
        counted(report.horizon as u64, "frame"),
    );
    println!("rollouts go on to frame {} to find blow-ups", report.reach);
    print_report(&report, folder, args.tables);
    if !args.tables {
        println!("        with errors, physical measures and kinds of scenes, as does --tables");
    }
    Ok(())
}

/// Prints the first table, or all of them, what they say of each model, and where the report is.
pub(super) fn print_report(report: &Report, folder: &Path, all: bool) {
    let columns = terminal::columns();
    let tables = if all { report.tables(columns) } else { report.first_table(columns) };
    print!("{tables}");
    for (name, sentences) in report.verdicts() {
        println!("{name}");
        let sentences = wrapped(&sentences.join(" "), columns.saturating_sub(INDENT.len()));
        sentences.lines().for_each(|line| println!("{INDENT}{line}"));
    }
    if let Some(winner) = report.winner() {
        println!("{}", wrapped(&winner, columns));
    }
    println!("report: {}", folder.join("report.html").display());
}

fn request(args: &EvalArgs) -> anyhow::Result<EvaluationRequest> {
    ensure_usage!(args.horizon > 0, "--horizon: found 0, expected at least 1 frame");
    ensure_usage!(args.starts > 0, "--starts: found 0, expected at least 1 per stream");
    let mut checkpoints: Vec<(String, Checkpoint)> = args
        .checkpoint
        .iter()
        .map(|path| Ok((path.display().to_string(), Checkpoint::load_or_shipped(Some(path))?)))
        .collect::<anyhow::Result<_>>()?;
    disable_rules(&args.without_rules, &mut checkpoints)?;
    let recorded = args.predictions.iter().map(|(name, bag)| Recorded::open(name.clone(), bag));
    let recorded = recorded.collect::<Result<_, _>>()?;
    let reference = |name: &ReferenceName| match name {
        ReferenceName::Mpm => Reference::Restart,
        ReferenceName::Chaos => Reference::Chaos,
    };
    Ok(EvaluationRequest {
        checkpoints,
        recorded,
        streams: streams::load(&args.data, args.skip_streams)?,
        stiffness: args.stiffness,
        settings: Settings::full(args.horizon, args.starts),
        references: args.references.iter().map(reference).collect(),
        join_late: args.join_late,
        threads: args.threads,
    })
}

/// Prints what a program needs to know that records rollouts for this evaluation.
fn list_starts(args: &EvalArgs, interrupt: &Interrupt) -> anyhow::Result<()> {
    let progress = TerminalProgress::new(true, interrupt);
    let evaluation = Evaluation::new(request(args)?, &progress)?;
    let streams: Vec<_> = evaluation
        .starts()
        .map(|(bag, stream, sequences)| json!({ "bag": bag, "stream": stream, "sequences": sequences }))
        .collect();
    println!("{}", json!({ "horizon": args.horizon, "streams": streams }));
    Ok(())
}

/// Switches rules off and adds them to the names of the checkpoints.
fn disable_rules(rules: &[Rule], checkpoints: &mut [(String, Checkpoint)]) -> anyhow::Result<()> {
    for rule in rules {
        ensure!(
            checkpoints.iter().any(|(_, checkpoint)| checkpoint.description.rules.has(*rule)),
            "--without-rules: none of the checkpoints has the rule {rule}"
        );
    }
    for (name, checkpoint) in checkpoints {
        let disabled = checkpoint.description.rules.disable(rules);
        if !disabled.is_empty() {
            let words: Vec<_> = disabled.iter().map(|rule| rule.name()).collect();
            name.push_str(&format!(" without {}", words.join(", ")));
        }
    }
    Ok(())
}
