//! All processes of a plan, from start to shutdown.

use std::{
    os::unix::process::ExitStatusExt as _,
    path::Path,
    process::ExitStatus,
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc::{self, Receiver, RecvTimeoutError, SyncSender},
    },
    time::Duration,
};

use super::{
    LaunchError, OnExit, OutputLine, Plan, ProcessPlan, backoff::Backoff, process::Process,
};
use eddy_frames::clock::Clock;

/// Interval between checks of processes and the stop flag.
const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// How long to wait for the last lines of processes that have ended.
const LAST_LINES_TIMEOUT: Duration = Duration::from_secs(1);
/// Capacity of the queue of lines, and number of lines forwarded between two checks of the processes.
const MAX_LINES: usize = 1024;
/// Exit code of wrong usage.
const USAGE: i32 = 2;
/// Exit code of an eddy process that was interrupted twice.
const INTERRUPTED: i32 = 130;

/// Counts of a launch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LaunchSummary {
    /// Number of restarts.
    pub restarts: u32,
    /// Processes that did not shut down within the grace time and were killed.
    pub killed: u32,
}

/// Runs the processes of a plan, each `program` with its arguments, until all have ended for good, one with
/// `on_exit = "shutdown"` has ended, or `stop` is raised. Then shuts them down one after the other, in the order of the
/// plan. Passes output lines and state changes to `print`.
///
/// # Errors
/// [`LaunchError`] when a process cannot be started, rejects its arguments, fails too often or does not shut down. All
/// processes have ended when this returns.
pub fn supervise(
    plan: &Plan,
    program: &Path,
    stop: &AtomicBool,
    print: impl FnMut(OutputLine),
) -> Result<LaunchSummary, LaunchError> {
    let (sender, lines) = mpsc::sync_channel(MAX_LINES);
    let clock = Clock::start();
    let processes = plan.process.iter().map(|process| Supervised {
        plan: process,
        backoff: Backoff::new(plan.restart),
        state: ProcessState::Waiting { until: clock.now() },
    });
    let processes = processes.collect();
    let summary = LaunchSummary::default();
    let mut supervisor =
        Supervisor { plan, program, clock, processes, summary, sender, lines, print };

    let mut running = Ok(true);
    while matches!(running, Ok(true)) && !stop.load(Ordering::Relaxed) {
        running = supervisor.check();
        supervisor.forward_lines(POLL_INTERVAL);
    }
    let shut_down = supervisor.shut_down();
    let summary = supervisor.summary;
    supervisor.forward_last_lines();
    running?;
    shut_down?;
    Ok(summary)
}

enum ProcessState {
    Waiting { until: Duration },
    Running { process: Process, since: Duration },
    Ended,
}

struct Supervised<'a> {
    plan: &'a ProcessPlan,
    backoff: Backoff,
    state: ProcessState,
}

struct Supervisor<'a, F> {
    plan: &'a Plan,
    program: &'a Path,
    clock: Clock,
    processes: Vec<Supervised<'a>>,
    summary: LaunchSummary,
    sender: SyncSender<OutputLine>,
    lines: Receiver<OutputLine>,
    print: F,
}

