//! Simulates scenes side by side on a device, each into its own bag. While the device computes the next frames, the threads
//! write the last ones.

use std::{collections::VecDeque, thread};

use rayon::prelude::*;

use super::{
    SimulateError, manifest::Finished, plan::Planned, recording::Recording, write::Workers,
};
use eddy_frames::Frame;
use eddy_mpm::{Accelerator, Advance, Interval, MpmError, Simulation, Solver};

/// Maximum number of scenes side by side: more gain nothing.
pub const MOST_SCENES: usize = 256;
/// Finished scenes are replaced when they are more than one in this many, because all scenes are then loaded again.
const REPLACED: usize = 8;

/// Outcome of a scene.
type Outcome = Result<Finished, SimulateError>;

/// A scene on the device.
struct Running<'a> {
    planned: &'a Planned,
    simulation: Simulation,
    /// From the first frame on.
    recording: Option<Recording>,
    /// The last frame, until it is written.
    frame: Option<Frame>,
    /// Frames written.
    frames: u64,
    /// Its interval runs again, with more substeps.
    again: bool,
    /// It has finished or failed, and is on the device until others take its place.
    ended: bool,
}

/// Simulates the planned scenes; those that were cancelled have no outcome.
pub(super) fn simulate(workers: &Workers<'_>, device: &mut dyn Accelerator) -> Vec<Outcome> {
    let mut batch = Batch {
        workers,
        waiting: workers.job.planned.iter().collect(),
        running: Vec::new(),
        outcomes: Vec::new(),
    };
    match batch.run(device) {
        Ok(()) | Err(MpmError::Cancelled) => {}
        Err(reason) => batch.fail(reason),
    }
    batch.outcomes
}

/// The scenes on the device, and those that wait for it.
struct Batch<'a> {
    workers: &'a Workers<'a>,
    waiting: VecDeque<&'a Planned>,
    running: Vec<Running<'a>>,
    outcomes: Vec<Outcome>,
}

impl Batch<'_> {
    /// Runs all scenes to their ends.
    ///
    /// # Errors
    /// [`MpmError::Device`].
    fn run(&mut self, device: &mut dyn Accelerator) -> Result<(), MpmError> {
        let mut changed = true;
        while !self.workers.stops() {
            if changed || self.has_vacancies() {
                self.running.retain(|scene| !scene.ended);
                self.fill(device)?;
                if self.running.is_empty() {
                    break;
                }
                device.load(&self.solvers())?;
            }
            changed = self.interval(device)?;
        }
        Ok(())
    }

    /// Whether all scenes have ended, or enough for others to take their places.
    fn has_vacancies(&self) -> bool {
        let ended = self.running.iter().filter(|scene| scene.ended).count();
        ended == self.running.len() || ended.min(self.waiting.len()) * REPLACED > self.running.len()
    }

    /// Starts scenes until there is no room or none are left.
    fn fill(&mut self, device: &dyn Accelerator) -> Result<(), MpmError> {
        let free = MOST_SCENES.saturating_sub(self.running.len()).min(self.waiting.len());
        let next: Vec<&Planned> = self.waiting.drain(..free).collect();
        let workers = self.workers;
        let start = |planned| {
            let simulation = workers.job.start(planned)?;
            let (recording, frame) = (None, None);
            let (frames, again, ended) = (0, false, false);
            Ok(Running { planned, simulation, recording, frame, frames, again, ended })
        };
        let started: Vec<_> = next
            .into_par_iter()
            .map(|planned| start(planned).map_err(|reason| workers.failed(planned, reason)))
            .collect();
        for scene in started {
            match scene {
                Ok(scene) => self.running.push(scene),
                Err(failure) => self.outcomes.push(Err(failure)),
            }
        }
        while self.running.len() > 1 && !device.has_room(&self.solvers())? {
            self.waiting.extend(self.running.pop().map(|scene| scene.planned));
        }
        Ok(())
    }

    fn solvers(&self) -> Vec<&Solver> {
        self.running.iter().map(|scene| scene.simulation.solver()).collect()
    }

    /// Runs an interval of all scenes, while their last frames are written. Whether particles were added or removed.
    fn interval(&mut self, device: &mut dyn Accelerator) -> Result<bool, MpmError> {
        let count = |running: &[Running<'_>]| -> Vec<usize> {
            running.iter().map(|scene| scene.simulation.particles()).collect()
        };
        let before = count(&self.running);
        for scene in &mut self.running {
            scene.again = !scene.ended && !scene.has_ended();
        }
        self.run_once(device)?;
        // The scenes whose substeps were too long, while the others rest.
        while self.running.iter().any(|scene| scene.again) {
            device.load(&self.solvers())?;
            self.run_once(device)?;
        }
        Ok(count(&self.running) != before)
    }

    /// Runs an interval of the scenes that have not finished theirs.
    fn run_once(&mut self, device: &mut dyn Accelerator) -> Result<(), MpmError> {
        let workers = self.workers;
        let rest = Interval { substeps: 0, dt: 1.0, attractor: None, motions: Vec::new() };
        let next = |scene: &Running<'_>| {
            scene.simulation.next_interval().filter(|_| scene.again).unwrap_or_else(|| rest.clone())
        };
        let intervals: Vec<Interval> = self.running.iter().map(next).collect();
        let (computed, written) = thread::scope(|scope| {
            let (device, intervals) = (&mut *device, &intervals);
            let computed = scope.spawn(move || device.run(intervals, &|| workers.stops()));
            let write = |scene: &mut Running<'_>| scene.write(workers);
            let written: Vec<_> = self.running.par_iter_mut().map(write).collect();
            let computed = computed.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic));
            (computed, written)
        });
        self.take(written);
        let computed = computed?;
        let mut solvers: Vec<&mut Solver> =
            self.running.iter_mut().map(|scene| scene.simulation.solver_mut()).collect();
        device.fetch(&mut solvers);
        let finished: Vec<_> = self
            .running
            .par_iter_mut()
            .zip(intervals.into_par_iter().zip(computed))
            .map(|(scene, (interval, lost))| scene.finish_interval(workers, &interval, lost))
            .collect();
        self.take(finished);
        Ok(())
    }

    /// Keeps the outcomes of scenes that have ended.
    fn take(&mut self, outcomes: Vec<Option<Outcome>>) {
        for (scene, outcome) in self.running.iter_mut().zip(outcomes) {
            scene.ended |= outcome.is_some();
            self.outcomes.extend(outcome);
        }
    }

    /// Ends a scene with the failure of the device; the others would fail for the same reason.
    fn fail(&mut self, reason: MpmError) {
        let running = self.running.iter().filter(|scene| !scene.ended).map(|scene| scene.planned);
        if let Some(planned) = running.chain(self.waiting.iter().copied()).next() {
            self.outcomes.push(Err(self.workers.failed(planned, reason.into())));
        }
    }
}

