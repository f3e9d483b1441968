//! `eddy bag info`.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use serde::Serialize;

use super::{bags_at, survey};
use eddy_bag::{BagReader, Survey, TopicInfo, TopicSurvey};
use eddy_cli::terminal::{self, on_one_line};
use eddy_frames::{Stamp, date::Utc, decimal};
use eddy_pages::Table;

/// Prints files, topics and streams of bags, as text or as JSON.
pub fn run(paths: &[PathBuf], json: bool, quiet: bool) -> anyhow::Result<()> {
    for (index, bag) in bags_at(paths)?.iter().enumerate() {
        if index > 0 && !json {
            println!();
        }
        one(bag, json, quiet)?;
    }
    Ok(())
}

fn one(path: &Path, json: bool, quiet: bool) -> anyhow::Result<()> {
    let bag = BagReader::open(path)?;
    let survey = survey(&bag, quiet);
    if json {
        println!("{}", serde_json::to_string_pretty(&Info::new(&bag, &survey))?);
    } else {
        print(&bag, &survey);
    }
    match bag.damage() {
        Some(damage) => Err(damage.into()),
        None => Ok(()),
    }
}

fn print(bag: &BagReader, survey: &Survey) {
    for file in bag.files() {
        println!("file         {}", file.display());
    }
    println!("size         {}", bytes(bag.size()));
    let compressions = bag.compressions().into_iter().collect::<Vec<_>>().join(", ");
    println!("compression  {}", if compressions.is_empty() { "none" } else { &compressions });
    println!("messages     {}", bag.message_count());

    for (kind, count) in ["attachments", "metadata"].iter().zip(bag.auxiliary_counts()) {
        if count > 0 {
            println!("{kind:<12} {count}");
        }
    }
    println!("duration     {:.3} s", bag.duration());
    for (name, time) in [("start", bag.start()), ("end", bag.end())] {
        if let Some(time) = time {
            println!("{name:<12} {} ({} s)", date(time), exact(time));
        }
    }
    for (key, value) in bag.custom_data() {
        println!("custom data  {}: {}", on_one_line(key), on_one_line(value));
    }
    let titles =
        ["topic", "messages", "rate (1/s)", "size", "streams", "particles", "dt (s)", "type"];
    let mut table = Table::new("topics", titles);
    for (topic, found) in bag.topics().iter().zip(&survey.topics) {
        let rate = found.rate().map_or("-".to_owned(), |rate| format!("{rate:.2}"));
        let [streams, particles, dt] = streams(found);
        let (count, size) = (topic.message_count.to_string(), bytes(found.bytes));
        let type_name = on_one_line(&topic.type_name).into_owned();
        let cells = [count, rate, size, streams, particles, dt, type_name];
        table.row(&*on_one_line(&topic.name), cells);
    }
    println!("{}", table.plain(terminal::columns()));
    println!("sizes of topics are those of the messages without compression");
    for topic in bag.topics().iter().filter(|topic| !topic.has_definition()) {
        let of = on_one_line(&topic.type_name);
        println!("no definition: {} ({of})", on_one_line(&topic.name));
    }
    if bag.is_unfinished() {
        println!("unfinished: the bag is still being written, or the recorder was killed");
    }
}

/// `eddy bag info --json`.
#[derive(Serialize)]
struct Info {
    files: Vec<PathBuf>,
    /// Size of the files (bytes).
    size: u64,
    compressions: Vec<String>,
    messages: u64,
    attachments: usize,
    metadata: usize,
    /// Time from the first to the last message (s).
    duration: f64,
    /// Log time of the first message.
    start: Option<TimeInfo>,
    /// Log time of the last message.
    end: Option<TimeInfo>,
    /// `custom_data` of `metadata.yaml`.
    custom_data: BTreeMap<String, String>,
    /// Whether the bag is still being written, or its writer was killed.
    unfinished: bool,
    topics: Vec<TopicEntry>,
}

#[derive(Serialize)]
struct TimeInfo {
    /// Nanoseconds since the epoch of the recording's clock.
    ns: i64,
    /// The same as a date, if the epoch is Unix's.
    utc: String,
}

