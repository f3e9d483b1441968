//! One process: its start, its lines, its end.
#![expect(unsafe_code, reason = "sets the parent-death signal between fork and exec")]

use std::{
    io::{self, BufRead, BufReader, Read},
    os::unix::process::CommandExt as _,
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    sync::mpsc::SyncSender,
    thread,
    time::Duration,
};

use rustix::process::{Pid, Signal, kill_process};

use super::{LaunchError, Plan, ProcessPlan};
use eddy_frames::clock::Clock;

/// Bytes of a line after which it is cut, so that a process without line ends fills no memory.
const LONGEST_LINE: u64 = 1 << 16;

/// How long a process that is dropped has to end after it was asked to.
const LAST_PATIENCE: Duration = Duration::from_secs(2);
/// Between two looks whether it has.
const NAP: Duration = Duration::from_millis(20);

/// A line, with the name of its process before it, and where it was said.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Said {
    /// On standard output, or by the supervision.
    Output(String),
    /// On standard error.
    Error(String),
}

/// A process under way.
pub(super) struct Process {
    name: String,
    child: Child,
}

impl Process {
    /// Starts `program` with the arguments of the plan's process; its lines, with the name before them, go to
    /// `lines`.
    pub(super) fn start(
        program: &Path,
        plan: &Plan,
        process: &ProcessPlan,
        lines: &SyncSender<Said>,
    ) -> Result<Self, LaunchError> {
        let mut command = Command::new(program);
        command
            .args(&process.run)
            .envs(plan.environment.iter().chain(&process.environment))
            .stdin(Stdio::null())
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .process_group(0);
        #[cfg(target_os = "linux")]
        // SAFETY: between fork and exec only one system call is made, which allocates nothing.
        unsafe {
            command.pre_exec(|| {
                let with_parent = Some(Signal::INT);
                Ok(rustix::process::set_parent_process_death_signal(with_parent)?)
            });
        }
        let name = process.name.clone();
        let mut child = command.spawn().map_err(|reason| LaunchError::System {
            name: name.clone(),
            action: "start",
            reason,
        })?;
        if let Some(output) = child.stdout.take() {
            forward(&name, output, Said::Output, lines.clone());
        }
        if let Some(errors) = child.stderr.take() {
            forward(&name, errors, Said::Error, lines.clone());
        }
        Ok(Self { name, child })
    }

    /// How it ended, if it has.
    pub(super) fn ended(&mut self) -> Result<Option<ExitStatus>, LaunchError> {
        self.child.try_wait().map_err(|reason| self.error("wait for it", reason))
    }

    /// Asks it to end.
    pub(super) fn interrupt(&self) -> Result<(), LaunchError> {
        let Some(id) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) else {
            return Ok(());
        };
        // It has not been waited for, so the number is still its own.
        kill_process(id, Signal::INT).map_err(|reason| self.error("interrupt it", reason.into()))
    }

    /// Ends it without asking.
    pub(super) fn kill(&mut self) -> Result<(), LaunchError> {
        self.child.kill().map_err(|reason| self.error("kill it", reason))
    }

    fn error(&self, action: &'static str, reason: io::Error) -> LaunchError {
        LaunchError::System { name: self.name.clone(), action, reason }
    }
}

impl Drop for Process {
    /// Nothing outlives the supervision, whatever ends it.
    fn drop(&mut self) {
        // All of these fail where it has ended before.
        let clock = Clock::start();
        let _ = self.interrupt();
        while clock.now() < LAST_PATIENCE && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(NAP);
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Hands on lines until the process closes its end or nobody listens.
fn forward(
    name: &str,
    from: impl Read + Send + 'static,
    said: fn(String) -> Said,
    lines: SyncSender<Said>,
) {
    let prefix = format!("[{name}] ");
    thread::spawn(move || {
        let mut from = BufReader::new(from);
        let mut line = Vec::new();
        loop {
            line.clear();
            match from.by_ref().take(LONGEST_LINE).read_until(b'\n', &mut line) {
                Ok(0) | Err(_) => return,
                Ok(_) => {
                    let text = String::from_utf8_lossy(&line);
                    if lines.send(said(format!("{prefix}{}", text.trim_end()))).is_err() {
                        return;
                    }
                }
            }
        }
    });
}
