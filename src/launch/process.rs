//! One process: its start, its lines, its end.

use std::{
    io::{self, BufRead, BufReader, Read},
    os::unix::process::CommandExt as _,
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    sync::mpsc::Sender,
    thread,
};

use rustix::process::{Pid, Signal, kill_process};

use super::{LaunchError, Plan, ProcessPlan};

/// Bytes of a line after which it is cut, so that a process without line ends fills no memory.
const LONGEST_LINE: u64 = 1 << 16;

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
        lines: &Sender<String>,
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
            forward(&name, output, lines.clone());
        }
        if let Some(errors) = child.stderr.take() {
            forward(&name, errors, lines.clone());
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
        // Both fail where it has ended before.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Hands on lines until the process closes its end or nobody listens.
fn forward(name: &str, from: impl Read + Send + 'static, lines: Sender<String>) {
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
                    if lines.send(format!("{prefix}{}", text.trim_end())).is_err() {
                        return;
                    }
                }
            }
        }
    });
}
