//! `eddy bag export`.

use std::path::{Path, PathBuf};

use anyhow::{Context, ensure};

use super::{find_streams, messages, watch};
use crate::{cli::ExportArgs, commands::counted};
use eddy_bag::find_bags;
use eddy_cli::{Interrupt, Output, OutputKind, progress_bar};
use eddy_dataset::TRUTH_TOPIC;
use eddy_exchange::{ExportFormat, FrameSelection, Streams, export};
use eddy_settings::ensure_usage;

/// Writes frames as files for other programs.
pub fn run(args: ExportArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    // Required by the command line.
    let format = args.format.context("--format: expected a format")?;
    format.check()?;
    ensure_usage!(
        compares(format) || args.truth.is_none(),
        "--truth: expected the format vtu or vtkhdf, which have the error of each particle"
    );
    let choice = FrameSelection {
        bags: args.bags.clone(),
        topic: args.topic.clone(),
        stream: args.stream,
        frames: args.frames.map(|frames| frames as usize),
    };
    match choice.dimension()? {
        3 => write::<3>(args, format, &choice, quiet, interrupt),
        _ => write::<2>(args, format, &choice, quiet, interrupt),
    }
}

/// Whether files of the format have the distance of each particle from its true position.
fn compares(format: ExportFormat) -> bool {
    matches!(format, ExportFormat::Vtu | ExportFormat::Vtkhdf)
}

/// Writes frames of `D` dimensions.
fn write<const D: usize>(
    args: ExportArgs,
    format: ExportFormat,
    choice: &FrameSelection,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let stem = stem(&args.bags);
    let inputs: Vec<PathBuf> = args.bags.iter().chain(&args.truth).cloned().collect();
    let truth = match &args.truth {
        Some(truth) => vec![truth.clone()],
        None if compares(format) && args.topic != TRUTH_TOPIC => with_truth(&args.bags)?,
        None => Vec::new(),
    };
    let streams = find_streams::<D>(choice, quiet, interrupt)?;
    let truth = match truth.is_empty() {
        true => None,
        false => Some(find_streams(
            &FrameSelection {
                bags: truth,
                topic: TRUTH_TOPIC.to_owned(),
                ..FrameSelection::default()
            },
            quiet,
            interrupt,
        )?),
    };
    if let (Some(path), Some(truth)) = (&args.truth, &truth) {
        check_streams(path, truth, &streams)?;
    }
    let count = streams.tracks().len();
    let output = args.output.unwrap_or_else(|| PathBuf::from(format.output_name(&stem, count)));
    let room = Output::at(&output, OutputKind::Export, args.force, &inputs)?;
    let bar = progress_bar(streams.frames() as u64, "frames", quiet);
    let outcome = export(&streams, truth.as_ref(), format, &output, &mut watch(&bar, interrupt));
    bar.finish_and_clear();
    outcome?;
    room.replaced();
    let (count, frames) =
        (counted(count as u64, "stream"), counted(streams.frames() as u64, "frame"));
    println!("{}: {count}, {frames}", output.display());
    Ok(())
}

/// The bags with true frames.
fn with_truth(bags: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut found = Vec::new();
    for bag in find_bags(bags)? {
        if messages(std::slice::from_ref(&bag), TRUTH_TOPIC)? > 0 {
            found.push(bag);
        }
    }
    Ok(found)
}

/// Checks that the truth has all streams.
fn check_streams<const D: usize>(
    path: &Path,
    truth: &Streams<D>,
    streams: &Streams<D>,
) -> anyhow::Result<()> {
    let known: Vec<u64> = truth.tracks().iter().map(|track| track.stream).collect();
    for track in streams.tracks() {
        ensure!(
            known.contains(&track.stream),
            "{}: found streams {known:?}, expected {} as in {}",
            path.display(),
            track.stream,
            track.bag.display()
        );
    }
    Ok(())
}

/// Stem of the default output name.
pub(super) fn stem(bags: &[PathBuf]) -> String {
    let stem = |bag: &Path| Some(bag.file_stem()?.to_string_lossy().into_owned());
    bags.first().and_then(|bag| stem(bag)).unwrap_or_else(|| "frames".into())
}
