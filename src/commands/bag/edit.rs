//! `eddy bag cut`, `merge`, `filter` and `cloud`.

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    process::ExitCode,
};

use anyhow::ensure;

use super::{LOSSY, export::stem, report, watch, writer_options};
use crate::{
    cli::{CloudArgs, CutArgs, ExportArgs, FilterArgs, MergeArgs, NewBagArgs},
    commands::checked_custom_data,
};
use eddy_bag::{
    BagError, BagReader, BagSummary, BagTime, CopyOptions, Selection, TopicFilter, clouds,
    custom_data::LOSSES, extract, merge as merged, topics_without_cloud,
};
use eddy_cli::{Interrupt, Output, OutputKind, progress_bar};
use eddy_frames::Stamp;
use eddy_messages::{Message, ParticleFrame};
use eddy_settings::{near, usage::Usage};

/// Copies a time range of a bag.
pub fn cut(args: &CutArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let bag = open(&args.bag)?;
    let start = bag.start().unwrap_or_default();
    let from = args.start.map(|moment| moment.in_bag(start));
    let end = match args.duration {
        Some(seconds) => Some(BagTime::After(seconds).in_bag(from.unwrap_or(start))),
        None => args.end.map(|moment| moment.in_bag(start)),
    };
    if let (Some(from), Some(end)) = (from, end) {
        let (found, least) = (end.0, from.0);
        ensure!(end > from, "--end: found {found} ns, expected more than --start ({least} ns)");
    }
    let until = end.map(|Stamp(end)| Stamp(end.saturating_sub(1)));
    let selection = Selection { topics: None, from, until };
    copy(std::slice::from_ref(&bag), &args.new, quiet, interrupt, |output, options| {
        extract(&bag, &selection, output, options)
    })
}

/// Copies several bags into one.
pub fn merge(args: &MergeArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<ExitCode> {
    let bags = args.bags.iter().map(|bag| open(bag)).collect::<anyhow::Result<Vec<_>>>()?;
    let mut left_out = Vec::new();
    copy(&bags, &args.new, quiet, interrupt, |output, options| {
        let merged = merged(&bags, output, options)?;
        left_out = merged.left_out;
        Ok(merged.summary)
    })?;
    for reason in &left_out {
        println!("left out: {reason}");
    }
    Ok(if left_out.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(LOSSY) })
}

/// Copies some topics of a bag.
pub fn filter(args: FilterArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let bag = open(&args.bag)?;
    let known = |name: &str| bag.topics().iter().any(|topic| topic.name == name);
    if let Some(unknown) = args.topics.iter().find(|name| !known(name)) {
        let topics: Vec<_> = bag.topics().iter().map(|topic| topic.name.as_str()).collect();
        let hint = near::hint(unknown, topics.iter().copied());
        anyhow::bail!("--topics: found {unknown}, expected one of {}{hint}", topics.join(", "));
    }
    let all = args.topics.is_empty() && args.regex.is_empty();
    let choice = TopicFilter { names: args.topics, regex: args.regex, exclude: args.exclude, all };
    let wanted = bag.topics().iter().map(|topic| &topic.name).filter(|name| choice.matches(name));
    let selection = Selection { topics: Some(wanted.cloned().collect()), ..Selection::default() };
    copy(std::slice::from_ref(&bag), &args.new, quiet, interrupt, |output, options| {
        extract(&bag, &selection, output, options)
    })
}

/// Copies a bag and adds its frames as point clouds.
pub fn cloud(args: &CloudArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let bag = open(&args.bag)?;
    let (path, kind) = (args.bag.display(), ParticleFrame::TYPE);
    ensure!(
        !topics_without_cloud(&bag).is_empty(),
        "{path}: no topic of {kind} without a point cloud topic beside it"
    );
    copy(std::slice::from_ref(&bag), &args.new, quiet, interrupt, |output, options| {
        clouds(&bag, output, options)
    })
}

/// As [`cloud`], with the arguments of `export`.
pub fn export_cloud(args: ExportArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let stem = stem(&args.bags);
    let ExportArgs { bags, output, compression, force, .. } = args;
    let [bag] = <[PathBuf; 1]>::try_from(bags).map_err(|bags| {
        Usage::new(format_args!("--cloud: found {} bags, expected one", bags.len()))
    })?;
    let output = output.unwrap_or_else(|| PathBuf::from(format!("{stem}_cloud")));
    cloud(
        &CloudArgs { bag, new: NewBagArgs { output, force, compression, custom_data: Vec::new() } },
        quiet,
        interrupt,
    )
}

/// Opens an undamaged bag.
fn open(path: &Path) -> anyhow::Result<BagReader> {
    let bag = BagReader::open(path)?;
    match bag.damage() {
        Some(damage) => Err(damage.into()),
        None => Ok(bag),
    }
}

fn copy(
    bags: &[BagReader],
    new: &NewBagArgs,
    quiet: bool,
    interrupt: &Interrupt,
    work: impl FnOnce(&Path, CopyOptions<'_>) -> Result<BagSummary, BagError>,
) -> anyhow::Result<()> {
    let inputs: Vec<PathBuf> = bags.iter().map(|bag| bag.path().to_owned()).collect();
    let custom_data = checked_custom_data(&new.custom_data)?;
    let room = Output::at(&new.output, OutputKind::Bag, new.force, &inputs)?;
    let messages = bags.iter().map(BagReader::message_count).sum();
    let bar = progress_bar(messages, "messages", quiet);
    let writer = writer_options(new, bags);
    let options = CopyOptions { writer, custom_data, on_message: &mut watch(&bar, interrupt) };
    let outcome = work(&new.output, options);
    bar.finish_and_clear();
    let summary = outcome?;
    report(&summary);
    let found: BTreeSet<_> = bags.iter().flat_map(|bag| bag.custom_data().keys()).collect();
    let is_kept = |key: &str| LOSSES.contains(&key) || summary.custom_data.contains_key(key);
    for key in found.into_iter().filter(|key| !is_kept(key)) {
        println!("not kept, since not all bags have the same: custom data {}", key.escape_debug());
    }
    room.replaced();
    Ok(())
}
