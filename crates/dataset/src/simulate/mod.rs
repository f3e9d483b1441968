//! A folder of simulated scenes, one bag each; repeating the request resumes it.
//!
//! 1. [`source`]: where scenes come from: a preset and a seed, or a file.
//! 2. [`plan`]: sets up every scene once, so that an invalid request, or one that exceeds the memory, is rejected before
//!    anything is written.
//! 3. [`write`]: simulates scenes in parallel, each into a bag ([`recording`]); [`side_by_side`] does so on a device.
//! 4. [`staging`] and [`manifest`]: a scene is written to `.incomplete/scene_0007`, entered in the
//!    manifest, then moved to `scene_0007`. So a bag with its final name is complete, and a scene with an entry but no
//!    directory is simulated again. In a store a bag is complete once its `metadata.yaml` is there, which is uploaded last.
//!
//! Several processes can simulate scenes of one request at the same time ([`simulate_some`]); the manifest is then written at
//! the end ([`collect`]).

mod error;
mod manifest;
mod older_form;
mod plan;
mod recording;
mod side_by_side;
mod source;
mod staging;
#[cfg(test)]
mod tests;
mod write;

use std::{
    num::NonZeroUsize,
    ops::Range,
    path::{Path, PathBuf},
};

use eddy_frames::progress::Progress;
use eddy_mpm::{Accelerator, Extent, MpmError, Scene, Settings, Simulation};
pub use error::SimulateError;
pub use manifest::{EnergyCurve, Finished, ScenesBeside, Start, recorded_scenes};
use manifest::{Manifest, RecordedRequest};
pub use plan::Planned;
pub use recording::{Recording, Store};
pub use side_by_side::MOST_SCENES;
pub use source::Source;
pub use write::Summary;

/// The file of a bag in a store that is uploaded last.
const UPLOADED_LAST: &str = "metadata.yaml";

/// Maximum number of threads.
const MAX_THREADS: usize = 1024;

/// Which scenes to simulate.
#[derive(Clone, Debug)]
pub struct SimulationRequest {
    /// Source of the scenes.
    pub source: Source,
    /// Name of the source in the manifest: a preset, or a scene file without its extension.
    pub name: String,
    /// Name of a single scene in errors; `scene N` if not given.
    pub scene_name: Option<String>,
    /// Number of scenes.
    pub scenes: u32,
    /// Seed of random scenes.
    pub seed: u64,
    /// Overrides of the scenes' own settings.
    pub settings: Settings,
    /// Whether to record pressure and energy of every particle.
    pub fields: bool,
    /// The kind of device that computes, whose bits are its own; the processor if not given.
    pub device: Option<&'static str>,
    /// Threads: one per scene; surplus threads share the work within scenes. By default one per scene, at most one per
    /// core.
    pub threads: Option<NonZeroUsize>,
}

impl SimulationRequest {
    /// Checks the ranges of the numbers.
    fn check(&self) -> Result<(), SimulateError> {
        let rejected = |field, found: usize, expected| {
            Err(SimulateError::Request { field, found: found.to_string(), expected })
        };
        if self.scenes == 0 {
            return rejected("scenes", 0, "at least 1");
        }
        if self.scenes > 1 && matches!(self.source, Source::Written(_)) {
            let expected = "1: a scene file always gives the same scene";
            return rejected("scenes", self.scenes as usize, expected);
        }
        let threads = self.threads.map_or(0, NonZeroUsize::get);
        if threads > MAX_THREADS {
            return rejected("threads", threads, "1 to 1024");
        }
        Ok(())
    }

    /// The request with a scene in the present form.
    fn in_present_form(&self) -> Self {
        let mut request = self.clone();
        if let Source::Written(scene) = &mut request.source {
            let source = self.scene_name.as_ref().unwrap_or(&self.name);
            older_form::read(scene, source);
        }
        request
    }

    /// The part that the manifest records.
    fn recorded(&self) -> RecordedRequest {
        let extent = self.source.extent();
        RecordedRequest {
            eddy: env!("CARGO_PKG_VERSION").into(),
            scene: self.name.clone(),
            seed: self.seed,
            particles: self.source.unusual_particles(),
            same_bodies: extent.is_some_and(Extent::same_bodies),
            fill: extent.and_then(Extent::fill),
            stiffness: extent.and_then(Extent::stiffness),
            settings: self.settings,
            fields: self.fields,
            device: self.device.map(Into::into),
        }
    }

    /// Scene `index` with the overrides applied.
    fn scene(&self, index: u64) -> Scene {
        self.settings.over(self.source.scene(self.seed, index))
    }

    /// The bag of scene `index` in an output directory.
    pub fn bag(&self, output: &Path, index: u32) -> PathBuf {
        output.join(directory(self.scene(index.into()).id))
    }

    /// The manifest in an output directory.
    pub fn manifest(output: &Path) -> PathBuf {
        manifest::path(output)
    }

    /// Name of a scene in errors.
    fn scene_name(&self, id: u64) -> String {
        self.scene_name.clone().unwrap_or_else(|| format!("scene {id}"))
    }
}

