//! All processes of a plan, from their start to their end.

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

use super::{LaunchError, OnExit, Plan, ProcessPlan, Said, backoff::Backoff, process::Process};
use eddy_frames::clock::Clock;

/// How often processes and the stop flag are looked at.
const INTERVAL: Duration = Duration::from_millis(20);
/// How long the last lines of processes that have ended are waited for.
const LAST_LINES: Duration = Duration::from_secs(1);
/// Lines that wait to be handed on, and that are handed on before processes are looked after again.
const LINES: usize = 1024;
/// Exit code of wrong usage, and of a process that a signal ended.
const USAGE: i32 = 2;
const INTERRUPTED: i32 = 130;

/// How a plan ended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Outcome {
    /// How often processes were started again.
    pub restarts: u32,
    /// Processes that did not end within the grace time and were killed.
    pub killed: u32,
}

/// Runs a plan's processes, each `program` with its arguments, until all have ended for good, one of them
/// asks for the end of all, or `stop` is raised; then they are asked to end one after the other, in the
/// order of the plan. Lines of the processes, with their names before them, and what happens to them go to
/// `say`.
///
/// # Errors
/// [`LaunchError`] when a process cannot be started, does not understand its arguments or fails too often;
/// all have ended by then.
pub fn supervise(
    plan: &Plan,
    program: &Path,
    stop: &AtomicBool,
    say: impl FnMut(Said),
) -> Result<Outcome, LaunchError> {
    let (sender, lines) = mpsc::sync_channel(LINES);
    let clock = Clock::start();
    let lives = plan.process.iter().map(|process| Life {
        plan: process,
        backoff: Backoff::new(plan.restart),
        state: State::Waiting { until: clock.now() },
    });
    let lives = lives.collect();
    let outcome = Outcome::default();
    let mut work = Work { plan, program, clock, lives, outcome, sender, lines, say };

    let mut end = Ok(Turn::GoOn);
    while matches!(end, Ok(Turn::GoOn)) && !stop.load(Ordering::Relaxed) {
        end = work.turn();
        work.listen(INTERVAL);
    }
    let closed = work.shut_down();
    let outcome = work.outcome;
    work.last_lines();
    end?;
    closed?;
    Ok(outcome)
}

/// Whether it is time to end.
#[derive(Clone, Copy)]
enum Turn {
    GoOn,
    End,
}

/// Where a process is in its life.
enum State {
    Waiting { until: Duration },
    Running { process: Process, since: Duration },
    Ended,
}

struct Life<'a> {
    plan: &'a ProcessPlan,
    backoff: Backoff,
    state: State,
}

struct Work<'a, F> {
    plan: &'a Plan,
    program: &'a Path,
    clock: Clock,
    lives: Vec<Life<'a>>,
    outcome: Outcome,
    sender: SyncSender<Said>,
    lines: Receiver<Said>,
    say: F,
}

impl<F: FnMut(Said)> Work<'_, F> {
    /// Starts what is due, and looks after what has ended.
    fn turn(&mut self) -> Result<Turn, LaunchError> {
        let now = self.clock.now();
        for life in &mut self.lives {
            match &mut life.state {
                State::Waiting { until } if now >= *until => {
                    let process = Process::start(self.program, self.plan, life.plan, &self.sender)?;
                    self.outcome.restarts += u32::from(life.backoff.has_failed());
                    life.state = State::Running { process, since: now };
                }
                State::Running { process, since } => {
                    let Some(status) = process.ended()? else { continue };
                    let running = now - *since;
                    life.state = State::Ended;
                    if let Some(delay) = life.again(status, running)? {
                        let (name, seconds) = (&life.plan.name, delay.as_secs_f64());
                        let text = format!("[{name}] {status}, starts again in {seconds:.1} s");
                        (self.say)(Said::Output(text));
                        life.state = State::Waiting { until: now + delay };
                    } else {
                        (self.say)(Said::Output(format!("[{}] has ended", life.plan.name)));
                        if life.plan.on_exit == OnExit::Shutdown {
                            return Ok(Turn::End);
                        }
                    }
                }
                State::Waiting { .. } | State::Ended => {}
            }
        }
        let all = self.lives.iter().all(|life| matches!(life.state, State::Ended));
        Ok(if all { Turn::End } else { Turn::GoOn })
    }

    /// Asks one process after the other to end, and kills what does not. The first that did not end well is
    /// the error.
    fn shut_down(&mut self) -> Result<(), LaunchError> {
        let mut outcome = Ok(());
        for number in 0..self.lives.len() {
            let life = &mut self.lives[number];
            let name = life.plan.name.clone();
            let State::Running { mut process, .. } =
                std::mem::replace(&mut life.state, State::Ended)
            else {
                continue;
            };
            let ended = self.end(&mut process);
            outcome = outcome.and(match ended {
                Ok(Some(status)) if ended_well(status) => Ok(()),
                Ok(Some(status)) => Err(LaunchError::Ended { name, found: status.to_string() }),
                Ok(None) => {
                    self.outcome.killed += 1;
                    let found = format!("no end within {} s", self.plan.grace);
                    process.kill().and(Err(LaunchError::Ended { name, found }))
                }
                Err(error) => Err(error),
            });
        }
        outcome
    }

    /// Asks a process to end. `None` when it does not within the grace time.
    fn end(&mut self, process: &mut Process) -> Result<Option<ExitStatus>, LaunchError> {
        process.interrupt()?;
        let end = self.clock.now() + self.plan.grace();
        loop {
            let status = process.ended()?;
            if status.is_some() || self.clock.now() >= end {
                return Ok(status);
            }
            self.listen(INTERVAL);
        }
    }

    /// Hands on the lines that are there, or the first to come within some time. `false` when no more can come.
    fn listen(&mut self, patience: Duration) -> bool {
        let mut patience = patience;
        // Not for ever: who talks all the time is looked after as well.
        for _ in 0..LINES {
            match self.lines.recv_timeout(patience) {
                Ok(line) => (self.say)(line),
                Err(RecvTimeoutError::Timeout) => return true,
                Err(RecvTimeoutError::Disconnected) => return false,
            }
            patience = Duration::ZERO;
        }
        true
    }

    /// Hands on what is still under way when all have ended.
    fn last_lines(mut self) {
        let end = self.clock.now() + LAST_LINES;
        // Without this sender the channel ends with the last process's last line.
        self.sender = mpsc::sync_channel(0).0;
        while self.clock.now() < end && self.listen(INTERVAL) {}
    }
}

/// Whether a process that was asked to end has done so, in whatever way.
fn ended_well(status: ExitStatus) -> bool {
    let by_signal = status.signal() == Some(rustix::process::Signal::INT.as_raw());
    status.success() || by_signal || status.code() == Some(INTERRUPTED)
}

impl Life<'_> {
    /// How long to wait before what has ended is started again, if it is.
    fn again(
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
