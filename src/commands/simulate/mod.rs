//! `eddy simulate`: ground truth, as one bag a scene, as a live source, or both.
//!
//! 1. [`source`]: where scenes come from: a preset and a seed, or a file.
//! 2. [`plan`]: every scene set up once, so that a request that cannot be met is refused before
//!    anything is written; [`memory`]: whether the machine is large enough.
//! 3. [`write`]: scenes in parallel, each into a bag ([`recording`]).
//! 4. [`publish`]: scenes one after the other at the pace of real time.
//! 5. [`workshop`] and [`manifest`]: a scene is written to `.incomplete/scene_0007`, entered in the
//!    manifest, then moved to `scene_0007`: what has its final name is whole, and what has an entry
//!    but no directory is made again.

mod manifest;
pub(crate) mod memory;
mod plan;
mod publish;
mod recording;
pub(crate) mod source;
mod workshop;
mod write;

use anyhow::{bail, ensure};

use super::Interrupt;
use crate::cli::SimulateArgs;
use eddy::mpm::{self, Settings, Simulation};
pub(super) use manifest::scenes;
use manifest::{Manifest, Request};
use plan::Planned;
use recording::Archive;
use source::Source;

/// Simulates the scenes that are not there yet.
pub fn run(args: SimulateArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let job = Job::of(&args)?;
    // Zero stands for as many as there are cores, or as RAYON_NUM_THREADS says.
    let threads = args.threads.map_or(0, |threads| threads.get());
    ensure!(threads <= 1024, "threads: found {threads}, expected 1 to 1024");
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    let manifest = args
        .output
        .as_ref()
        .map(|output| Manifest::open(output, job.request.clone()).map(|found| (output, found)))
        .transpose()?;
    let at_once = if args.publish.is_some() { 1 } else { pool.current_num_threads() };
    let planned = pool.install(|| job.plan(manifest.as_ref(), at_once))?;
    let present = job.scenes as usize - planned.len();
    if let (Some((output, _)), 1..) = (&manifest, present) {
        println!("{present} of {} scenes are in {} already", job.scenes, output.display());
    }
    let archive = match manifest {
        Some((output, manifest)) => Some(Archive::open(output, &job.request, manifest)?),
        None => None,
    };
    // What scenes leave over is shared within each, but only of what was asked for: threads that wait
    // for each other lose more than they win on a machine that does something else as well.
    let shared = threads / at_once.min(planned.len().max(1));
    let job = Job { threads: shared.max(1), ..job };
    let outcome = match &args.publish {
        Some(link) => {
            ensure!(
                present == 0,
                "{link}: found {present} scenes that are there already, expected none; \
                 `eddy replay` publishes finished scenes"
            );
            publish::run(&job, &planned, link, &args, archive.as_ref(), quiet, interrupt)
        }
        None => match &archive {
            Some(archive) => {
                pool.install(|| write::run(&job, &planned, archive, present, quiet, interrupt))
            }
            None => bail!("found neither --output nor --publish, expected one of them"),
        },
    };
    if let Some(archive) = archive {
        archive.close();
    }
    outcome
}

/// What was asked for.
struct Job {
    source: Source,
    /// How errors name the scene, if there is only one.
    name: Option<String>,
    request: Request,
    /// How many scenes.
    scenes: u32,
    /// Threads that share the work of one scene.
    threads: usize,
}

impl Job {
    fn of(args: &SimulateArgs) -> anyhow::Result<Self> {
        ensure!(args.scenes > 0, "scenes: found 0, expected at least 1");
        let source = Source::of(args)?;
        ensure!(
            args.scenes == 1 || matches!(source, Source::Random(_)),
            "scenes: found {}, expected 1: a scene that is written down is always the same",
            args.scenes
        );
        let name = match (&source, &args.scene) {
            (_, Some(file)) => Some(file.display().to_string()),
            (Source::Written(_), None) => Some(args.preset.clone()),
            (Source::Random(_), None) => None,
        };
        let SimulateArgs { stiffness, law, viscosity, substeps, duration, .. } = *args;
        let scene = match &args.scene {
            Some(file) => file.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
            None => args.preset.clone(),
        };
        let request = Request {
            eddy: env!("CARGO_PKG_VERSION").into(),
            scene,
            seed: args.seed,
            particles: source.unusual_particles(),
            settings: Settings { stiffness, law, viscosity, substeps, duration },
        };
        Ok(Self { source, name, request, scenes: args.scenes, threads: 1 })
    }

    /// Scene number `index`, as it will be simulated.
    fn scene(&self, index: u64) -> mpm::Scene {
        self.request.settings.over(self.source.scene(self.request.seed, index))
    }

    /// How errors name a scene.
    fn name(&self, id: u64) -> String {
        self.name.clone().unwrap_or_else(|| format!("scene {id}"))
    }

    /// A planned scene at its start.
    fn start(&self, planned: &Planned) -> Result<Simulation, mpm::MpmError> {
        let scene = planned.start.scene.clone();
        Simulation::on_threads(scene, &Settings::default(), self.threads)
    }
}

/// The directory of a scene's bag.
fn directory(id: u64) -> String {
    format!("scene_{id:04}")
}
