//! The solver's side of `tests/peers/taichi_solver.py`: writes a scene's initial state and the
//! states after 20 and 200 substeps to a folder, times substeps, prints one line of JSON.
//!
//! `solver_bench PRESET ID SUBSTEPS FOLDER`

use std::{env, error::Error, fmt::Write, fs, path::Path, time::Instant};

use clap::ValueEnum;
use eddy::mpm::{
    FRAME_INTERVAL, GRAVITY, GridShape, Law, Materials, Particle, Preset, Scene, Settings,
    Simulation, Solver, SolverSettings,
};

fn main() -> Result<(), Box<dyn Error>> {
    let arguments: Vec<String> = env::args().skip(1).collect();
    let [preset, id, substeps, folder] = arguments.as_slice() else {
        return Err("expected PRESET ID SUBSTEPS FOLDER".into());
    };
    let (preset, folder) = (Preset::from_str(preset, false)?, Path::new(folder));
    let scene = Scene::generate(preset, 1, id.parse()?);
    let materials = Materials { law: Law::Taichi, ..Materials::default() };
    let per_frame = Simulation::new(scene.clone(), &Settings::default())?.substeps_per_frame();
    let dt = FRAME_INTERVAL / per_frame as f32;
    let settings =
        SolverSettings { grid: GridShape::unit(preset.cells()), stiffness, dt, gravity: GRAVITY };
    let start = || {
        Solver::new(scene.particles.clone(), settings)
            .map_err(|particle| format!("particle {particle} is outside the grid"))
    };
    let run = |solver: &mut Solver, substeps: u32| {
        solver.run(substeps).map_err(|particle| format!("particle {particle} left the grid"))
    };

    let mut solver = start()?;
    let mut done = 0;
    for substeps in [0, 20, 200] {
        run(&mut solver, substeps - done)?;
        done = substeps;
        fs::write(folder.join(format!("after_{substeps}.csv")), table(solver.particles())?)?;
    }

    let substeps = substeps.parse()?;
    let mut solver = start()?;
    let before = Instant::now();
    run(&mut solver, substeps)?;
    let microseconds = before.elapsed().as_secs_f64() * 1e6 / f64::from(substeps);
    println!(
        "{}",
        serde_json::json!({
            "microseconds": microseconds, "cells": preset.cells(), "stiffness": materials.stiffness,
            "dt": dt, "gravity": GRAVITY,
        })
    );
    Ok(())
}

/// One line a particle: x, y, vx, vy, material number.
fn table(particles: &[Particle]) -> Result<String, std::fmt::Error> {
    let mut text = String::new();
    for Particle { position: [x, y], velocity: [u, v], material, .. } in particles {
        writeln!(text, "{x},{y},{u},{v},{}", *material as u8)?;
    }
    Ok(text)
}
