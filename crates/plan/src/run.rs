//! Runs one task, some, or all of them.

use std::{
    num::NonZeroUsize,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    thread,
    time::Duration,
};

use eddy_frames::{clock::Clock, progress::Progress};

use super::{Job, OpenPlan, PlanError, TaskState, state::Sharing};

/// Missing inputs that an error names.
const MOST_NAMED: usize = 3;
/// Interval between checks of signals by threads without a task.
const POLL_INTERVAL: Duration = Duration::from_millis(50);

/// How a run of a task has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It is done, with a message.
    Done(String),
    /// It was done before.
    AlreadyDone,
    /// It was cancelled.
    Cancelled,
}

impl<J: Job> OpenPlan<J> {
    /// Runs a task, unless it is done.
    ///
    /// # Errors
    /// [`PlanError::PlanBusy`], [`PlanError::Busy`] when another process runs it, [`PlanError::Inputs`] when it cannot
    /// start yet, [`PlanError::Task`] when it has failed.
    pub fn run_task(&self, number: usize, progress: &dyn Progress) -> Result<Outcome, PlanError> {
        let _plan = self.lock(Sharing::Shared)?;
        self.run_in_locked_plan(number, progress)
    }

    /// Runs tasks one after the other, unless they are done.
    ///
    /// # Errors
    /// As [`OpenPlan::run_task`]; [`PlanError::Interrupted`].
    pub fn run_tasks(&self, numbers: &[usize], progress: &dyn Progress) -> Result<(), PlanError> {
        for (done, &number) in numbers.iter().enumerate() {
            match self.run_task(number, progress)? {
                Outcome::Cancelled => {
                    return Err(PlanError::Interrupted { done, tasks: numbers.len() });
                }
                outcome => progress.message(&self.sentence(number, &outcome)),
            }
        }
        Ok(())
    }

    /// Runs all tasks that are not done, `jobs` in parallel. After a failure, those that do not need its outputs are still
    /// run.
    ///
    /// # Errors
    /// [`PlanError::PlanBusy`] when other processes run tasks of this plan; [`PlanError::Failed`],
    /// [`PlanError::Interrupted`].
    pub fn run_all(&self, jobs: NonZeroUsize, progress: &dyn Progress) -> Result<(), PlanError> {
        let _plan = self.lock(Sharing::Exclusive)?;
        let tasks = self.plan.tasks.len();
        let mut stages = Vec::new();
        for number in 0..tasks {
            stages.push(if self.is_done(number)? { Stage::Done } else { Stage::Waiting });
        }
        let waiting = stages.iter().filter(|stage| **stage == Stage::Waiting).count();
        if waiting < tasks {
            progress.message(&format!("{} of {tasks} tasks are already done", tasks - waiting));
        }
        let board = Board { stages: Mutex::new(stages), changed: Condvar::new() };
        let failures = Mutex::new(Vec::new());
        progress.begin(waiting as u64, "tasks");
        let quiet = Cancellation(progress);
        let worker = || {
            while let Some(number) = board.next(&self.before, progress) {
                let outcome = self.run_in_locked_plan(number, &quiet);
                let stage = match &outcome {
                    Ok(Outcome::Cancelled) => Stage::Waiting,
                    Ok(_) => Stage::Done,
                    Err(_) => Stage::Failed,
                };
                match outcome {
                    Ok(Outcome::Cancelled) => {}
                    Ok(outcome) => {
                        progress.message(&self.sentence(number, &outcome));
                        progress.advance(1);
                    }
                    Err(failure) => {
                        failures.lock().unwrap_or_else(PoisonError::into_inner).push(failure);
                    }
                }
                board.set(number, stage);
            }
        };
        thread::scope(|scope| {
            for _ in 0..jobs.get().min(waiting) {
                scope.spawn(worker);
            }
        });
        progress.finish();
        let done = board.stages().iter().filter(|stage| **stage == Stage::Done).count();
        let failures = failures.into_inner().unwrap_or_else(PoisonError::into_inner);
        if !failures.is_empty() {
            return Err(PlanError::Failed { failures, done, tasks });
        }
        if done < tasks {
            return Err(PlanError::Interrupted { done, tasks });
        }
        Ok(())
    }

    /// The states of all tasks.
    ///
    /// # Errors
    /// [`PlanError::Io`], [`PlanError::State`] when a file beside the plan cannot be read.
    pub fn states(&self) -> Result<Vec<TaskState>, PlanError> {
        let mut states: Vec<TaskState> = Vec::new();
        for (number, task) in self.plan.tasks.iter().enumerate() {
            let record = self.state.record(&task.name)?;
            let is_ready = self.missing_inputs(number).is_empty();
            let state = match (self.state.holder(&task.name)?, record) {
                (Some(holder), _) => TaskState::Running { holder },
                (None, Some(record)) if record.reason.is_none() && self.has_outputs(number) => {
                    TaskState::Done { host: record.host, seconds: record.seconds }
                }
                (None, Some(record)) if record.reason.is_some() => TaskState::Failed {
                    failures: record.failures,
                    reason: record.reason.unwrap_or_default(),
                },
                _ if is_ready => TaskState::Ready,
                _ => TaskState::Waiting,
            };
            states.push(state);
        }
        Ok(states)
    }

