//! `eddy-lab bench view`: overhead of the live page.

use std::path::Path;

use anyhow::ensure;
use serde::Serialize;

use super::args::BenchViewArgs;
use super::{BenchOutput, table};
use crate::bench::view::{Plan, Timing, time};
use eddy_frames::progress::Progress;
use eddy_settings::ensure_usage;

/// Numbers of browsers that read and that do not.
const CASES: [(usize, usize); 4] = [(0, 0), (1, 0), (1, 1), (10, 0)];

/// JSON output, one row per case.
#[derive(Serialize)]
struct Row {
    readers: usize,
    silent: usize,
    timing: Timing,
}

/// Measures without browsers, with one, with one and a silent one, and with ten.
pub fn run(
    args: BenchViewArgs,
    html: Option<&Path>,
    progress: &dyn Progress,
) -> anyhow::Result<()> {
    let BenchViewArgs { particles, hertz, seconds, json } = args;
    ensure_usage!(particles > 0, "particles: found 0, expected at least 1");
    ensure_usage!(
        (0.0..=3600.0).contains(&seconds) && seconds > 0.0,
        "seconds: found {seconds}, expected more than 0 and at most 3600"
    );
    ensure_usage!((0.1..=1e5).contains(&hertz), "hertz: found {hertz}, expected 0.1 to 100000");
    let mut rows = Vec::new();
    for (readers, silent) in CASES {
        let plan = Plan { particles, hertz, seconds, readers, silent };
        let timing = time(&plan, &|| progress.cancelled())?;
        ensure!(!progress.cancelled(), "interrupted");
        rows.push(Row { readers, silent, timing });
    }
    let number = |value: f64| if value.is_finite() { format!("{value:.1}") } else { "-".into() };
    let cells = rows.iter().map(|Row { readers, silent, timing }| {
        vec![
            readers.to_string(),
            silent.to_string(),
            format!("{:.3}", timing.publish.p50),
            format!("{:.3}", timing.publish.p99),
            number(timing.published),
            number(timing.arrived),
            number(timing.bytes / 1e6),
        ]
    });
    let header = ["read", "silent", "p50 (ms)", "p99 (ms)", "published/s", "arrived/s", "MB/s"];
    let table = table("Overhead of the live page, by number of browsers", header, cells);
    let note = format!(
        "{particles} particles at {hertz} Hz; p50, p99: time to publish a frame and its prediction; arrived: at each \
         browser that reads"
    );
    let (title, tables) = ("eddy-lab bench view", vec![table]);
    let output = BenchOutput { title, tables, plots: Vec::new(), notes: vec![note] };
    output.show(&rows, json, html)
}
