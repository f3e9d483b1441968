//! The MPM solver on NVIDIA GPUs: `check` compares it with that of the processor, in two runs, alone and beside other scenes;
//! `time [FOLDER]` measures substeps beside those of the processor's threads, and writes the start of the largest case to
//! the folder, for other programs; `once N` runs a few substeps of N scenes, `once PARTICLES CELLS` of one, for profilers.

use std::{fs, io::Write as _, num::NonZero, path::Path, sync::Arc, thread};

use eddy_cuda::{
    gpu::{Gpu, Precision},
    solver::{Constants, Solvers},
};
use eddy_frames::{Material, clock::Clock};
use eddy_mpm::{
    Accelerator, GRAVITY, GridShape, Interval, Law, Materials, Particle, Preset, Scene, Settings,
    Simulation, Solver, SolverSettings,
};

type Result<T> = std::result::Result<T, Box<dyn std::error::Error>>;

/// Bytes of a particle's state, which a substep reads and writes.
const STATE: f64 = 2.0 * 56.0;
/// Memory bandwidth that a copy reaches on an H200 (bytes per s).
const BANDWIDTH: f64 = 4.1e12;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["check"] => check(),
        ["time"] => time(None),
        ["time", folder] => time(Some(Path::new(folder))),
        ["once", count] => {
            let simulations = scenes(count.parse()?)?;
            once(&simulations.iter().map(Simulation::solver).collect::<Vec<_>>())
        }
        ["once", particles, cells] => once(&[&blocks(particles.parse()?, cells.parse()?)?]),
        _ => Err("expected check, time [FOLDER], once N or once PARTICLES CELLS".into()),
    }
}

fn on_gpu() -> Result<Solvers> {
    Ok(Solvers::new(Arc::new(Gpu::new(0, &Constants, Precision::Fp32, None)?), 0))
}

fn threads() -> usize {
    thread::available_parallelism().map_or(1, NonZero::get)
}

/// Three blocks of liquid, snow and jelly that are thrown onto the floor of the unit square, as in `eddy-lab bench solver`.
fn blocks(particles: usize, cells: u32) -> Result<Solver> {
    let grid = GridShape::unit(cells);
    let spacing = 0.5 * grid.dx;
    let kinds = [Material::Liquid, Material::Snow, Material::Jelly];
    let start = kinds.into_iter().enumerate().flat_map(|(k, material)| {
        let count = (particles + k) / kinds.len();
        let side = (count as f32).sqrt() as usize;
        (0..count).map(move |p| {
            let [x, y] = [p % side, p / side].map(|n| (n as f32 + 0.5) * spacing);
            let position = [0.04 + 0.32 * k as f32 + x, 3.0 * grid.dx + y];
            let velocity = [1.0 - k as f32 - 5.0 * y, 5.0 * x - 2.0];
            Particle { velocity, ..Particle::at_rest(position, material) }
        })
    });
    let materials = Materials { law: Law::Taichi, ..Materials::default() };
    let interval = f64::from(eddy_mpm::FRAME_INTERVAL);
    let (substeps, _) = eddy_mpm::minimum_substeps(&kinds, &materials, grid.dx, 6.0, interval);
    let dt = eddy_mpm::FRAME_INTERVAL / substeps as f32;
    let threads = threads();
    let settings = SolverSettings { grid, spacing, materials, dt, gravity: GRAVITY, threads };
    Solver::new(start.collect(), settings).map_err(|lost| format!("particle {lost}").into())
}

/// Scenes of a preset after a few frames, each on one thread.
fn scenes(count: u64) -> Result<Vec<Simulation>> {
    let settings = Settings { duration: Some(1.0), ..Settings::default() };
    let scene = |id| Scene::generate(Preset::MultiMaterial, 1, id);
    Ok((0..count)
        .map(|id| Simulation::new(scene(id), &settings))
        .collect::<std::result::Result<_, _>>()?)
}

/// An interval of a solver.
fn interval(solver: &Solver, substeps: u32) -> Interval {
    Interval { substeps, dt: solver.settings().dt, attractor: None, motions: Vec::new() }
}

/// Milliseconds that `work` takes, at best of several times.
fn best(mut work: impl FnMut() -> Result<()>) -> Result<f64> {
    let mut best = f64::INFINITY;
    for _ in 0..5 {
        let clock = Clock::start();
        work()?;
        best = best.min(clock.now().as_secs_f64() * 1e3);
    }
    Ok(best)
}

/// Largest distance between the particles of two solvers (cells).
fn distance(one: &Solver, other: &Solver) -> f32 {
    let pairs = one.particles().iter().zip(other.particles());
    let far =
        pairs.map(|(a, b)| (a.position[0] - b.position[0]).hypot(a.position[1] - b.position[1]));
    far.fold(0.0, f32::max) / one.settings().grid.dx
}

