//! `eddy eval`: judges checkpoints by free rollouts over bags.

use std::{borrow::Cow, path::PathBuf};

use anyhow::{Context, bail, ensure};
use indicatif::ProgressBar;

use super::{Interrupt, progress_bar, surrogate};
use crate::cli::EvalArgs;
use eddy::{
    checkpoint::Checkpoint,
    dataset::{self, Stream},
    engine::Surrogate,
    eval::{Report, Settings, judge},
};

/// Judges each checkpoint, prints its tables and writes its report.
pub fn run(args: EvalArgs, quiet: bool, _interrupt: &Interrupt) -> anyhow::Result<()> {
    ensure!(args.horizon > 0, "--horizon: found 0, expected at least 1 frame");
    ensure!(args.starts > 0, "--starts: found 0, expected at least 1 a stream");
    let settings = Settings { horizon: args.horizon, starts: args.starts };
    let folders = folders(&args)?;
    let streams = dataset::load_streams(&args.data)?;
    let digest = dataset::digest(&streams);
    for (path, folder) in args.checkpoint.iter().zip(&folders) {
        let name = path.display().to_string();
        let checkpoint = surrogate::checkpoint(Some(path))?;
        let unseen = unseen(&checkpoint, &digest, &streams);
        let surrogate = Surrogate::load(&checkpoint, args.threads).context(name.clone())?;
        let bar = progress_bar((unseen.len() * settings.starts) as u64, "rollouts", quiet);
        let report = judge_one(&surrogate, name, &digest, &unseen, settings, &bar)?;
        bar.finish_and_clear();

        report.save(folder).with_context(|| format!("cannot write to {}", folder.display()))?;
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
fn unseen<'a>(checkpoint: &Checkpoint, digest: &str, streams: &'a [Stream]) -> Cow<'a, [Stream]> {
    if checkpoint.description.data != digest {
        return Cow::Borrowed(streams);
    }
    println!("this is what the checkpoint was trained on: only its test part is judged");
    Cow::Owned(dataset::test_part(streams))
}

/// Where each report goes: the output itself for one checkpoint, a folder of the checkpoint's name
/// within it for several.
fn folders(args: &EvalArgs) -> anyhow::Result<Vec<PathBuf>> {
    if let [_] = args.checkpoint.as_slice() {
        return Ok(vec![args.output.clone()]);
    }
    let mut folders = Vec::new();
    for path in &args.checkpoint {
        let folder = args.output.join(path.file_name().unwrap_or_default());
        if folders.contains(&folder) {
            bail!(
                "--checkpoint: found two that end in {}, expected different names for their reports",
                path.file_name().unwrap_or_default().display()
            );
        }
        folders.push(folder);
    }
    Ok(folders)
}
