//! `eddy bag`: looks into bags, makes bags of bags, takes frames out of them and into them.

mod check;
mod edit;
mod export;
mod import;
mod info;
mod recover;
mod reindex;
mod render;

use std::{collections::BTreeSet, path::PathBuf, process::ExitCode};

use indicatif::ProgressBar;

use super::{Interrupt, progress_bar};
use crate::cli::{BagArgs, BagCommand, NewBagArgs};
use eddy_bag::{BagError, BagReader, BagSummary, Compression, Survey, WriterOptions, find_bags};
use eddy_exchange::{ExchangeError, FrameSelection, Streams};

/// So many messages pass between two looks at the progress bar.
const PROGRESS_STEP: u64 = 64;

/// Runs one of the subcommands.
pub fn run(args: BagArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<ExitCode> {
    match args.command {
        BagCommand::Recover(args) => return recover::run(&args, quiet, interrupt),
        BagCommand::Cut(args) => edit::cut(&args, quiet, interrupt),
        BagCommand::Merge(args) => edit::merge(&args, quiet, interrupt),
        BagCommand::Filter(args) => edit::filter(args, quiet, interrupt),
        BagCommand::Cloud(args) => edit::cloud(&args, quiet, interrupt),
        BagCommand::Reindex { bag } => reindex::run(&bag, quiet, interrupt),
        BagCommand::Info { bag } => info::run(&bag, quiet),
        BagCommand::Check { bag } => check::run(&bag, quiet),
        BagCommand::Export(args) if args.cloud => edit::export_cloud(args, quiet, interrupt),
        BagCommand::Export(args) => export::run(args, quiet, interrupt),
        BagCommand::Import(args) => import::run(args, quiet, interrupt),
        BagCommand::Render(args) => render::run(args, quiet, interrupt),
    }
    .map(|()| ExitCode::SUCCESS)
}

/// How a bag made of `bags` is written.
fn writer_options(new: &NewBagArgs, bags: &[BagReader]) -> WriterOptions {
    let found: BTreeSet<&str> = bags.iter().flat_map(BagReader::compressions).collect();
    let as_before = match found.into_iter().collect::<Vec<_>>()[..] {
        ["none"] => Compression::None,
        ["lz4"] => Compression::Lz4,
        _ => Compression::Zstd,
    };
    let compression = new.compression.map_or(as_before, Compression::from);
    WriterOptions { compression, ..WriterOptions::default() }
}

/// Says what was written.
fn report(bag: &BagSummary) {
    println!(
        "{}: {} messages on {} topics",
        bag.directory.display(),
        bag.messages,
        bag.topics.len()
    );
}

fn survey(bag: &BagReader, quiet: bool) -> Survey {
    let bar = progress_bar(bag.message_count(), "messages", quiet);
    let survey = Survey::of(bag, |read| {
        if read % PROGRESS_STEP == 0 {
            bar.set_position(read);
        }
    });
    bar.finish_and_clear();
    survey
}

/// Reads bags once to know their streams.
fn find_streams(
    choice: &FrameSelection,
    quiet: bool,
    interrupt: &Interrupt,
) -> Result<Streams, ExchangeError> {
    let bar = progress_bar(messages(&choice.bags, &choice.topic)?, "messages", quiet);
    let streams = Streams::find(choice, &mut watch(&bar, interrupt));
    bar.finish_and_clear();
    streams
}

/// How many messages of the topic the bags have.
fn messages(bags: &[PathBuf], topic: &str) -> Result<u64, BagError> {
    let mut messages = 0;
    for bag in find_bags(bags)? {
        let bag = BagReader::open(&bag)?;
        let of_topic = bag.topics().iter().filter(|info| info.name == topic);
        messages += of_topic.map(|info| info.message_count).sum::<u64>();
    }
    Ok(messages)
}

/// Moves the bar by the bytes of each call, and goes on until a signal comes.
fn watch_bytes<'a>(bar: &'a ProgressBar, interrupt: &'a Interrupt) -> impl FnMut(u64) -> bool + 'a {
    move |bytes| {
        bar.inc(bytes);
        !interrupt.requested()
    }
}

/// Moves the bar by one frame at each call, and goes on until a signal comes.
fn watch<'a>(bar: &'a ProgressBar, interrupt: &'a Interrupt) -> impl FnMut() -> bool + 'a {
    move || {
        bar.inc(1);
        !interrupt.requested()
    }
}