fn check() -> Result<()> {
    let (mut first, mut second) = (on_gpu()?, on_gpu()?);
    for (particles, cells) in [(2_500, 64), (100_000, 512)] {
        let mut expected = blocks(particles, cells)?;
        let (mut found, mut again) = (expected.clone(), expected.clone());
        for device in [&mut first, &mut second] {
            device.load(&[&found])?;
        }
        for substeps in [20, 180] {
            expected.run(substeps).map_err(|lost| format!("particle {lost} lost"))?;
            for (device, solver) in [(&mut first, &mut found), (&mut second, &mut again)] {
                device.run(&[interval(solver, substeps)], &|| false)?[0]
                    .map_err(|lost| format!("particle {lost} lost"))?;
                device.fetch(&mut [solver]);
            }
            println!(
                "{particles} particles, after {substeps} more substeps: {:.1e} cells from the processor's, same bits in two runs: {}",
                distance(&expected, &found),
                found.particles() == again.particles()
            );
        }
    }
    let mut together: Vec<Solver> = scenes(64)?.iter().map(|it| it.solver().clone()).collect();
    let start = together[7].clone();
    let mut all: Vec<&mut Solver> = together.iter_mut().collect();
    first.load(&all.iter().map(|solver| &**solver).collect::<Vec<_>>())?;
    let intervals: Vec<Interval> = all.iter().map(|solver| interval(solver, 200)).collect();
    first.run(&intervals, &|| false)?;
    first.fetch(&mut all);
    let mut alone = start;
    second.load(&[&alone])?;
    second.run(&[interval(&alone, 200)], &|| false)?;
    second.fetch(&mut [&mut alone]);
    println!("a scene beside 63: same bits: {}", alone.particles() == together[7].particles());
    Ok(())
}

fn time(folder: Option<&Path>) -> Result<()> {
    println!(
        "substeps of the device against {} threads of the processor (ms; bytes of states at {BANDWIDTH:.1e} B/s)",
        threads()
    );
    let mut device = on_gpu()?;
    for (particles, cells) in [(2_500, 64), (10_000, 128), (100_000, 512), (1_000_000, 1024)] {
        let mut solver = blocks(particles, cells)?;
        if let (Some(folder), 1_000_000) = (folder, particles) {
            write_start(folder, &solver)?;
        }
        device.load(&[&solver])?;
        device.advance(&[interval(&solver, 64)])?;
        let substeps = 1_000;
        let work = || device.advance(&[interval(&solver, substeps)]).map(drop).map_err(Into::into);
        let here = best(work)? / f64::from(substeps);
        let on_processor = (20_000_000 / particles as u32).clamp(20, 1000);
        let clock = Clock::start();
        solver.run(on_processor).map_err(|lost| format!("particle {lost} lost"))?;
        let there = clock.now().as_secs_f64() * 1e3 / f64::from(on_processor);
        row(&format!("1 x {particles}, {cells} cells"), here, there, particles);
    }
    let mut simulations = scenes(256)?;
    let particles: usize = simulations.iter().map(Simulation::particles).sum();
    let substeps = 153;
    let all: Vec<&Solver> = simulations.iter().map(Simulation::solver).collect();
    device.load(&all)?;
    let intervals: Vec<Interval> = all.iter().map(|solver| interval(solver, substeps)).collect();
    device.advance(&intervals)?;
    let here =
        best(|| device.advance(&intervals).map(drop).map_err(Into::into))? / f64::from(substeps);
    let run = best(|| device.run(&intervals, &|| false).map(drop).map_err(Into::into))?;
    let fetch = best(|| {
        let mut all: Vec<&mut Solver> =
            simulations.iter_mut().map(Simulation::solver_mut).collect();
        device.fetch(&mut all);
        Ok(())
    })?;
    let clock = Clock::start();
    let share = simulations.len().div_ceil(threads());
    thread::scope(|scope| {
        for part in simulations.chunks_mut(share) {
            scope.spawn(move || {
                for simulation in part {
                    // A diverged scene would be cheaper: it shows in `check`.
                    let _ = simulation.solver_mut().run(substeps);
                }
            });
        }
    });
    let there = clock.now().as_secs_f64() * 1e3 / f64::from(substeps);
    row("256 x 2500, 64 cells", here, there, particles);
    println!(
        "a frame of all 256, {substeps} substeps: {run:.2} ms, and {fetch:.2} ms to copy the states to the solvers"
    );
    Ok(())
}

fn row(case: &str, here: f64, there: f64, particles: usize) {
    let limit = particles as f64 * STATE / BANDWIDTH * 1e3;
    println!(
        "{case:24} {here:8.4}  {there:8.4}  {:6.1} x  limit {limit:.4}, {:3.0} %",
        there / here,
        100.0 * limit / here
    );
}

/// x, y, vx, vy and material of every particle, as numbers of 4 bytes; substep and cells in the file's name.
fn write_start(folder: &Path, solver: &Solver) -> Result<()> {
    let SolverSettings { dt, grid, .. } = solver.settings();
    fs::create_dir_all(folder)?;
    let file = folder.join(format!("start_{}_{dt:e}.f32", grid.cells[0]));
    let mut file = std::io::BufWriter::new(fs::File::create(file)?);
    for Particle { position, velocity, material, .. } in solver.particles() {
        let [x, y] = position;
        let [u, v] = velocity;
        for number in [*x, *y, *u, *v, f32::from(*material as u8)] {
            file.write_all(&number.to_le_bytes())?;
        }
    }
    Ok(file.flush()?)
}

fn once(solvers: &[&Solver]) -> Result<()> {
    let mut device = on_gpu()?;
    device.load(solvers)?;
    let intervals: Vec<Interval> = solvers.iter().map(|solver| interval(solver, 130)).collect();
    device.run(&intervals, &|| false)?;
    Ok(())
}
