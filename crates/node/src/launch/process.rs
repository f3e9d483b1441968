//! One process and its output.
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

/// Longest line (bytes), after which it is split: bounds the memory for output without line ends.
const MAX_LINE: u64 = 1 << 16;

/// Time for a process to end after SIGINT when it is dropped.
const DROP_TIMEOUT: Duration = Duration::from_secs(2);
/// Interval between checks whether it has ended.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// A line of output, with the name of its process as prefix.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum OutputLine {
    /// From standard output, or from the supervisor.
    Stdout(String),
    /// From standard error.
    Stderr(String),
}

/// A running process.
pub(super) struct Process {
    name: String,
    child: Child,
}

impl Process {
    /// Starts `program` with the arguments of `process` and sends its lines to `lines`.
    pub(super) fn start(
        program: &Path,
        plan: &Plan,
        process: &ProcessPlan,
        lines: &SyncSender<OutputLine>,
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
        // SAFETY: between fork and exec only one system call is made, and nothing is allocated.
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
            forward(&name, output, OutputLine::Stdout, lines.clone());
        }
        if let Some(errors) = child.stderr.take() {
            forward(&name, errors, OutputLine::Stderr, lines.clone());
        }
        Ok(Self { name, child })
    }

    /// The exit status, if it has ended.
    pub(super) fn exit_status(&mut self) -> Result<Option<ExitStatus>, LaunchError> {
        self.child.try_wait().map_err(|reason| self.error("wait", reason))
    }

    /// Sends SIGINT.
    pub(super) fn interrupt(&self) -> Result<(), LaunchError> {
        let Some(id) = i32::try_from(self.child.id()).ok().and_then(Pid::from_raw) else {
            return Ok(());
        };
        // The process has not been waited for, so that its id cannot have been reused.
        kill_process(id, Signal::INT).map_err(|reason| self.error("interrupt", reason.into()))
    }

    /// Sends SIGKILL.
    pub(super) fn kill(&mut self) -> Result<(), LaunchError> {
        self.child.kill().map_err(|reason| self.error("kill", reason))
    }

    fn error(&self, action: &'static str, reason: io::Error) -> LaunchError {
        LaunchError::System { name: self.name.clone(), action, reason }
    }
}

impl Drop for Process {
    /// No process outlives the supervisor, however that ends.
    fn drop(&mut self) {
        // Each of these fails if the process has already ended.
        let clock = Clock::start();
        let _ = self.interrupt();
        while clock.now() < DROP_TIMEOUT && matches!(self.child.try_wait(), Ok(None)) {
            thread::sleep(POLL_INTERVAL);
        }
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Forwards lines until either end is closed.
fn forward(
    name: &str,
    from: impl Read + Send + 'static,
    line_of: fn(String) -> OutputLine,
    lines: SyncSender<OutputLine>,
) {
    let prefix = format!("[{name}] ");
    thread::spawn(move || {
        let mut from = BufReader::new(from);
        let mut line = Vec::new();
        loop {
            line.clear();
            match from.by_ref().take(MAX_LINE).read_until(b'\n', &mut line) {
                Ok(0) | Err(_) => return,
                Ok(_) => {
                    let text = String::from_utf8_lossy(&line);
                    if lines.send(line_of(format!("{prefix}{}", text.trim_end()))).is_err() {
                        return;
                    }
                }
            }
        }
    });
}
