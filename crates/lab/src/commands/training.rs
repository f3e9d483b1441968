//! `eddy-lab bench training`: time per training step.

use std::path::Path;

use anyhow::ensure;
use serde::Serialize;

use super::args::BenchTrainingArgs;
use super::{BenchOutput, table};
use crate::bench::training::{
    FRAMES, PAPER_SAMPLES, PYTORCH_CORES, Timing, milliseconds, paper_steps, products,
};
use eddy_frames::progress::Progress;
use eddy_learning::{
    model::{Core, GpuOptions},
    train::step_benchmark::{GPU_CORE_PARTICLES, PARTICLES, Part},
};
use eddy_pages::{Axis, LinePlot, Series, Table};
use eddy_settings::ensure_usage;

/// JSON output.
#[derive(Serialize)]
struct Report {
    threads: usize,
    steps: Vec<Timing>,
}

/// Times the steps.
pub fn run(
    args: BenchTrainingArgs,
    html: Option<&Path>,
    progress: &dyn Progress,
) -> anyhow::Result<()> {
    ensure_usage!(args.seconds > 0.0, "seconds: found {}, expected more than 0", args.seconds);
    ensure_usage!(args.windows > 0, "windows: found 0, expected at least 1");
    let device = args.device.resolve(true);
    device.check()?;
    let gpu = GpuOptions { precision: args.precision, ..GpuOptions::default() };
    let steps =
        if args.step.is_empty() { paper_steps(&FRAMES[..1], &FRAMES) } else { args.step.clone() };
    progress.begin(steps.len() as u64, "steps");
    let mut timings = Vec::new();
    for step in &steps {
        ensure!(!progress.cancelled(), "interrupted");
        timings.push(step.time(args.windows, args.seconds, device, gpu)?);
        progress.advance(1);
    }
    progress.finish();
    let threads = std::thread::available_parallelism()?.get();
    let mut tables = vec![times(&timings)];
    let place = if !device.is_cuda() {
        format!("{threads} threads")
    } else {
        format!(
            "{}, {}, core alone with {GPU_CORE_PARTICLES} particles",
            device.name(),
            args.precision.name()
        )
    };
    let mut notes = vec![format!(
        "median time per step (forward, loss, backward, Adam) on {place}; N = {PARTICLES}, \
         encoder 256, two layers of 1250; epoch as in the paper's Table 4: {PAPER_SAMPLES} windows"
    )];
    if args.step.is_empty() {
        tables.push(ratios(&timings));
        let pytorch =
            "PyTorch: 2.15, eager, two cores of an Intel Xeon, tests/peers/torch_speed.py";
        notes.insert(0, pytorch.to_owned());
    }
    let output = BenchOutput {
        title: "eddy-lab bench training",
        tables,
        plots: vec![plot(&timings)],
        notes,
    };
    output.show(&Report { threads, steps: timings }, args.json, html)
}

/// Rows of the table: the whole network with the paper's window, and the core alone by frames.
fn kinds() -> impl Iterator<Item = (Part, usize)> {
    [(Part::Frame, FRAMES[0])].into_iter().chain(FRAMES.map(|frames| (Part::Core, frames)))
}

fn times(timings: &[Timing]) -> Table {
    let header = ["what", "core", "frames", "windows", "ms/step", "ms/sample", "s/epoch"];
    let rows = timings.iter().map(|timing| {
        let sample = timing.milliseconds / timing.windows as f64;
        let epoch = 1e-3 * sample * f64::from(PAPER_SAMPLES);
        vec![
            if timing.what == Part::Frame { "network" } else { "core" }.to_owned(),
            timing.core.name().to_owned(),
            timing.frames.to_string(),
            timing.windows.to_string(),
            milliseconds(timing.milliseconds),
            format!("{sample:.*}", if sample < 0.1 { 4 } else { 2 }),
            format!("{epoch:.*}", usize::from(epoch < 10.0)),
        ]
    });
    table("Training steps", header, rows)
}

/// The paper's claim, compared with the ratio of matrix products.
fn ratios(timings: &[Timing]) -> Table {
    let time = |what, core, frames| {
        let of =
            |timing: &&Timing| (timing.what, timing.core, timing.frames) == (what, core, frames);
        timings.iter().find(of).map_or(f64::NAN, |timing| timing.milliseconds)
    };
    let pairs = [(Core::Lstm, Core::MinLstm), (Core::Gru, Core::MinGru)];
    let mut rows = Vec::new();
    for (what, frames) in kinds() {
        let name = if what == Part::Frame { "network" } else { "core" };
        let mut row = vec![name.to_owned(), frames.to_string()];
        let pytorch = PYTORCH_CORES.iter().find(|row| what == Part::Core && row.0 == frames);
        for (pair, (classic, minimal)) in pairs.into_iter().enumerate() {
            let ratio = time(what, classic, frames) / time(what, minimal, frames);
            row.push(format!("{ratio:.2}"));
            row.push(pytorch.map_or(String::new(), |(_, ratios)| format!("{:.2}", ratios[pair])));
        }
        rows.push(row);
    }
    let mut row = vec!["products".to_owned(), "any".to_owned()];
    for (classic, minimal) in pairs {
        row.extend([format!("{:.2}", products(classic) / products(minimal)), String::new()]);
    }
    rows.push(row);
    let header = ["what", "frames", "LSTM/minLSTM", "PyTorch", "GRU/minGRU", "PyTorch"];
    table("Time ratio of classic to minimal cores", header, rows)
}

/// The core alone, by window length.
fn plot(timings: &[Timing]) -> LinePlot {
    let mut series: Vec<Series> = Vec::new();
    for timing in timings.iter().filter(|timing| timing.what == Part::Core) {
        let name = timing.core.name();
        let point = [timing.frames as f64, timing.milliseconds / timing.windows as f64];
        match series.iter_mut().find(|series| series.name == name) {
            Some(series) => series.points.push(point),
            None => {
                series.push(Series { name: name.into(), points: vec![point], ..Series::default() });
            }
        }
    }
    LinePlot {
        title: "Core alone: time per sample".into(),
        x: Axis::logarithmic("frames per window"),
        y: Axis::logarithmic("time per sample (ms)"),
        series,
    }
}
