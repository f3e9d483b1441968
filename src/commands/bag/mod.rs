//! `eddy bag`: inspect, check, repair, edit, convert and render bags.

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

use crate::cli::{BagArgs, BagCommand, NewBagArgs};
use eddy_bag::{BagError, BagReader, BagSummary, Compression, Survey, WriterOptions, find_bags};
use eddy_cli::{Interrupt, progress_bar};
use eddy_exchange::{ExchangeError, FrameSelection, Streams};
use eddy_frames::counted;

/// Exit code when something of the old bags is missing in the new one, as in `mcap recover`.
const LOSSY: u8 = 3;
/// Messages between two updates of the progress bar.
const PROGRESS_STEP: u64 = 64;

/// Runs one of the subcommands.
pub fn run(args: BagArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<ExitCode> {
    match args.command {
        BagCommand::Recover(args) => return recover::run(&args, quiet, interrupt),
        BagCommand::Merge(args) => return edit::merge(&args, quiet, interrupt),
        BagCommand::Cut(args) => edit::cut(&args, quiet, interrupt),
        BagCommand::Filter(args) => edit::filter(args, quiet, interrupt),
        BagCommand::Cloud(args) => edit::cloud(&args, quiet, interrupt),
        BagCommand::Reindex { bag } => reindex::run(&bag, quiet, interrupt),
        // Replaced by `eddy replay` and `eddy record` when the command line is read.
        BagCommand::Play(_) | BagCommand::Record(_) => Ok(()),
        BagCommand::Info { bags, json } => info::run(&bags, json, quiet),
        BagCommand::Check { bags } => check::run(&bags, quiet, interrupt),
        BagCommand::Export(args) if args.cloud => edit::export_cloud(args, quiet, interrupt),
        BagCommand::Export(args) => export::run(args, quiet, interrupt),
        BagCommand::Import(args) => import::run(args, quiet, interrupt),
        BagCommand::Render(args) => render::run(args, quiet, interrupt),
    }
    .map(|()| ExitCode::SUCCESS)
}

/// How to write a bag made of `bags`.
fn writer_options(new: &NewBagArgs, bags: &[BagReader]) -> WriterOptions {
    let found: BTreeSet<&str> = bags.iter().flat_map(BagReader::compressions).collect();
    let unchanged = match found.into_iter().collect::<Vec<_>>()[..] {
        ["none"] => Compression::None,
        ["lz4"] => Compression::Lz4,
        _ => Compression::Zstd,
    };
    let compression = new.compression.unwrap_or(unchanged);
    WriterOptions { compression, ..WriterOptions::default() }
}

/// Prints what was written.
fn report(bag: &BagSummary) {
    // The topics of different publishers are listed one by one.
    let names: BTreeSet<&str> = bag.topics.iter().map(|topic| topic.name.as_str()).collect();
    let topics = counted(names.len() as u64, "topic");
    println!("{}: {} messages on {topics}", bag.directory.display(), bag.messages);
}

/// The bags at these paths, and those in directories that are no bags themselves.
fn bags_at(paths: &[PathBuf]) -> Result<Vec<PathBuf>, BagError> {
    let mut bags = Vec::new();
    for path in paths {
        match BagReader::open(path) {
            Err(none @ BagError::NotABag { .. }) => {
                bags.extend(find_bags(std::slice::from_ref(path)).map_err(|_| none)?);
            }
            Err(other) => return Err(other),
            Ok(_) => bags.push(path.clone()),
        }
    }
    Ok(bags)
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

/// Finds the streams of bags, reading them once.
fn find_streams<const D: usize>(
    choice: &FrameSelection,
    quiet: bool,
    interrupt: &Interrupt,
) -> Result<Streams<D>, ExchangeError> {
    let bar = progress_bar(messages(&choice.bags, &choice.topic)?, "messages", quiet);
    let streams = Streams::find(choice, &mut watch(&bar, interrupt));
    bar.finish_and_clear();
    streams
}

/// Number of messages on a topic.
fn messages(bags: &[PathBuf], topic: &str) -> Result<u64, BagError> {
    let mut messages = 0;
    for bag in find_bags(bags)? {
        let bag = BagReader::open(&bag)?;
        let of_topic = bag.topics().iter().filter(|info| info.name == topic);
        messages += of_topic.map(|info| info.message_count).sum::<u64>();
    }
    Ok(messages)
}

/// Advances the bar by a number of bytes; returns whether to continue.
fn watch_bytes<'a>(bar: &'a ProgressBar, interrupt: &'a Interrupt) -> impl FnMut(u64) -> bool + 'a {
    move |bytes| {
        bar.inc(bytes);
        !interrupt.requested()
    }
}

/// Advances the bar by one; returns whether to continue.
fn watch<'a>(bar: &'a ProgressBar, interrupt: &'a Interrupt) -> impl FnMut() -> bool + 'a {
    move || {
        bar.inc(1);
        !interrupt.requested()
    }
}
