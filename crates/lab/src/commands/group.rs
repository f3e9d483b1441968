//! `eddy-lab bench group`: nodes that share streams.

use std::{
    env,
    path::{Path, PathBuf},
};

use anyhow::{Context, ensure};
use serde::Serialize;

use super::args::BenchGroupArgs;
use super::{BenchOutput, table};
use crate::bench::group::{Plan, Timing, time};
use eddy_frames::progress::Progress;
use eddy_settings::ensure_usage;

/// Longest measurement (s).
const MAX_SECONDS: f64 = 3600.0;

/// JSON output.
#[derive(Serialize)]
struct Report {
    nodes: usize,
    streams: u64,
    particles: usize,
    hertz: f64,
    seconds: f64,
    killed: bool,
    timing: Timing,
}

/// Runs nodes for a while.
pub fn run(
    args: BenchGroupArgs,
    html: Option<&Path>,
    progress: &dyn Progress,
) -> anyhow::Result<()> {
    let BenchGroupArgs { nodes, streams, particles, hertz, seconds, kill, json } = args;
    ensure_usage!(
        (0.0..=MAX_SECONDS).contains(&seconds) && seconds > 0.0,
        "seconds: found {seconds}, expected more than 0 and at most {MAX_SECONDS}"
    );
    ensure_usage!((0.01..=1e4).contains(&hertz), "hertz: found {hertz}, expected 0.01 to 10000");
    ensure_usage!(particles > 0, "particles: found 0, expected at least 1");
    ensure_usage!(
        (1..=65_536).contains(&streams),
        "streams: found {streams}, expected 1 to 65536, which a node keeps"
    );
    let least = 1 + usize::from(kill);
    ensure_usage!(nodes >= least, "nodes: found {nodes}, expected at least {least}");
    let program = eddy()?;
    let plan = Plan { nodes, streams, particles, hertz, seconds, kill };
    let timing = time(&program, &plan, &|| progress.cancelled())?;
    ensure!(!progress.cancelled(), "interrupted");
    let Timing { frames, lost, twice, way, way_tail, silence, processor } = timing;
    let time = |milliseconds: f64| format!("{milliseconds:.1}");
    let row = vec![
        "publication to prediction".to_owned(),
        time(way.p50),
        time(way.p99),
        time(way_tail.p999),
        time(way_tail.worst),
    ];
    let head = ["", "p50 (ms)", "p99 (ms)", "p99.9 (ms)", "worst (ms)"];
    let mut tables = vec![table("Time per frame", head, [row])];
    if let Some(used) = processor {
        let rate = streams as f64 * hertz;
        let rows = [("nodes", used.nodes), ("router", used.router), ("source", used.source)];
        let rows = rows.map(|(what, cores)| {
            vec![what.to_owned(), format!("{cores:.2}"), format!("{:.0}", cores / rate * 1e6)]
        });
        tables.push(table("Use of the processor", ["", "cores", "per frame (µs)"], rows));
    }
    let killed = if kill { ", one of them killed after half of the time" } else { "" };
    let note = format!(
        "{streams} streams of {particles} particles at {hertz} Hz for {seconds} s on {nodes} nodes{killed}: {frames} frames \
         published, {lost} not predicted, {twice} predicted twice; longest time between two predictions of a stream \
         {silence:.2} s",
    );
    let output =
        BenchOutput { title: "eddy-lab bench group", tables, plots: Vec::new(), notes: vec![note] };
    let report = Report { nodes, streams, particles, hertz, seconds, killed: kill, timing };
    output.show(&report, json, html)
}

/// The program of the nodes: `eddy` beside this one, where cargo and packages put it.
fn eddy() -> anyhow::Result<PathBuf> {
    let here = env::current_exe().context("cannot find this program")?;
    let program = here.with_file_name(format!("eddy{}", env::consts::EXE_SUFFIX));
    ensure!(
        program.is_file(),
        "{}: not found, expected the program eddy, which `cargo build --release` builds",
        program.display()
    );
    Ok(program)
}
