//! `eddy-lab bench transport`: latency from publisher to subscriber.

use std::path::Path;

use anyhow::ensure;
use serde::Serialize;

use super::args::BenchTransportArgs;
use super::{BenchOutput, table};
use crate::bench::transport::{Timing, Way, time};
use eddy_frames::progress::Progress;
use eddy_pages::{Axis, LinePlot, Series};
use eddy_settings::ensure_usage;

/// JSON output.
#[derive(Serialize)]
struct Report {
    timings: Vec<Timing>,
}

/// Measures every transport with every number of particles.
pub fn run(
    args: BenchTransportArgs,
    html: Option<&Path>,
    progress: &dyn Progress,
) -> anyhow::Result<()> {
    ensure_usage!(args.messages > 0, "messages: found 0, expected at least 1");
    ensure_usage!(!args.particles.contains(&0), "particles: found 0, expected at least 1");
    let cases = args.transport.len() * args.particles.len();
    progress.begin(cases as u64, "cases");
    let mut timings = Vec::new();
    for &transport in &args.transport {
        for &particles in &args.particles {
            ensure!(!progress.cancelled(), "interrupted");
            timings.extend(time(transport, particles, args.messages)?);
            progress.advance(1);
        }
    }
    progress.finish();
    let header = [
        "transport",
        "particles",
        "way",
        "p50 (µs)",
        "p99 (µs)",
        "to bare",
        "p99 to bare",
        "MB/s",
        "arrived",
    ];
    let rows = timings.iter().map(|timing| {
        let against = if timing.way == Way::Untouched { Way::BareUntouched } else { Way::Bare };
        let bare = timings.iter().find(|other| {
            let same = other.transport == timing.transport && other.particles == timing.particles;
            same && other.way == against && !matches!(timing.way, Way::Bare | Way::BareUntouched)
        });
        let ratio = |of: fn(&Timing) -> f64| {
            bare.map_or(String::new(), |bare| format!("{:.2}", of(timing) / of(bare)))
        };
        vec![
            timing.transport.to_owned(),
            timing.particles.to_string(),
            name(timing.way).to_owned(),
            format!("{:.1}", timing.p50),
            format!("{:.1}", timing.p99),
            ratio(|timing| timing.p50),
            ratio(|timing| timing.p99),
            format!("{:.0}", timing.rate * 1e-6),
            format!("{} of {}", timing.arrived, timing.burst),
        ]
    });
    let note = format!(
        "{} messages of each, in turns, from before publishing to reception; bare: the middleware alone with the same \
         bytes; untouched: unmodified shared memory; no row: messages too large for the transport; MB/s and arrived: \
         of messages published at full speed",
        args.messages
    );
    let (title, tables) =
        ("eddy-lab bench transport", vec![table("Latency and throughput", header, rows)]);
    let output = BenchOutput { title, tables, plots: vec![plot(&timings)], notes: vec![note] };
    output.show(&Report { timings }, args.json, html)
}

fn name(way: Way) -> &'static str {
    match way {
        Way::Frame => "frame",
        Way::Bytes => "bytes",
        Way::Bare => "bare",
        Way::Untouched => "untouched",
        Way::BareUntouched => "bare, untouched",
    }
}

/// Medians over the size of a frame, one curve per transport and way.
fn plot(timings: &[Timing]) -> LinePlot {
    let mut series: Vec<Series> = Vec::new();
    for timing in timings {
        let name = format!("{}, {}", timing.transport, name(timing.way));
        let point = [timing.particles as f64, timing.p50];
        match series.iter_mut().find(|series| series.name == name) {
            Some(series) => series.points.push(point),
            None => series.push(Series { name, points: vec![point], ..Series::default() }),
        }
    }
    LinePlot {
        title: "Median latency".into(),
        x: Axis::logarithmic("particles"),
        y: Axis::logarithmic("time (µs)"),
        series,
    }
}
