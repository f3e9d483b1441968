//! `eddy bench node`: what a node adds to its model's time, and how many streams it carries.

use std::path::Path;

use anyhow::ensure;
use serde::Serialize;

use super::args::BenchNodeArgs;
use super::{Sheet, table};
use crate::bench::node::{Plan, Timing, time};
use eddy_frames::progress::Progress;
use eddy_inference::checkpoint::Checkpoint;

/// What `--json` prints.
#[derive(Serialize)]
struct Report {
    streams: u64,
    particles: usize,
    hertz: f64,
    seconds: f64,
    together: bool,
    timing: Timing,
    /// Received to published, less the model's own time, by the model's own time.
    overhead: f64,
}

/// Runs the node for a while.
pub fn run(
    args: BenchNodeArgs,
    html: Option<&Path>,
    progress: &dyn Progress,
) -> anyhow::Result<()> {
    let BenchNodeArgs { streams, particles, hertz, seconds, together, threads, .. } = args;
    ensure!(seconds > 0.0, "seconds: found {seconds}, expected more than 0");
    ensure!(hertz.is_finite() && hertz > 0.0, "hertz: found {hertz}, expected more than 0");
    ensure!(particles > 0, "particles: found 0, expected at least 1");
    ensure!(streams > 0, "streams: found 0, expected at least 1");
    ensure!(!progress.cancelled(), "interrupted");
    let checkpoint = Checkpoint::load_or_shipped(args.checkpoint.as_deref())?;
    let plan = Plan { streams, particles, hertz, seconds, together, threads };
    let timing = time(&checkpoint, &plan)?;
    let overhead = timing.node.p50 / timing.model.p50 - 1.0;
    let rows = [
        ("the model alone", timing.model),
        ("received to published", timing.node),
        ("publishing to prediction", timing.way),
    ];
    let rows = rows.map(|(what, spread)| {
        vec![what.to_owned(), format!("{:.3}", spread.p50), format!("{:.3}", spread.p99)]
    });
    let note = format!(
        "{streams} streams of {particles} particles at {hertz} Hz for {seconds} s on shm, {} threads: the node adds \
         {:.0} % to the model's time; {} frames, {} came, {} were dropped by the node, {} of {} predictions came",
        timing.threads,
        100.0 * overhead,
        timing.frames,
        timing.received,
        timing.dropped,
        timing.predictions,
        timing.expected,
    );
    let table = table("Time of a frame", ["", "p50 (ms)", "p99 (ms)"], rows);
    let (title, tables) = ("eddy bench node", vec![table]);
    let sheet = Sheet { title, tables, plots: Vec::new(), notes: vec![note] };
    let report = Report { streams, particles, hertz, seconds, together, timing, overhead };
    sheet.show(&report, args.json, html)
}