/// Simulates the scenes that are not in `output` yet, each into a bag, on the processor or on the device of the request.
/// [`Summary::complete`] tells whether all scenes are there.
///
/// # Errors
/// [`SimulateError`] when the request is invalid or `output` belongs to another request; nothing is written then.
pub fn simulate(
    request: &SimulationRequest,
    output: &Path,
    progress: &dyn Progress,
    device: Option<&mut dyn Accelerator>,
) -> Result<Summary, SimulateError> {
    let job = Job::plan(request, Some(output), device.as_ref().map(|_| MOST_SCENES))?;
    if job.present() > 0 {
        progress.message(&job.present_scenes(output));
    }
    let store = job.open_store(output)?;
    let summary = job.write(&store, progress, device);
    store.close();
    if !job.planned.is_empty() {
        progress.message(&summary.to_string());
    }
    Ok(summary)
}

/// As [`simulate`], for some of the scenes and with other processes that simulate others in the same directory.
///
/// # Errors
/// As [`simulate`].
pub fn simulate_some(
    request: &SimulationRequest,
    scenes: Range<u32>,
    output: &Path,
    progress: &dyn Progress,
    device: Option<&mut dyn Accelerator>,
) -> Result<Summary, SimulateError> {
    let at_once = device.as_ref().map(|_| MOST_SCENES);
    let job = Job::plan_some(request, scenes, Some(output), at_once)?;
    let store = Store::share(output, &request.recorded())?;
    let summary = job.write(&store, progress, device);
    store.close();
    Ok(summary)
}

/// Writes the manifest of a directory in which other processes have simulated all scenes ([`simulate_some`]).
///
/// # Errors
/// [`SimulateError::Missing`] when they have not; [`SimulateError`] when `output` belongs to another request.
pub fn collect(request: &SimulationRequest, output: &Path) -> Result<(), SimulateError> {
    let job = Job::plan(request, Some(output), None)?;
    if let Some(first) = job.planned.first() {
        let directory = output.join(directory(first.start.id));
        return Err(SimulateError::Missing { directory, more: job.planned.len() - 1 });
    }
    job.open_store(output)?.close();
    Ok(())
}

/// A request and its remaining scenes.
#[derive(Debug)]
pub struct Job {
    request: SimulationRequest,
    /// The scenes of the request that this job is about.
    range: Range<u32>,
    /// The manifest of the output directory, if one is used.
    manifest: Option<Manifest>,
    /// Scenes to simulate.
    planned: Vec<Planned>,
    /// Threads that share the work of one scene.
    threads: usize,
    pool: rayon::ThreadPool,
}

impl Job {
    /// Sets up every scene, except those already in `output`. `at_once` scenes will be simulated in parallel, by default
    /// one per thread. Writes nothing.
    ///
    /// # Errors
    /// [`SimulateError`] when the request is invalid or `output` belongs to another request.
    pub fn plan(
        request: &SimulationRequest,
        output: Option<&Path>,
        at_once: Option<usize>,
    ) -> Result<Self, SimulateError> {
        Self::plan_some(request, 0..request.scenes, output, at_once)
    }

    /// As [`Job::plan`], for a range of the scenes.
    fn plan_some(
        request: &SimulationRequest,
        range: Range<u32>,
        output: Option<&Path>,
        at_once: Option<usize>,
    ) -> Result<Self, SimulateError> {
        request.check()?;
        let request = &request.in_present_form();
        // Zero means one per core, or RAYON_NUM_THREADS.
        let threads = request.threads.map_or(0, NonZeroUsize::get);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
        let manifest =
            output.map(|output| Manifest::open(output, &request.recorded())).transpose()?;
        let at_once = at_once.unwrap_or(pool.current_num_threads());
        let planned =
            pool.install(|| plan::plan(request, range.clone(), manifest.as_ref(), at_once))?;
        // Surplus threads are used within scenes, but only if requested: on a busy machine, threads that wait for each
        // other lose more than they gain.
        let threads = (threads / at_once.min(planned.len().max(1))).max(1);
        Ok(Self { request: request.clone(), range, manifest, planned, threads, pool })
    }

    /// The scenes to simulate.
    pub fn planned(&self) -> &[Planned] {
        &self.planned
    }

    /// Number of scenes that this job is about.
    fn scenes(&self) -> u32 {
        self.range.end - self.range.start
    }

    /// Number of scenes already in the output directory.
    pub fn present(&self) -> usize {
        self.scenes() as usize - self.planned.len()
    }

    /// A message about the scenes already in the output directory.
    pub fn present_scenes(&self, output: &Path) -> String {
        let (present, scenes) = (self.present(), self.scenes());
        format!("{present} of {scenes} scenes are already in {}", output.display())
    }

    /// Name of a scene in messages.
    pub fn scene_name(&self, id: u64) -> String {
        self.request.scene_name(id)
    }

    /// The simulation of a planned scene, at its start.
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
    /// [`SimulateError::Locked`] when another process uses it, [`SimulateError::Changed`] when it has changed since it was
    /// planned.
    pub fn open_store(&self, output: &Path) -> Result<Store, SimulateError> {
        Store::open(output, &self.request.recorded(), self.manifest.as_ref())
    }

    /// Simulates the planned scenes, each into a bag: in parallel, or side by side on a device.
    pub fn write(
        &self,
        store: &Store,
        progress: &dyn Progress,
        device: Option<&mut dyn Accelerator>,
    ) -> Summary {
        self.pool.install(|| write::write(self, store, progress, device))
    }
}

/// The directory of a scene's bag.
fn directory(id: u64) -> String {
    format!("scene_{id:04}")
}
