//! `eddy-lab bench inference`: time per predicted frame.

use std::{num::NonZeroUsize, path::Path};

use anyhow::ensure;
use serde::Serialize;

use super::args::BenchInferenceArgs;
use super::{BenchOutput, table};
use crate::bench::{
    inference::{Case, Engine, Timing},
    limit::read_rate,
};
use eddy_frames::progress::Progress;
use eddy_settings::ensure_usage;

/// JSON output.
#[derive(Serialize)]
struct Report {
    floors: Vec<Floor>,
    timings: Vec<Timing>,
}

/// Lower bound of the time per frame: reading the weights once.
#[derive(Serialize)]
struct Floor {
    /// Size of the weights (bytes).
    weights: usize,
    threads: usize,
    /// Read rate of a list as long as the weights (bytes/s).
    rate: f64,
    milliseconds: f64,
}

impl Floor {
    fn measure(weights: usize, threads: NonZeroUsize) -> Self {
        let rate = read_rate(threads.get(), weights);
        let milliseconds = 1e3 * weights as f64 / rate;
        Self { weights, threads: threads.get(), rate, milliseconds }
    }
}

/// Times frames.
pub fn run(
    args: BenchInferenceArgs,
    html: Option<&Path>,
    progress: &dyn Progress,
) -> anyhow::Result<()> {
    ensure_usage!(args.seconds > 0.0, "seconds: found {}, expected more than 0", args.seconds);
    ensure_usage!(args.particles > 0, "particles: found 0, expected at least 1");
    let mut engines: Vec<_> = args.threads.iter().map(|&threads| Engine::Own(threads)).collect();
    if !args.engine_only {
        args.device.iter().try_for_each(|device| device.check())?;
        engines.extend(args.device.iter().map(|&device| Engine::Burn(device)));
    }
    let networks = args.core.len() + 1;
    progress.begin((networks * engines.len()) as u64, "timings");
    let (mut floors, mut timings) = (Vec::new(), Vec::new());
    for network in 0..networks {
        let case = match args.core.get(network) {
            Some(&core) => Case::frame(core, args.particles),
            None => Case::shipped(args.particles)?,
        };
        for &engine in &engines {
            ensure!(!progress.cancelled(), "interrupted");
            timings.push(case.time(engine, args.seconds)?);
            progress.advance(1);
        }
        floors.extend(args.threads.iter().map(|&threads| Floor::measure(case.weights(), threads)));
    }
    progress.finish();
    let output = output(&timings, &floors, engines.len(), args.threads.len());
    output.show(&Report { floors, timings }, args.json, html)
}

/// A row for each network: `engines` timings and `threads` floors each.
fn output(timings: &[Timing], floors: &[Floor], engines: usize, threads: usize) -> BenchOutput {
    let mut header = vec!["model".to_owned(), "core".to_owned(), "weights".to_owned()];
    header.extend(floors.iter().take(threads).map(|floor| format!("floor, {}", floor.threads)));
    header.extend(timings.iter().take(engines).map(|timing| match timing.threads {
        Some(threads) => format!("engine, {threads}"),
        None => timing.engine.clone(),
    }));
    let rows = timings.chunks(engines).zip(floors.chunks(threads)).map(|(timings, floors)| {
        let Timing { architecture, core, weights, .. } = &timings[0];
        let mut row = vec![
            architecture.name().to_owned(),
            core.name().to_owned(),
            format!("{:.1} MB", *weights as f64 * 1e-6),
        ];
        row.extend(floors.iter().map(|floor| format!("{:.2}", floor.milliseconds)));
        row.extend(timings.iter().map(|timing| format!("{:.2} / {:.2}", timing.p50, timing.p99)));
        row
    });
    let note = format!(
        "ms per frame, median / 99th percentile, one stream of {} particles; engine: by threads; \
         floor: time to read the weights once, by threads",
        timings[0].particles
    );
    let rates = floors[..threads].iter().map(|floor| {
        format!(
            "{} weights: read at {:.1} GB/s on {} threads",
            timings[0].core.name(),
            floor.rate * 1e-9,
            floor.threads
        )
    });
    BenchOutput {
        title: "eddy-lab bench inference",
        tables: vec![table("Time per predicted frame", header, rows)],
        plots: Vec::new(),
        notes: std::iter::once(note).chain(rates).collect(),
    }
}
