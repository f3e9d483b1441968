//! `eddy-lab bench bag`: write and read rates of bags.

use std::{fs, path::Path};

use anyhow::{Context, ensure};
use serde::Serialize;
use tempfile::Builder;

use super::args::BenchBagArgs;
use super::{BenchOutput, table};
use crate::bench::bag::{Plan, Timing, disk, time};
use eddy_bag::Compression;
use eddy_frames::progress::Progress;
use eddy_settings::ensure_usage;

/// Size of the plain file that measures the disk (bytes).
const PLAIN_FILE: u64 = 1 << 29;

/// JSON output.
#[derive(Serialize)]
struct Report {
    particles: usize,
    hertz: f64,
    /// Write rate of a plain file, including the sync to disk (bytes/s).
    disk: f64,
    timings: Vec<Timing>,
}

/// Measures every compression.
pub fn run(args: BenchBagArgs, html: Option<&Path>, progress: &dyn Progress) -> anyhow::Result<()> {
    ensure_usage!(args.seconds > 0.0, "seconds: found {}, expected more than 0", args.seconds);
    ensure_usage!(
        args.hertz.is_finite() && args.hertz > 0.0,
        "hertz: found {}, expected more than 0",
        args.hertz
    );
    let at = || args.directory.display().to_string();
    fs::create_dir_all(&args.directory).with_context(at)?;
    let directory = Builder::new().prefix("eddy_bench_").tempdir_in(&args.directory);
    let directory = directory.with_context(at)?;
    let report = measure(&args, directory.path(), progress)?;
    directory.close().with_context(at)?;
    let header = ["compression", "write (MB/s)", "read (MB/s)", "size", "published", "recorded"];
    let rows = report.timings.iter().map(|timing| {
        vec![
            timing.compression.to_owned(),
            format!("{:.0}", timing.write / 1e6),
            format!("{:.0}", timing.read / 1e6),
            format!("{:.2}", timing.size),
            timing.published.to_string(),
            timing.recorded.to_string(),
        ]
    });
    let note = format!(
        "frames of {} particles, published at {} Hz; disk alone: {:.0} MB/s",
        report.particles,
        report.hertz,
        report.disk / 1e6
    );
    let (title, tables) = ("eddy-lab bench bag", vec![table("Bags", header, rows)]);
    let output = BenchOutput { title, tables, plots: Vec::new(), notes: vec![note] };
    output.show(&report, args.json, html)
}

fn measure(
    args: &BenchBagArgs,
    directory: &Path,
    progress: &dyn Progress,
) -> anyhow::Result<Report> {
    let compressions = [Compression::None, Compression::Lz4, Compression::Zstd];
    let plan = Plan {
        particles: args.particles,
        hertz: args.hertz,
        seconds: args.seconds,
        directory: directory.into(),
    };
    progress.begin(compressions.len() as u64, "compressions");
    let disk = disk(directory, PLAIN_FILE)?;
    let mut timings = Vec::new();
    for compression in compressions {
        ensure!(!progress.cancelled(), "interrupted");
        timings.push(time(&plan, compression)?);
        progress.advance(1);
    }
    progress.finish();
    Ok(Report { particles: args.particles, hertz: args.hertz, disk, timings })
}
