//! `eddy simulate`: one bag of ground truth a scene, scenes in parallel, and a manifest.
//!
//! A scene is written to `.incomplete/scene_0007`, entered in the manifest, then moved to
//! `scene_0007`: what has its final name is whole, and what has an entry but no directory is made
//! again.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

use anyhow::{Context, bail, ensure};
use indicatif::ProgressBar;
use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::{
    Interrupt,
    manifest::{Finished, Manifest, Request, Start},
    progress_bar,
};
use crate::cli::SimulateArgs;
use eddy::{
    bag::{BagWriter, WriterOptions},
    dataset::TRUTH_TOPIC,
    mpm::{Materials, Scene, Settings, Simulation},
    msg::{Message, ParticleFrame},
};

/// Where scenes are written until they are finished.
const INCOMPLETE: &str = ".incomplete";

/// Simulates the scenes that are not there yet.
pub fn run(args: SimulateArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    ensure!(args.scenes > 0, "scenes: found 0, expected at least 1");
    let SimulateArgs { stiffness, law, viscosity, substeps, duration, .. } = args;
    let request = Request {
        eddy: env!("CARGO_PKG_VERSION").into(),
        preset: args.preset,
        seed: args.seed,
        settings: Settings {
            materials: Materials { stiffness, law, viscosity },
            substeps,
            duration,
        },
    };
    let manifest = Manifest::open(&args.output, request.clone())?;
    let planned = plan(&args, &request, &manifest)?;
    let present = args.scenes as usize - planned.len();
    if present > 0 {
        println!("{present} of {} scenes are in {} already", args.scenes, args.output.display());
    }
    let workshop = Workshop::open(&args.output)?;
    ensure!(
        Manifest::open(&args.output, request.clone())? == manifest,
        "{}: another eddy simulate has added scenes just now; run the command again",
        args.output.display()
    );
    let frames = planned.iter().map(|scene| scene.most_frames).sum();
    let job = Job {
        request,
        workshop,
        manifest: Mutex::new(manifest),
        bar: progress_bar(frames, "frames", quiet),
        interrupt,
    };
    let outcome = planned
        .par_iter()
        .with_max_len(1)
        .map(|scene| job.simulate(scene))
        .collect::<anyhow::Result<Vec<Option<Finished>>>>();
    job.bar.finish_and_clear();
    job.workshop.close();
    let outcome = outcome?;
    let finished: Vec<&Finished> = outcome.iter().flatten().collect();
    let frames: u64 = finished.iter().map(|scene| scene.frames).sum();
    println!("{} scenes, {frames} frames: {}", finished.len(), args.output.display());
    if finished.len() < outcome.len() {
        let whole = present + finished.len();
        bail!(
            "interrupted: {whole} of {} scenes are finished; the same command makes the others",
            args.scenes
        );
    }
    Ok(())
}

/// A scene that has to be made.
struct Planned {
    start: Start,
    most_frames: u64,
}

/// Sets every scene up once, so that a request that cannot be met is refused before anything is
/// written, and leaves out the scenes that are there already.
fn plan(
    args: &SimulateArgs,
    request: &Request,
    manifest: &Manifest,
) -> anyhow::Result<Vec<Planned>> {
    let planned: Vec<Option<Planned>> = (0..args.scenes)
        .into_par_iter()
        .map(|id| {
            let simulation = set_up(request, id.into())?;
            let start = Start::of(&simulation);
            let directory = args.output.join(name(start.id));
            if fs::symlink_metadata(&directory).is_err() {
                return Ok(Some(Planned { start, most_frames: simulation.most_frames() }));
            }
            let known = manifest.scene(start.id).is_some_and(|found| found.start == start);
            ensure!(
                known,
                "{}: found a directory that the manifest does not have, expected none; \
                 choose another output",
                directory.display()
            );
            Ok(None)
        })
        .collect::<anyhow::Result<_>>()?;
    Ok(planned.into_iter().flatten().collect())
}