impl<F: FnMut(OutputLine)> Supervisor<'_, F> {
    /// Starts processes that are due and handles those that have ended. Returns whether to keep running.
    fn check(&mut self) -> Result<bool, LaunchError> {
        let now = self.clock.now();
        for supervised in &mut self.processes {
            match &mut supervised.state {
                ProcessState::Waiting { until } if now >= *until => {
                    let process =
                        Process::start(self.program, self.plan, supervised.plan, &self.sender)?;
                    self.summary.restarts += u32::from(supervised.backoff.has_failed());
                    supervised.state = ProcessState::Running { process, since: now };
                }
                ProcessState::Running { process, since } => {
                    let Some(status) = process.exit_status()? else { continue };
                    let running = now - *since;
                    supervised.state = ProcessState::Ended;
                    if let Some(delay) = supervised.restart_delay(status, running)? {
                        let (name, seconds) = (&supervised.plan.name, delay.as_secs_f64());
                        let text = format!("[{name}] {status}, restarting in {seconds:.1} s");
                        (self.print)(OutputLine::Stdout(text));
                        supervised.state = ProcessState::Waiting { until: now + delay };
                    } else {
                        (self.print)(OutputLine::Stdout(format!(
                            "[{}] has ended",
                            supervised.plan.name
                        )));
                        if supervised.plan.on_exit == OnExit::Shutdown {
                            return Ok(false);
                        }
                    }
                }
                ProcessState::Waiting { .. } | ProcessState::Ended => {}
            }
        }
        let has_ended = |one: &Supervised<'_>| matches!(one.state, ProcessState::Ended);
        Ok(!self.processes.iter().all(has_ended))
    }

    /// Interrupts one process after the other and kills those that do not end. Returns the first failure.
    fn shut_down(&mut self) -> Result<(), LaunchError> {
        let mut outcome = Ok(());
        for number in 0..self.processes.len() {
            let supervised = &mut self.processes[number];
            let name = supervised.plan.name.clone();
            let ProcessState::Running { mut process, .. } =
                std::mem::replace(&mut supervised.state, ProcessState::Ended)
            else {
                continue;
            };
            let ended = self.interrupt(&mut process);
            outcome = outcome.and(match ended {
                Ok(Some(status)) if was_shut_down(status) => Ok(()),
                Ok(Some(status)) => Err(LaunchError::Ended { name, found: status.to_string() }),
                Ok(None) => {
                    self.summary.killed += 1;
                    let found = format!("still running {} s after SIGINT", self.plan.grace);
                    process.kill().and(Err(LaunchError::Ended { name, found }))
                }
                Err(error) => Err(error),
            });
        }
        outcome
    }

    /// Interrupts a process. `None` when it does not end within the grace time.
    fn interrupt(&mut self, process: &mut Process) -> Result<Option<ExitStatus>, LaunchError> {
        process.interrupt()?;
        let end = self.clock.now() + self.plan.grace();
        loop {
            let status = process.exit_status()?;
            if status.is_some() || self.clock.now() >= end {
                return Ok(status);
            }
            self.forward_lines(POLL_INTERVAL);
        }
    }

    /// Forwards waiting lines, or the first to arrive within `timeout`. Returns `false` when no more can arrive.
    fn forward_lines(&mut self, timeout: Duration) -> bool {
        let mut timeout = timeout;
        // Bounded: processes that print all the time are checked as well.
        for _ in 0..MAX_LINES {
            match self.lines.recv_timeout(timeout) {
                Ok(line) => (self.print)(line),
                Err(RecvTimeoutError::Timeout) => return true,
                Err(RecvTimeoutError::Disconnected) => return false,
            }
            timeout = Duration::ZERO;
        }
        true
    }

    /// Forwards the remaining lines after all processes have ended.
    fn forward_last_lines(mut self) {
        let end = self.clock.now() + LAST_LINES_TIMEOUT;
        // Without this sender the channel ends with the last line of the last process.
        self.sender = mpsc::sync_channel(0).0;
        while self.clock.now() < end && self.forward_lines(POLL_INTERVAL) {}
    }
}

/// Whether a process ended as asked to by SIGINT.
fn was_shut_down(status: ExitStatus) -> bool {
    let by_signal = status.signal() == Some(rustix::process::Signal::INT.as_raw());
    status.success() || by_signal || status.code() == Some(INTERRUPTED)
}

impl Supervised<'_> {
    /// Delay before the restart of a process that has ended; `None` if it is not restarted.
    fn restart_delay(
        &mut self,
        status: ExitStatus,
        running: Duration,
    ) -> Result<Option<Duration>, LaunchError> {
        let name = || self.plan.name.clone();
        if status.success() {
            return Ok(None);
        }
        if status.code() == Some(USAGE) {
            return Err(LaunchError::Usage { name: name() });
        }
        let failed = |limit| LaunchError::Failed { name: name(), found: status.to_string(), limit };
        if !self.plan.restart {
            return Err(LaunchError::Ended { name: name(), found: status.to_string() });
        }
        let limit = self.backoff.limit();
        self.backoff.failed(running).map(Some).ok_or_else(|| failed(limit))
    }
}
