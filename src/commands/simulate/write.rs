//! Scenes in parallel, each into a bag of its own.

use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::{Context, bail};
use indicatif::ProgressBar;
use rayon::prelude::*;

use super::{
    Job,
    manifest::Finished,
    plan::Planned,
    recording::{Archive, Recording, disk_is_full},
};
use crate::commands::{Interrupt, progress_bar};
use eddy::mpm::MpmError;

/// Makes the planned scenes. One that fails stops the others only where they would fail too.
pub(super) fn run(
    job: &Job,
    planned: &[Planned],
    archive: &Archive,
    present: usize,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    if planned.is_empty() {
        return Ok(());
    }
    let frames = planned.iter().map(|scene| scene.most_frames).sum();
    let bar = progress_bar(frames, "frames", quiet);
    let work = Work { job, archive, bar, interrupt, hopeless: AtomicBool::new(false) };
    let outcomes: Vec<anyhow::Result<Option<Finished>>> =
        planned.par_iter().with_max_len(1).map(|scene| work.scene(scene)).collect();
    work.bar.finish_and_clear();
    report(&outcomes, job, archive, present)?;
    if interrupt.requested() {
        let whole = present + finished(&outcomes).count();
        bail!(
            "interrupted: {whole} of {} scenes are finished; the same command makes the others",
            job.scenes
        );
    }
    Ok(())
}

fn finished(outcomes: &[anyhow::Result<Option<Finished>>]) -> impl Iterator<Item = &Finished> {
    outcomes.iter().flatten().flatten()
}

/// Says what is there now; an error with the reason of each scene that failed.
fn report(
    outcomes: &[anyhow::Result<Option<Finished>>],
    job: &Job,
    archive: &Archive,
    present: usize,
) -> anyhow::Result<()> {
    let frames: u64 = finished(outcomes).map(|scene| scene.frames).sum();
    let made = finished(outcomes).count();
    let plural = if made == 1 { "" } else { "s" };
    println!("{made} scene{plural}, {frames} frames: {}", archive.output().display());
    let failures: Vec<&anyhow::Error> =
        outcomes.iter().filter_map(|outcome| outcome.as_ref().err()).collect();
    if failures.is_empty() {
        return Ok(());
    }
    let mut message = String::new();
    for failure in &failures {
        message += &format!("{failure:#}\n");
    }
    let whole = present + made;
    message += &format!("{whole} of {} scenes are finished and kept", job.scenes);
    if failures.iter().any(|failure| disk_is_full(failure)) {
        message += "; no room is left: make some, and the same command makes the others";
    } else if !failures.iter().all(|failure| failure.is::<MpmError>()) {
        message += "; the same command makes the others";
    }
    bail!(message);
}

/// What the threads share.
struct Work<'a> {
    job: &'a Job,
    archive: &'a Archive,
    bar: ProgressBar,
    interrupt: &'a Interrupt,
    /// Set when what failed was not the scene: the disk, most likely.
    hopeless: AtomicBool,
}

impl Work<'_> {
    /// Makes one scene; `None` when a signal came before its end, or when there is no hope for it.
    fn scene(&self, planned: &Planned) -> anyhow::Result<Option<Finished>> {
        let outcome = self.simulate(planned);
        if let Err(error) = &outcome {
            // Room for the others, and for the manifest.
            let _ = self.archive.discard(planned.start.id);
            if !error.is::<MpmError>() {
                self.hopeless.store(true, Ordering::Relaxed);
            }
        }
        outcome.with_context(|| self.job.name(planned.start.id))
    }

    fn simulate(&self, planned: &Planned) -> anyhow::Result<Option<Finished>> {
        if self.ends() {
            return Ok(None);
        }
        let mut simulation = self.job.start(planned)?;
        let mut recording = Recording::begin(self.archive, &planned.start)?;
        let mut frames = 0;
        while let Some(frame) = simulation.next_frame()? {
            if self.ends() {
                return Ok(None);
            }
            recording.add(&frame, simulation.energy())?;
            frames += 1;
            self.bar.inc(1);
        }
        self.bar.inc(planned.most_frames - frames);
        let finished = recording.finish()?;
        self.archive.deliver(&finished)?;
        Ok(Some(finished))
    }

    fn ends(&self) -> bool {
        self.interrupt.requested() || self.hopeless.load(Ordering::Relaxed)
    }
}