fn set_up(request: &Request, id: u64) -> anyhow::Result<Simulation> {
    let scene = Scene::generate(request.preset, request.seed, id);
    Simulation::new(scene, &request.settings).with_context(|| format!("scene {id}"))
}

/// The directory of a scene's bag.
fn name(id: u64) -> String {
    format!("scene_{id:04}")
}

/// What the threads share.
struct Job<'a> {
    request: Request,
    workshop: Workshop,
    manifest: Mutex<Manifest>,
    bar: ProgressBar,
    interrupt: &'a Interrupt,
}

impl Job<'_> {
    /// Makes one scene; `None` when a signal came before its end.
    fn simulate(&self, planned: &Planned) -> anyhow::Result<Option<Finished>> {
        let id = planned.start.id;
        let unfinished = self.workshop.place(&name(id))?;
        let Some(finished) =
            self.record(planned, &unfinished).with_context(|| format!("scene {id}"))?
        else {
            return Ok(None);
        };
        let directory = self.workshop.output.join(name(id));
        let mut manifest = self.manifest.lock().unwrap_or_else(PoisonError::into_inner);
        manifest.insert(finished.clone());
        manifest.save(&self.workshop.output)?;
        fs::rename(&unfinished, &directory)
            .with_context(|| format!("cannot move {}", directory.display()))?;
        Ok(Some(finished))
    }

    /// Runs the scene into a bag.
    fn record(&self, planned: &Planned, bag: &Path) -> anyhow::Result<Option<Finished>> {
        let mut simulation = set_up(&self.request, planned.start.id)?;
        let mut writer = BagWriter::create(bag, WriterOptions::default())?;
        let topic = writer.topic(TRUTH_TOPIC, ParticleFrame::TYPE)?;
        let mut digest = Sha256::new();
        let mut frames = 0;
        while !self.interrupt.requested() {
            let Some(frame) = simulation.next_frame()? else {
                self.bar.inc(planned.most_frames - frames);
                writer.finish()?;
                let sha256 = format!("{:x}", digest.finalize());
                return Ok(Some(Finished { start: planned.start.clone(), frames, sha256 }));
            };
            let cdr = frame.to_cdr();
            digest.update(&cdr);
            writer.write(topic, frame.stamp, frame.stamp, &cdr)?;
            frames += 1;
            self.bar.inc(1);
        }
        Ok(None)
    }
}

/// The place for what is not finished, held by one process at a time.
struct Workshop {
    output: PathBuf,
    /// Locked as long as it is open.
    _lock: File,
}

impl Workshop {
    /// Opens the place in an output directory, which is made if need be.
    fn open(output: &Path) -> anyhow::Result<Self> {
        let directory = output.join(INCOMPLETE);
        fs::create_dir_all(&directory)
            .with_context(|| format!("cannot make {}", directory.display()))?;
        let path = directory.join("lock");
        let lock =
            File::create(&path).with_context(|| format!("cannot make {}", path.display()))?;
        lock.try_lock().with_context(|| {
            format!("{}: another eddy simulate works in this directory", path.display())
        })?;
        Ok(Self { output: output.into(), _lock: lock })
    }

    /// A free place for a bag. What an ended process left there is taken away.
    fn place(&self, name: &str) -> anyhow::Result<PathBuf> {
        let place = self.output.join(INCOMPLETE).join(name);
        if place.exists() {
            fs::remove_dir_all(&place)
                .with_context(|| format!("cannot remove {}", place.display()))?;
        }
        Ok(place)
    }

    /// Takes the place away with whatever is unfinished in it.
    fn close(&self) {
        if let Err(error) = fs::remove_dir_all(self.output.join(INCOMPLETE)) {
            tracing::warn!("cannot remove {INCOMPLETE} in {}: {error}", self.output.display());
        }
    }
}
