//! Simulates scenes in parallel, each into its own bag.

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
    side_by_side,
};
use eddy_frames::{counted, progress::Progress};
use eddy_mpm::{Accelerator, MpmError};

/// Outcome of a request.
#[derive(Debug)]
pub struct Summary {
    /// Scenes simulated in this run.
    pub finished: Vec<Finished>,
    /// Scenes of earlier runs.
    pub present: usize,
    /// Requested scenes.
    pub scenes: u32,
    /// The output directory.
    output: PathBuf,
    /// Scenes that failed.
    failures: Vec<SimulateError>,
    /// Whether the run was cancelled.
    cancelled: bool,
}

impl Summary {
    /// Frames written in this run.
    pub fn frames(&self) -> u64 {
        self.finished.iter().map(|scene| scene.frames).sum()
    }

    /// Checks that all scenes are finished.
    ///
    /// # Errors
    /// [`SimulateError::Failed`] with the reason of each failed scene, else [`SimulateError::Cancelled`].
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

/// The scenes and frames written in this run, and their directory.
impl fmt::Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let scenes = counted(self.finished.len() as u64, "scene");
        let frames = counted(self.frames(), "frame");
        write!(f, "{scenes}, {frames}: {}", self.output.display())
    }
}

/// Simulates the planned scenes, on a device if there is one. A failure stops the others only if they would fail for the same
/// reason.
pub(super) fn write(
    job: &Job,
    store: &Store,
    progress: &dyn Progress,
    device: Option<&mut dyn Accelerator>,
) -> Summary {
    let (present, scenes) = (job.present(), job.scenes());
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
    let workers = Workers { job, store, progress, aborted: AtomicBool::new(false) };
    let outcomes: Vec<Result<Option<Finished>, SimulateError>> = match device {
        Some(device) => {
            side_by_side::simulate(&workers, device).into_iter().map(|one| one.map(Some)).collect()
        }
        None => job.planned.par_iter().with_max_len(1).map(|scene| workers.scene(scene)).collect(),
    };
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

/// Shared by the threads.
pub(super) struct Workers<'a> {
    pub(super) job: &'a Job,
    pub(super) store: &'a Store,
    pub(super) progress: &'a dyn Progress,
    /// Set when a failure was not due to its scene, but to the disk, for example.
    aborted: AtomicBool,
}

impl Workers<'_> {
    /// Simulates one scene; `None` when it was cancelled or aborted.
    fn scene(&self, planned: &Planned) -> Result<Option<Finished>, SimulateError> {
        self.simulate(planned).map_err(|reason| self.failed(planned, reason))
    }

    /// Removes what a failed scene has written, and names the scene.
    pub(super) fn failed(&self, planned: &Planned, reason: SimulateError) -> SimulateError {
        // Frees space for the other scenes and the manifest.
        let _ = self.store.discard(planned.start.id);
        if !reason.is_of_the_scene() {
            self.aborted.store(true, Ordering::Relaxed);
        }
        let scene = self.job.scene_name(planned.start.id);
        SimulateError::Scene { scene, reason: Box::new(reason) }
    }

    fn simulate(&self, planned: &Planned) -> Result<Option<Finished>, SimulateError> {
        if self.stops() {
            return Ok(None);
        }
        let mut simulation = self.job.start(planned)?;
        let mut recording = Recording::begin(self.store, &planned.start)?;
        let mut frames = 0;
        let stops = || self.stops();
        loop {
            let frame = match simulation.next_frame_unless(&stops) {
                Err(MpmError::Cancelled) => return Ok(None),
                frame => frame?,
            };
            let Some(frame) = frame else { break };
            recording.add(&frame, &simulation)?;
            frames += 1;
            self.progress.advance(1);
        }
        self.progress.advance(planned.most_frames - frames);
        let finished = recording.finish(&simulation)?;
        self.store.deliver(&finished)?;
        Ok(Some(finished))
    }

    /// Whether no further frames are wanted.
    pub(super) fn stops(&self) -> bool {
        self.progress.cancelled() || self.aborted.load(Ordering::Relaxed)
    }
}