    fn lock(&self, sharing: Sharing) -> Result<super::state::Lock, PlanError> {
        let busy = |holder| PlanError::PlanBusy { file: self.file.clone(), holder };
        self.state.lock_plan(sharing)?.map_err(busy)
    }

    fn run_in_locked_plan(
        &self,
        number: usize,
        progress: &dyn Progress,
    ) -> Result<Outcome, PlanError> {
        let task = &self.plan.tasks[number];
        let label = || self.label(number);
        let busy = |holder| PlanError::Busy { task: label(), holder };
        let _lock = self.state.lock_task(&task.name)?.map_err(busy)?;
        if self.is_done(number)? {
            return Ok(Outcome::AlreadyDone);
        }
        let missing = self.missing_inputs(number);
        if !missing.is_empty() {
            return Err(PlanError::Inputs { task: label(), missing });
        }
        let clock = Clock::start();
        let outcome = self.plan.job.run(&task.work, progress);
        let seconds = clock.now().as_secs_f64();
        let failures = self.state.record(&task.name)?.map_or(0, |record| record.failures);
        let message = match outcome {
            Ok(Some(message)) => message,
            Ok(None) => return Ok(Outcome::Cancelled),
            Err(reason) => {
                let text = format!("{reason:#}");
                // The reason of the failure says more than that of a state that cannot be written.
                if let Err(error) = self.state.write(&task.name, seconds, failures + 1, Some(text))
                {
                    tracing::warn!("{error}");
                }
                return Err(PlanError::Task { task: label(), reason });
            }
        };
        if let Some(missing) = task.outputs.iter().find(|output| !output.exists()) {
            return Err(PlanError::Outputs { task: label(), missing: missing.clone() });
        }
        self.state.write(&task.name, seconds, failures, None)?;
        Ok(Outcome::Done(message))
    }

    fn is_done(&self, number: usize) -> Result<bool, PlanError> {
        let record = self.state.record(&self.plan.tasks[number].name)?;
        Ok(record.is_some_and(|record| record.reason.is_none()) && self.has_outputs(number))
    }

    fn has_outputs(&self, number: usize) -> bool {
        self.plan.tasks[number].outputs.iter().all(|output| output.exists())
    }

    /// The inputs that do not exist, with the tasks that write them.
    fn missing_inputs(&self, number: usize) -> Vec<String> {
        let missing = self.plan.tasks[number].inputs.iter().filter(|input| !input.exists());
        let mut lines = Vec::new();
        let mut more = 0;
        for input in missing {
            if lines.len() == MOST_NAMED {
                more += 1;
                continue;
            }
            let tasks = &self.plan.tasks;
            let writes = |&&before: &&usize| tasks[before].outputs.contains(input);
            lines.push(match self.before[number].iter().find(writes) {
                Some(&before) => {
                    format!("{}, the output of {}", input.display(), self.label(before))
                }
                None => format!("{}, which no task of this plan writes", input.display()),
            });
        }
        if more > 0 {
            lines.push(format!("{more} more"));
        }
        lines
    }

    fn sentence(&self, number: usize, outcome: &Outcome) -> String {
        let label = self.label(number);
        match outcome {
            Outcome::Done(message) => format!("{label}: {message}"),
            Outcome::AlreadyDone => format!("{label}: is already done"),
            Outcome::Cancelled => format!("{label}: was cancelled"),
        }
    }
}

/// Several tasks at once share one progress bar, which counts tasks: each only learns whether to stop.
struct Cancellation<'a>(&'a dyn Progress);

impl Progress for Cancellation<'_> {
    fn cancelled(&self) -> bool {
        self.0.cancelled()
    }
}

/// How far a task is in this run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Waiting,
    Running,
    Done,
    Failed,
}

/// The tasks of a run, shared by its threads.
struct Board {
    stages: Mutex<Vec<Stage>>,
    changed: Condvar,
}

impl Board {
    fn stages(&self) -> MutexGuard<'_, Vec<Stage>> {
        self.stages.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The next task that can be run, once there is one; `None` when there will be none, or all should stop.
    fn next(&self, before: &[Vec<usize>], progress: &dyn Progress) -> Option<usize> {
        let mut stages = self.stages();
        loop {
            if progress.cancelled() {
                return None;
            }
            let is_ready = |&number: &usize| {
                let done = |&before: &usize| stages[before] == Stage::Done;
                stages[number] == Stage::Waiting && before[number].iter().all(done)
            };
            if let Some(number) = (0..stages.len()).find(is_ready) {
                stages[number] = Stage::Running;
                return Some(number);
            }
            if !stages.contains(&Stage::Running) {
                return None;
            }
            let waited = self.changed.wait_timeout(stages, POLL_INTERVAL);
            stages = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
    }

    fn set(&self, number: usize, stage: Stage) {
        self.stages()[number] = stage;
        self.changed.notify_all();
    }
}