#[derive(Serialize)]
struct TopicEntry {
    topic: String,
    #[serde(rename = "type")]
    type_name: String,
    messages: u64,
    /// Mean rate (Hz).
    rate: Option<f64>,
    /// Size of the messages without compression (bytes).
    size: u64,
    streams: Vec<StreamEntry>,
}

#[derive(Serialize)]
struct StreamEntry {
    stream: u64,
    frames: u64,
    /// 2 or 3.
    dimension: usize,
    /// Smallest and largest number of particles of a frame.
    particles: [usize; 2],
    /// Time between two frames (s).
    dt: f64,
    /// How often the stream restarted.
    restarts: u64,
}

impl Info {
    fn new(bag: &BagReader, survey: &Survey) -> Self {
        let [attachments, metadata] = bag.auxiliary_counts();
        let time = |time: Stamp| TimeInfo { ns: time.0, utc: Utc::of(time).to_string() };
        let topics = bag.topics().iter().zip(&survey.topics);
        Self {
            files: bag.files().map(Path::to_owned).collect(),
            size: bag.size(),
            compressions: bag.compressions().into_iter().map(str::to_owned).collect(),
            messages: bag.message_count(),
            attachments,
            metadata,
            duration: bag.duration(),
            start: bag.start().map(time),
            end: bag.end().map(time),
            custom_data: bag.custom_data().clone(),
            unfinished: bag.is_unfinished(),
            topics: topics.map(|(topic, found)| TopicEntry::new(topic, found)).collect(),
        }
    }
}

impl TopicEntry {
    fn new(topic: &TopicInfo, found: &TopicSurvey) -> Self {
        let streams = found.streams.iter().map(|(&stream, found)| StreamEntry {
            stream,
            frames: found.frames,
            dimension: found.domain.dimension(),
            particles: [found.particles.0, found.particles.1],
            dt: decimal(found.dt),
            restarts: found.restarts,
        });
        Self {
            topic: topic.name.clone(),
            type_name: topic.type_name.clone(),
            messages: topic.message_count,
            rate: found.rate(),
            size: found.bytes,
            streams: streams.collect(),
        }
    }
}

/// A log time as a date: log times of `eddy record` count from the Unix epoch, those of a simulation from its start.
fn date(time: Stamp) -> String {
    const YEAR: f64 = 365.25 * 86_400.0;
    if time.seconds() < YEAR {
        return "simulated time".to_owned();
    }
    Utc::of(time).to_string()
}

/// A time in seconds with all nanoseconds, which `f64` would round; times in bags are not negative.
fn exact(Stamp(nanoseconds): Stamp) -> String {
    const SECOND: i64 = 1_000_000_000;
    format!("{}.{:09}", nanoseconds / SECOND, nanoseconds % SECOND)
}

/// Number of streams, range of particles (with the dimension unless it is 2), range of intervals.
fn streams(topic: &TopicSurvey) -> [String; 3] {
    let streams = || topic.streams.values();
    let Some(first) = streams().next() else { return [(); 3].map(|()| "-".to_owned()) };
    let range =
        |low: String, high: String| if low == high { low } else { format!("{low} to {high}") };
    let fewest = streams().map(|stream| stream.particles.0).min().unwrap_or_default();
    let most = streams().map(|stream| stream.particles.1).max().unwrap_or_default();
    let in_space = streams().filter(|stream| stream.domain.dimension() == 3).count();
    let dimension = match in_space {
        0 => "",
        all if all == topic.streams.len() => " in 3-D",
        _ => " in 2-D and 3-D",
    };
    let shortest = streams().map(|stream| stream.dt).fold(first.dt, f32::min);
    let longest = streams().map(|stream| stream.dt).fold(first.dt, f32::max);
    [
        topic.streams.len().to_string(),
        range(fewest.to_string(), most.to_string()) + dimension,
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_printed_to_the_nanosecond() {
        assert_eq!(exact(Stamp(1_000_000_000_190_000_000)), "1000000000.190000000");
        assert_eq!(exact(Stamp(1_784_803_391_000_000_057)), "1784803391.000000057");
        assert_eq!(exact(Stamp(0)), "0.000000000");
    }
}
