//! Scenes in parallel, each into a bag of its own.

use std::{
    fmt,
    path::PathBuf,
    sync::atomic::{AtomicBool, Ordering},
};

use rayon::prelude::*;

use super::{
    Job, SimulateError,
    manifest::Finished,
    plan::Planned,
    recording::{Recording, Store},
};
use eddy_frames::progress::Progress;

/// What became of the scenes of a request.
#[derive(Debug)]
pub struct Summary {
    /// The scenes that were simulated now.
    pub finished: Vec<Finished>,
    /// Scenes that were there before.
    pub present: usize,
    /// Scenes asked for.
    pub scenes: u32,
    /// The output directory.
    output: PathBuf,
    /// Scenes that failed.
    failures: Vec<SimulateError>,
    /// Whether it was cancelled on the way.
    cancelled: bool,
}

impl Summary {
    /// Frames that were written now.
    pub fn frames(&self) -> u64 {
        self.finished.iter().map(|scene| scene.frames).sum()
    }

    /// Whether all scenes are there now.
    ///
    /// # Errors
    /// [`SimulateError::Failed`] with the reason of each scene that failed, else
    /// [`SimulateError::Cancelled`] when it was cancelled.
    pub fn complete(self) -> Result<(), SimulateError> {
        let Self { finished, present, scenes, failures, cancelled, .. } = self;
        let finished = present + finished.len();
        if !failures.is_empty() {
            return Err(SimulateError::Failed { failures, finished, scenes });
        }
        if cancelled {
            return Err(SimulateError::Cancelled { finished, scenes });
        }
        Ok(())
    }
}

/// What was simulated now, and where it is.
impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scenes = self.finished.len();
        let plural = if scenes == 1 { "" } else { "s" };
        write!(f, "{scenes} scene{plural}, {} frames: {}", self.frames(), self.output.display())
    }
}

/// Makes the planned scenes. One that fails stops the others only where they would fail too.
pub(super) fn write(job: &Job, store: &Store, progress: &dyn Progress) -> Summary {
    let (present, scenes) = (job.present(), job.request.scenes);
    let mut summary = Summary {
        finished: Vec::new(),
        present,
        scenes,
        output: store.output().to_owned(),
        failures: Vec::new(),
        cancelled: false,
    };
    if job.planned.is_empty() {
        return summary;
    }
    let frames = job.planned.iter().map(|scene| scene.most_frames).sum();
    progress.begin(frames, "frames");
    let work = Work { job, store, progress, hopeless: AtomicBool::new(false) };
    let outcomes: Vec<Result<Option<Finished>, SimulateError>> =
        job.planned.par_iter().with_max_len(1).map(|scene| work.scene(scene)).collect();
    progress.finish();
    summary.cancelled = progress.cancelled();
    for outcome in outcomes {
        match outcome {
            Ok(finished) => summary.finished.extend(finished),
            Err(failure) => summary.failures.push(failure),
        }
    }
    summary
}

/// What the threads share.
struct Work<'a> {
    job: &'a Job,
    store: &'a Store,
    progress: &'a dyn Progress,
    /// Set when what failed was not the scene: the disk, most likely.
    hopeless: AtomicBool,
}

impl Work<'_> {
    /// Makes one scene; `None` when it was cancelled before its end, or when there is no hope for it.
    fn scene(&self, planned: &Planned) -> Result<Option<Finished>, SimulateError> {
        let outcome = self.simulate(planned);
        if let Err(error) = &outcome {
            // Room for the others, and for the manifest.
            let _ = self.store.discard(planned.start.id);
            if !error.is_of_the_scene() {
                self.hopeless.store(true, Ordering::Relaxed);
            }
        }
        outcome.map_err(|reason| SimulateError::Scene {
            scene: self.job.scene_name(planned.start.id),
            reason: Box::new(reason),
        })
    }

    fn simulate(&self, planned: &Planned) -> Result<Option<Finished>, SimulateError> {
        if self.ends() {
            return Ok(None);
        }
        let mut simulation = self.job.start(planned)?;
        let mut recording = Recording::begin(self.store, &planned.start)?;
        let mut frames = 0;
        while let Some(frame) = simulation.next_frame()? {
            if self.ends() {
                return Ok(None);
            }
            recording.add(&frame, simulation.energy())?;
            frames += 1;
            self.progress.advance(1);
        }
        self.progress.advance(planned.most_frames - frames);
        let finished = recording.finish()?;
        self.store.deliver(&finished)?;
        Ok(Some(finished))
    }

    fn ends(&self) -> bool {
        self.progress.cancelled() || self.hopeless.load(Ordering::Relaxed)
    }
}
