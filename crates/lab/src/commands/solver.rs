//! `eddy-lab bench solver`: time per substep.

use std::{fs, path::Path};

use anyhow::{Context, anyhow, ensure};
use serde::Serialize;

use super::args::BenchSolverArgs;
use super::{BenchOutput, table};
use crate::bench::{
    limit::Limit,
    solver::{CASES, COMPARED, Case, MIXED, Timing},
};
use eddy_bag::{BagWriter, WriterOptions};
use eddy_dataset::TRUTH_TOPIC;
use eddy_frames::{Material, progress::Progress};
use eddy_messages::{FrameCdr, Message, ParticleFrame};
use eddy_mpm::{GRAVITY, Law, Materials};
use eddy_pages::{Axis, LinePlot, Series};
use eddy_settings::{ensure_usage, usage::Usage};

/// JSON output.
#[derive(Serialize)]
struct SolverReport {
    law: Law,
    stiffness: f32,
    /// Angle of internal friction of sand (degrees).
    friction_angle_degrees: f32,
    gravity: f32,
    /// Substeps of the frames in the bags.
    compared: [u32; 3],
    limits: Vec<Limit>,
    timings: Vec<Timing>,
}

/// Times the cases.
pub fn run(
    args: BenchSolverArgs,
    html: Option<&Path>,
    progress: &dyn Progress,
) -> anyhow::Result<()> {
    let chosen = CASES
        .into_iter()
        .filter(|(particles, _)| args.particles.is_empty() || args.particles.contains(particles));
    let cases: Vec<(usize, u32)> = chosen.collect();
    let sizes = CASES.map(|(particles, _)| particles);
    if let Some(unknown) = args.particles.iter().find(|particles| !sizes.contains(particles)) {
        return Err(Usage::new(format_args!(
            "particles: found {unknown}, expected some of {sizes:?}"
        ))
        .into());
    }
    ensure_usage!(
        args.threads.iter().all(|&threads| (1..=1024).contains(&threads)),
        "threads: found {:?}, expected numbers from 1 to 1024",
        args.threads
    );
    ensure_usage!(args.seconds > 0.0, "seconds: found {}, expected more than 0", args.seconds);
    let blocks = if args.sand { [Material::Sand; 3] } else { MIXED };
    if let Some(output) = &args.output {
        fs::create_dir_all(output)
            .with_context(|| format!("cannot create {}", output.display()))?;
        for &(particles, cells) in &cases {
            write_bag(&Case::new(particles, cells, blocks, args.law, 1), output)?;
        }
    }
    progress.begin((cases.len() * args.threads.len()) as u64, "cases");
    let (mut limits, mut timings) = (Vec::new(), Vec::new());
    for &threads in &args.threads {
        let limit = Limit::measure(threads);
        limits.push(limit);
        for &(particles, cells) in &cases {
            ensure!(!progress.cancelled(), "interrupted");
            let case = Case::new(particles, cells, blocks, args.law, threads);
            let timing = case
                .time(args.seconds, &limit)
                .map_err(|lost| anyhow!("{particles} particles: particle {lost} left the grid"))?;
            timings.push(timing);
            progress.advance(1);
        }
    }
    progress.finish();
    let output = output(&timings, &limits, args.sand);
    let Materials { stiffness, friction_angle_degrees, .. } = Materials::default();
    let (law, gravity, compared) = (args.law, GRAVITY, COMPARED);
    let report =
        SolverReport { law, stiffness, friction_angle_degrees, gravity, compared, limits, timings };
    output.show(&report, args.json, html)
}

/// Writes the bag for comparison with other programs.
fn write_bag(case: &Case, output: &Path) -> anyhow::Result<()> {
    let bag = output.join(format!("particles_{}", case.particles.len()));
    let mut writer = BagWriter::create(&bag, WriterOptions::default())?;
    let topic = writer.topic(TRUTH_TOPIC, ParticleFrame::TYPE)?;
    let frames = case.compared().with_context(|| bag.display().to_string())?;
    ensure!(
        frames.len() == COMPARED.len(),
        "{}: found {} frames, expected {}: the scene blew up",
        bag.display(),
        frames.len(),
        COMPARED.len()
    );
    for frame in frames {
        writer.write_stamped(topic, frame.stamp, &frame.to_cdr())?;
    }
    writer.finish()?;
    Ok(())
}

fn output(timings: &[Timing], limits: &[Limit], sand: bool) -> BenchOutput {
    let header = ["particles", "grid", "threads", "us/substep", "ns/particle", "of limit"];
    let rows = timings.iter().map(|timing| {
        vec![
            timing.particles.to_string(),
            format!("{0}x{0}", timing.cells),
            timing.threads.to_string(),
            format!("{:.1}", timing.microseconds),
            format!("{:.2}", timing.nanoseconds_per_particle),
            format!("{:.0} %", 100.0 * timing.share_of_limit),
        ]
    });
    let matter = if sand { "sand" } else { "liquid, snow and jelly in equal parts" };
    let first = format!("{matter}; fastest of 5 rounds");
    let limit = |Limit { threads, operations, bytes }: &Limit| {
        format!(
            "limit (--threads {threads}): {:.0} G operations/s in vectors, {:.1} GB/s of memory",
            operations * 1e-9,
            bytes * 1e-9
        )
    };
    let series = limits.iter().map(|&Limit { threads, .. }| {
        let of = timings.iter().filter(|timing| timing.threads == threads);
        Series {
            name: format!("{threads} threads"),
            points: of.map(|t| [t.particles as f64, t.nanoseconds_per_particle]).collect(),
            ..Series::default()
        }
    });
    let plot = LinePlot {
        title: "Time per substep".into(),
        x: Axis::logarithmic("particles"),
        y: Axis::linear("time per particle (ns)"),
        series: series.collect(),
    };
    BenchOutput {
        title: "eddy-lab bench solver",
        tables: vec![table("Substeps of the Material Point Method", header, rows)],
        plots: vec![plot],
        notes: std::iter::once(first).chain(limits.iter().map(limit)).collect(),
    }
}
