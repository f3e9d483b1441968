//! `eddy-lab bench node`: overhead of a node over its model, and number of streams.

use std::path::Path;

use anyhow::ensure;
use serde::Serialize;

use super::args::BenchNodeArgs;
use super::{BenchOutput, table};
use crate::bench::node::{Plan, Timing, time};
use eddy_frames::progress::Progress;
use eddy_inference::checkpoint::Checkpoint;
use eddy_settings::ensure_usage;

/// JSON output.
#[derive(Serialize)]
struct Report {
    streams: u64,
    particles: usize,
    hertz: f64,
    seconds: f64,
    together: bool,
    timing: Timing,
    /// Time from reception to publication minus the model's time, relative to the model's time.
    overhead: f64,
}

/// Runs the node for a while.
pub fn run(
    args: BenchNodeArgs,
    html: Option<&Path>,
    progress: &dyn Progress,
) -> anyhow::Result<()> {
    let BenchNodeArgs { streams, particles, hertz, seconds, together, threads, .. } = args;
    ensure_usage!(seconds > 0.0, "seconds: found {seconds}, expected more than 0");
    ensure_usage!(hertz.is_finite() && hertz > 0.0, "hertz: found {hertz}, expected more than 0");
    ensure_usage!(particles > 0, "particles: found 0, expected at least 1");
    ensure_usage!(streams > 0, "streams: found 0, expected at least 1");
    ensure!(!progress.cancelled(), "interrupted");
    let checkpoint = Checkpoint::load_or_shipped(args.checkpoint.as_deref())?;
    let plan = Plan { streams, particles, hertz, seconds, together, threads };
    let timing = time(&checkpoint, &plan)?;
    let overhead = timing.node.p50 / timing.model.p50 - 1.0;
    let rows = [
        ("model alone", timing.model),
        ("reception to publication", timing.node),
        ("publication to prediction", timing.way),
    ];
    let time = |milliseconds: f64| format!("{milliseconds:.3}");
    let mut rows = rows.map(|(what, spread)| {
        let empty = String::new();
        vec![what.to_owned(), time(spread.p50), time(spread.p99), empty.clone(), empty]
    });
    if let Some([.., p999, worst]) = rows.last_mut().map(Vec::as_mut_slice) {
        (*p999, *worst) = (time(timing.way_tail.p999), time(timing.way_tail.worst));
    }
    let note = format!(
        "{streams} streams of {particles} particles at {hertz} Hz for {seconds} s on shm, {} threads: node overhead \
         {:.0} % of the model's time; {} frames published, {} received, {} dropped by the node, {} of {} predictions \
         received",
        timing.threads,
        100.0 * overhead,
        timing.frames,
        timing.received,
        timing.dropped,
        timing.predictions,
        timing.expected,
    );
    let head = ["", "p50 (ms)", "p99 (ms)", "p99.9 (ms)", "worst (ms)"];
    let table = table("Time per frame", head, rows);
    let (title, tables) = ("eddy-lab bench node", vec![table]);
    let output = BenchOutput { title, tables, plots: Vec::new(), notes: vec![note] };
    let report = Report { streams, particles, hertz, seconds, together, timing, overhead };
    output.show(&report, args.json, html)
}