impl Running<'_> {
    /// Writes the last frame, if there is one; the outcome if it was the last of the scene.
    fn write(&mut self, workers: &Workers<'_>) -> Option<Outcome> {
        let frame = self.frame.take()?;
        self.record(&frame, workers)
            .map_err(|reason| workers.failed(self.planned, reason))
            .transpose()
    }

    fn record(
        &mut self,
        frame: &Frame,
        workers: &Workers<'_>,
    ) -> Result<Option<Finished>, SimulateError> {
        let mut recording = self.recording(workers)?;
        recording.add(frame, &self.simulation)?;
        self.frames += 1;
        workers.progress.advance(1);
        self.recording = Some(recording);
        self.has_ended().then(|| self.finish(workers)).transpose()
    }

    /// Goes on when the device has run this interval; the outcome if the scene has failed, or ends without a further frame.
    fn finish_interval(
        &mut self,
        workers: &Workers<'_>,
        interval: &Interval,
        lost: Result<(), usize>,
    ) -> Option<Outcome> {
        if !std::mem::take(&mut self.again) || self.ended {
            return None;
        }
        let outcome = self.simulation.solver().outcome(interval, lost);
        match self.simulation.finish_interval(outcome) {
            Ok(Advance::Frame(frame)) => self.frame = Some(frame),
            Ok(Advance::None) => {}
            Ok(Advance::Again) => self.again = true,
            Err(reason) => {
                let reason = self.simulation.with_enough_substeps(reason, &|| workers.stops());
                return Some(Err(workers.failed(self.planned, reason.into())));
            }
        }
        let is_empty = self.frame.is_none() && self.has_ended();
        is_empty
            .then(|| self.finish(workers).map_err(|reason| workers.failed(self.planned, reason)))
    }

    /// Whether the simulation has ended.
    fn has_ended(&self) -> bool {
        self.simulation.next_interval().is_none()
    }

    /// The scene's bag, created for the first frame.
    fn recording(&mut self, workers: &Workers<'_>) -> Result<Recording, SimulateError> {
        match self.recording.take() {
            Some(recording) => Ok(recording),
            None => Recording::begin(workers.store, &self.planned.start),
        }
    }

    /// Finishes the scene's bag.
    fn finish(&mut self, workers: &Workers<'_>) -> Outcome {
        workers.progress.advance(self.planned.most_frames - self.frames);
        let finished = self.recording(workers)?.finish(&self.simulation)?;
        workers.store.deliver(&finished)?;
        Ok(finished)
    }
}
