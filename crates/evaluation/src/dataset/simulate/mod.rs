//! A folder of simulated scenes, one bag each, that the same request resumes.
//!
//! 1. [`source`]: where scenes come from: a preset and a seed, or a file.
//! 2. [`plan`]: every scene set up once, so that a request that cannot be met is refused before
//!    anything is written; whether the machine has the memory for it.
//! 3. [`write`]: scenes in parallel, each into a bag ([`recording`]).
//! 4. [`staging`] and [`manifest`]: a scene is written to `.incomplete/scene_0007`, entered in the
//!    manifest, then moved to `scene_0007`: what has its final name is whole, and what has an entry
//!    but no directory is made again.

mod error;
mod manifest;
mod plan;
mod recording;
mod source;
mod staging;
#[cfg(test)]
mod tests;
mod write;

use std::{num::NonZeroUsize, path::Path};

use eddy_frames::progress::Progress;
use eddy_mpm::{MpmError, Scene, Settings, Simulation};
pub use error::SimulateError;
pub use manifest::{EnergyCurve, Finished, Start, recorded_scenes};
use manifest::{Manifest, RecordedRequest};
pub use plan::Planned;
pub use recording::{Recording, Store};
pub use source::Source;
pub use write::Summary;

/// The most threads.
const MOST_THREADS: usize = 1024;

/// Which scenes to simulate.
#[derive(Clone, Debug)]
pub struct SimulationRequest {
    /// Where scenes come from.
    pub source: Source,
    /// The name of the source in the manifest: a preset, or a scene file without its extension.
    pub name: String,
    /// How errors name the scene, where there is only one; `scene N` if not given.
    pub scene_name: Option<String>,
    /// How many scenes.
    pub scenes: u32,
    /// Seed of random scenes.
    pub seed: u64,
    /// What takes the place of the scenes' own numbers.
    pub settings: Settings,
    /// Threads: one a scene, and those left over share the work within the scenes. If not given, one a
    /// scene and at most one a core.
    pub threads: Option<NonZeroUsize>,
}

impl SimulationRequest {
    /// Checks the numbers.
    fn check(&self) -> Result<(), SimulateError> {
        let refused = |field, found: usize, expected| {
            Err(SimulateError::Request { field, found: found.to_string(), expected })
        };
        if self.scenes == 0 {
            return refused("scenes", 0, "at least 1");
        }
        if self.scenes > 1 && matches!(self.source, Source::Written(_)) {
            let expected = "1: a scene that is written down is always the same";
            return refused("scenes", self.scenes as usize, expected);
        }
        let threads = self.threads.map_or(0, NonZeroUsize::get);
        if threads > MOST_THREADS {
            return refused("threads", threads, "1 to 1024");
        }
        Ok(())
    }

    /// What the manifest keeps of it.
    fn recorded(&self) -> RecordedRequest {
        RecordedRequest {
            eddy: env!("CARGO_PKG_VERSION").into(),
            scene: self.name.clone(),
            seed: self.seed,
            particles: self.source.unusual_particles(),
            settings: self.settings,
        }
    }

    /// Scene number `index`, as it will be simulated.
    fn scene(&self, index: u64) -> Scene {
        self.settings.over(self.source.scene(self.seed, index))
    }

    /// How errors name a scene.
    fn scene_name(&self, id: u64) -> String {
        self.scene_name.clone().unwrap_or_else(|| format!("scene {id}"))
    }
}

/// Simulates the scenes that `output` does not hold yet, each into a bag. A summary says what was made;
/// whether that is all says [`Summary::complete`].
///
/// # Errors
/// [`SimulateError`] when the request cannot be met, or `output` is not its: nothing is written then.
pub fn simulate(
    request: &SimulationRequest,
    output: &Path,
    progress: &dyn Progress,
) -> Result<Summary, SimulateError> {
    let job = Job::plan(request, Some(output), None)?;
    if job.present() > 0 {
        progress.message(&job.present_scenes(output));
    }
    let store = job.open_store(output)?;
    let summary = job.write(&store, progress);
    store.close();
    if !job.planned.is_empty() {
        progress.message(&summary.to_string());
    }
    Ok(summary)
}

/// A request with what is left to do of it.
#[derive(Debug)]
pub struct Job {
    request: SimulationRequest,
    /// What the output directory held, where there is one.
    manifest: Option<Manifest>,
    /// Scenes to be made.
    planned: Vec<Planned>,
    /// Threads that share the work of one scene.
    threads: usize,
    pool: rayon::ThreadPool,
}

impl Job {
    /// Sets every scene up, and leaves out those that `output` holds already. `at_once` of them will be
    /// simulated at a time, one for each thread if not given. Writes nothing.
    ///
    /// # Errors
    /// [`SimulateError`] when the request cannot be met, or `output` is not its.
    pub fn plan(
        request: &SimulationRequest,
        output: Option<&Path>,
        at_once: Option<usize>,
    ) -> Result<Self, SimulateError> {
        request.check()?;
        // Zero stands for as many as there are cores, or as RAYON_NUM_THREADS says.
        let threads = request.threads.map_or(0, NonZeroUsize::get);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        let manifest =
            output.map(|output| Manifest::open(output, &request.recorded())).transpose()?;
        let at_once = at_once.unwrap_or(pool.current_num_threads());
        let planned = pool.install(|| plan::plan(request, manifest.as_ref(), at_once))?;
        // What scenes leave over is shared within each, but only of what was asked for: threads that wait
        // for each other lose more than they win on a machine that does something else as well.
        let threads = (threads / at_once.min(planned.len().max(1))).max(1);
        Ok(Self { request: request.clone(), manifest, planned, threads, pool })
    }

    /// The scenes to be made.
    pub fn planned(&self) -> &[Planned] {
        &self.planned
    }

    /// How many scenes the output directory holds already.
    pub fn present(&self) -> usize {
        self.request.scenes as usize - self.planned.len()
    }

    /// A line about the scenes that the output directory holds already.
    pub fn present_scenes(&self, output: &Path) -> String {
        let (present, scenes) = (self.present(), self.request.scenes);
        format!("{present} of {scenes} scenes are in {} already", output.display())
    }

    /// How messages name a scene.
    pub fn scene_name(&self, id: u64) -> String {
        self.request.scene_name(id)
    }

    /// A planned scene at its start.
    ///
    /// # Errors
    /// As [`Simulation::on_threads`].
    pub fn start(&self, planned: &Planned) -> Result<Simulation, MpmError> {
        let scene = planned.start.scene.clone();
        Simulation::on_threads(scene, &Settings::default(), self.threads)
    }

    /// Locks the output directory that the plan was made for.
    ///
    /// # Errors
    /// [`SimulateError::Locked`] when another process works in it, [`SimulateError::Changed`] when it is not
    /// as the plan found it.
    pub fn open_store(&self, output: &Path) -> Result<Store, SimulateError> {
        Store::open(output, &self.request.recorded(), self.manifest.as_ref())
    }

    /// Simulates the planned scenes in parallel, each into a bag.
    pub fn write(&self, store: &Store, progress: &dyn Progress) -> Summary {
        self.pool.install(|| write::write(self, store, progress))
    }
}

/// The directory of a scene's bag.
fn directory(id: u64) -> String {
    format!("scene_{id:04}")
}
