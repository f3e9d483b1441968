//! `eddy eval`: judges checkpoints by free rollouts over bags.

use anyhow::Context;
use indicatif::ProgressBar;

use super::{Interrupt, progress_bar, surrogate};
use crate::cli::EvalArgs;
use eddy::{
    checkpoint::Checkpoint,
    dataset::{self, Dataset, Stream},
    eval::{Report, Settings, judge},
    model::Surrogate,
};

/// Judges each checkpoint, prints its tables and writes its report.
pub fn run(args: EvalArgs, quiet: bool, _interrupt: &Interrupt) -> anyhow::Result<()> {
    let settings = Settings { horizon: args.horizon.max(1), starts: args.starts.max(1) };
    let several = args.checkpoint.len() > 1;
    let streams = dataset::load_streams(&args.data)?;
    let digest = dataset::digest(&streams);
    for path in &args.checkpoint {
        let name = path.display().to_string();
        let checkpoint = surrogate::checkpoint(Some(path))?;
        let unseen = unseen(&checkpoint, &args, &digest, &streams)?;
        let surrogate = Surrogate::load(&checkpoint, args.device).context(name.clone())?;
        let bar = progress_bar((unseen.len() * settings.starts) as u64, "rollouts", quiet);
        let report = judge_one(&surrogate, name, &digest, &unseen, settings, &bar)?;
        bar.finish_and_clear();

        let folder = match path.file_name() {
            Some(last) if several => args.output.join(last),
            _ => args.output.clone(),
        };
        report.save(&folder).with_context(|| format!("cannot write to {}", folder.display()))?;
        println!(
            "{} ({} free rollouts of {} frames over {} streams, {} diverged)",
            report.checkpoint,
            report.windows,
            report.horizon,
            report.streams,
            report.diverged_windows
        );
        println!("{}", report.tables());
        println!("{}", folder.join("report.json").display());
    }
    Ok(())
}

/// Rolls out over `streams` and puts the report together.
pub(super) fn judge_one(
    surrogate: &Surrogate,
    name: String,
    data_digest: &str,
    streams: &[Stream],
    settings: Settings,
    bar: &ProgressBar,
) -> anyhow::Result<Report> {
    let judgement = judge(surrogate, streams, settings, || bar.inc(1))?;
    let description = surrogate.description();
    let digest = surrogate.digest().to_owned();
    let data = data_digest.to_owned();
    Ok(Report::new(name, digest, data, streams.len(), description.dt, &judgement))
}

/// All streams, but only the test part where the checkpoint has learned from these very bags.
fn unseen(
    checkpoint: &Checkpoint,
    args: &EvalArgs,
    digest: &str,
    streams: &[Stream],
) -> anyhow::Result<Vec<Stream>> {
    if checkpoint.description.data != digest {
        return Ok(streams.to_vec());
    }
    let test = Dataset::load(&args.data)?.test;
    println!("this is what the checkpoint was trained on: only its test part is judged");
    Ok(test)
}
