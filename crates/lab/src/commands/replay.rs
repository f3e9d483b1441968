//! `eddy-lab bench replay`: delay of replayed messages.

use std::path::Path;

use anyhow::{Context, ensure};
use serde::Serialize;

use super::args::BenchReplayArgs;
use super::{BenchOutput, table};
use crate::bench::replay::{Plan, Timing, time};
use eddy_frames::progress::Progress;
use eddy_settings::ensure_usage;

/// Number of turns of replay and timer.
const TURNS: usize = 15;

/// JSON output.
#[derive(Serialize)]
struct Report {
    particles: usize,
    hertz: f64,
    timing: Timing,
}

/// Alternates between playing a bag and sleeping.
pub fn run(
    args: BenchReplayArgs,
    html: Option<&Path>,
    progress: &dyn Progress,
) -> anyhow::Result<()> {
    let BenchReplayArgs { particles, hertz, seconds, json } = args;
    ensure_usage!(
        (0.0..=3600.0).contains(&seconds) && seconds > 0.0,
        "seconds: found {seconds}, expected more than 0 and at most 3600"
    );
    ensure_usage!((0.1..=1e5).contains(&hertz), "hertz: found {hertz}, expected 0.1 to 100000");
    let folder = tempfile::tempdir().context("cannot create a folder for the bag")?;
    let frames = (seconds * hertz / TURNS as f64).ceil() as u32;
    let plan = Plan { particles, hertz, frames, turns: TURNS };
    let timing = time(&folder.path().join("bag"), &plan, &|| progress.cancelled())?;
    ensure!(!progress.cancelled(), "interrupted");
    let rows = [("replay", timing.replay), ("timer", timing.timer)].map(|(what, spread)| {
        vec![what.to_owned(), format!("{:.3}", spread.p50), format!("{:.3}", spread.p99)]
    });
    let note = format!(
        "frames of {particles} particles at {hertz} Hz, {TURNS} turns of {frames} frames; timer: a loop that only \
         sleeps until each is due; p99 of replay: {:.2} times the timer's",
        timing.replay.p99 / timing.timer.p99
    );
    let table = table("Delay of frames", ["", "p50 (ms)", "p99 (ms)"], rows);
    let (title, tables) = ("eddy-lab bench replay", vec![table]);
    let output = BenchOutput { title, tables, plots: Vec::new(), notes: vec![note] };
    output.show(&Report { particles, hertz, timing }, json, html)
}
