//! `eddy bag export`.

use std::path::{Path, PathBuf};

use anyhow::Context;

use super::{find_streams, watch};
use crate::{
    cli::ExportArgs,
    commands::{Interrupt, progress_bar},
};
use eddy_exchange::{FrameSelection, export};

/// Writes frames as files of other programs.
pub fn run(args: ExportArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    // Wrong usage without it.
    let format = args.format.context("--format: found none, expected one")?;
    let stem = stem(&args.bags);
    let choice = FrameSelection {
        bags: args.bags,
        topic: args.topic,
        stream: args.stream,
        frames: args.frames.map(|frames| frames as usize),
    };
    let streams = find_streams(&choice, quiet, interrupt)?;
    let count = streams.tracks().len();
    let output = args.output.unwrap_or_else(|| PathBuf::from(format.output_name(&stem, count)));
    let bar = progress_bar(streams.frames() as u64, "frames", quiet);
    let outcome = export(&streams, format, &output, &mut watch(&bar, interrupt));
    bar.finish_and_clear();
    outcome?;
    println!("streams: {count}, frames: {}: {}", streams.frames(), output.display());
    Ok(())
}

/// What an output is named after.
pub(super) fn stem(bags: &[PathBuf]) -> String {
    let stem = |bag: &Path| Some(bag.file_stem()?.to_string_lossy().into_owned());
    bags.first().and_then(|bag| stem(bag)).unwrap_or_else(|| "frames".into())
}
