//! `eddy bag`: looks into bags.

use std::path::Path;

use anyhow::bail;
use comfy_table::{CellAlignment, Table, presets};

use super::{Interrupt, progress_bar};
use crate::cli::{BagArgs, BagCommand};
use eddy::{
    bag::{BagReader, Survey, TopicSurvey},
    frame::decimal,
};

/// So many messages pass between two looks at the progress bar.
const PROGRESS_STEP: u64 = 64;

/// Runs one of the subcommands.
pub fn run(args: BagArgs, quiet: bool, _interrupt: &Interrupt) -> anyhow::Result<()> {
    match args.command {
        BagCommand::Info { bag } => info(&bag, quiet),
        BagCommand::Check { bag } => check(&bag, quiet),
    }
}

fn info(path: &Path, quiet: bool) -> anyhow::Result<()> {
    let bag = BagReader::open(path)?;
    let survey = survey(&bag, quiet);
    for file in bag.files() {
        println!("file         {}", file.display());
    }
    println!("size         {}", bytes(bag.size()));
    let compressions = bag.compressions().into_iter().collect::<Vec<_>>().join(", ");
    println!("compression  {}", if compressions.is_empty() { "none" } else { &compressions });
    println!("messages     {}", bag.message_count());
    println!("duration     {:.3} s", bag.duration());
    if let (Some(start), Some(end)) = (bag.start(), bag.end()) {
        println!("start        {:.9} s", start.seconds());
        println!("end          {:.9} s", end.seconds());
    }
    let mut table = Table::new();
    table.load_style(presets::NOTHING);
    table.set_header(["topic", "type", "messages", "rate (1/s)", "streams", "particles", "dt (s)"]);
    for (topic, found) in bag.topics().iter().zip(&survey.topics) {
        let rate = rate(topic.message_count, bag.duration());
        let [streams, particles, dt] = streams(found);
        let count = topic.message_count.to_string();
        table.add_row([&topic.name, &topic.type_name, &count, &rate, &streams, &particles, &dt]);
    }
    for column in 2..7 {
        if let Some(column) = table.column_mut(column) {
            column.set_cell_alignment(CellAlignment::Right);
        }
    }
    println!("{}", table.trim_fmt());
    if bag.is_unfinished() {
        println!("unfinished: the bag is still being written, or its writer was killed");
    }
    match bag.damage() {
        Some(damage) => Err(damage.into()),
        None => Ok(()),
    }
}

fn check(path: &Path, quiet: bool) -> anyhow::Result<()> {
    let bag = BagReader::open(path)?;
    let mut survey = survey(&bag, quiet);
    survey.check_files(&bag);
    for finding in &survey.findings {
        println!("{finding}");
    }
    let findings = survey.findings.len() as u64 + survey.further_findings;
    if survey.further_findings > 0 {
        println!("... and {} more", survey.further_findings);
    }
    if findings > 0 {
        bail!("{}: findings: found {findings}, expected 0", path.display());
    }
    println!("{}: {} messages, nothing wrong", path.display(), bag.message_count());
    Ok(())
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

/// Messages a second over the whole bag.
fn rate(messages: u64, duration: f64) -> String {
    if messages < 2 || duration <= 0.0 {
        return "-".to_owned();
    }
    format!("{:.2}", (messages - 1) as f64 / duration)
}

/// How many streams, their particles, their intervals.
fn streams(topic: &TopicSurvey) -> [String; 3] {
    let streams = || topic.streams.values();
    let Some(first) = streams().next() else { return [(); 3].map(|()| "-".to_owned()) };
    let range =
        |low: String, high: String| if low == high { low } else { format!("{low} to {high}") };
    let fewest = streams().map(|stream| stream.particles.0).min().unwrap_or_default();
    let most = streams().map(|stream| stream.particles.1).max().unwrap_or_default();
    let shortest = streams().map(|stream| stream.dt).fold(first.dt, f32::min);
    let longest = streams().map(|stream| stream.dt).fold(first.dt, f32::max);
    [
        topic.streams.len().to_string(),
        range(fewest.to_string(), most.to_string()),
        range(decimal(shortest).to_string(), decimal(longest).to_string()),
    ]
}

fn bytes(size: u64) -> String {
    const UNITS: [&str; 5] = ["B", "KiB", "MiB", "GiB", "TiB"];
    let mut value = size as f64;
    let mut unit = 0;
    while value >= 1024.0 && unit + 1 < UNITS.len() {
        value /= 1024.0;
        unit += 1;
    }
    if unit == 0 { format!("{size} B") } else { format!("{value:.1} {}", UNITS[unit]) }
}
