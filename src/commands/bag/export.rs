//! `eddy bag export`.

use std::path::{Path, PathBuf};

use anyhow::Context;

use super::{find_streams, watch};
use crate::{
    cli::ExportArgs,
    commands::{
        Interrupt, counted,
        output::{Output, OutputKind},
        progress_bar,
    },
};
use eddy_exchange::{FrameSelection, export};

/// Writes frames as files for other programs.
pub fn run(args: ExportArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    // Required by the command line.
    let format = args.format.context("--format: expected a format")?;
    let stem = stem(&args.bags);
    let inputs = args.bags.clone();
    let choice = FrameSelection {
        bags: args.bags,
        topic: args.topic,
        stream: args.stream,
        frames: args.frames.map(|frames| frames as usize),
    };
    let streams = find_streams(&choice, quiet, interrupt)?;
    let count = streams.tracks().len();
    let output = args.output.unwrap_or_else(|| PathBuf::from(format.output_name(&stem, count)));
    let room = Output::at(&output, OutputKind::Export, args.force, &inputs)?;
    let bar = progress_bar(streams.frames() as u64, "frames", quiet);
    let outcome = export(&streams, format, &output, &mut watch(&bar, interrupt));
    bar.finish_and_clear();
    outcome?;
    room.replaced();
    let (count, frames) =
        (counted(count as u64, "stream"), counted(streams.frames() as u64, "frame"));
    println!("{}: {count}, {frames}", output.display());
    Ok(())
}

/// Stem of the default output name.
pub(super) fn stem(bags: &[PathBuf]) -> String {
    let stem = |bag: &Path| Some(bag.file_stem()?.to_string_lossy().into_owned());
    bags.first().and_then(|bag| stem(bag)).unwrap_or_else(|| "frames".into())
}
