//! `eddy bag info`.

use std::path::Path;

use comfy_table::{CellAlignment, Table, presets};

use super::survey;
use eddy_bag::{BagReader, TopicSurvey};
use eddy_frames::{Stamp, decimal};

/// Prints files, topics and streams of a bag.
pub fn run(path: &Path, quiet: bool) -> anyhow::Result<()> {
    let bag = BagReader::open(path)?;
    let survey = survey(&bag, quiet);
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
    if let (Some(start), Some(end)) = (bag.start(), bag.end()) {
        println!("start        {} s", exact(start));
        println!("end          {} s", exact(end));
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
    for topic in bag.topics().iter().filter(|topic| topic.schema.is_empty()) {
        println!("no definition: {} ({})", topic.name, topic.type_name);
    }
    if bag.is_unfinished() {
        println!("unfinished: the bag is still being written, or the recorder was killed");
    }
    match bag.damage() {
        Some(damage) => Err(damage.into()),
        None => Ok(()),
    }
}

/// A time in seconds with all nanoseconds, which `f64` would round; times in bags are not negative.
fn exact(Stamp(nanoseconds): Stamp) -> String {
    const SECOND: i64 = 1_000_000_000;
    format!("{}.{:09}", nanoseconds / SECOND, nanoseconds % SECOND)
}

/// Mean rate over the whole bag (Hz).
fn rate(messages: u64, duration: f64) -> String {
    if messages < 2 || duration <= 0.0 {
        return "-".to_owned();
    }
    format!("{:.2}", (messages - 1) as f64 / duration)
}

/// Number of streams, range of particles, range of intervals.
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
