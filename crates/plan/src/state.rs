//! The states of tasks, in the folder `PLAN.state` beside the file `PLAN.json`:
//!
//! | file | content |
//! |---|---|
//! | `lock` | locked by a process that runs all tasks, and shared by those that run single tasks |
//! | `NAME.lock` | locked by the process that runs this task |
//! | `NAME.toml` | how the task has ended the last time |
//!
//! The operating system unlocks the files of a process that was killed. On a network file system, the server does so when
//! it notices that the machine is lost.

use std::{
    fs::{self, File, OpenOptions, TryLockError},
    io::Write as _,
    path::{Path, PathBuf},
    process, thread,
    time::Duration,
};

use eddy_frames::clock::Clock;
use eddy_settings::{self as settings, atomic};
use serde::{Deserialize, Serialize};

use super::PlanError;

/// How long to wait for a lock: `eddy-lab plan list` holds it for a moment, and a killed process until its memory is freed.
const PATIENCE: Duration = Duration::from_secs(1);
/// Interval between two attempts.
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// The state of a task.
#[derive(Clone, Debug, PartialEq)]
pub enum TaskState {
    /// A task that it needs is not done.
    Waiting,
    /// It can be run.
    Ready,
    /// A process runs it.
    Running {
        /// The process.
        holder: String,
    },
    /// Its outputs exist.
    Done {
        /// The machine that has run it.
        host: String,
        /// How long it took there (s).
        seconds: f64,
    },
    /// It has failed and can be run again.
    Failed {
        /// How often.
        failures: u32,
        /// Why, the last time.
        reason: String,
    },
}

impl TaskState {
    /// Its name in one word.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Waiting => "waiting",
            Self::Ready => "ready",
            Self::Running { .. } => "running",
            Self::Done { .. } => "done",
            Self::Failed { .. } => "failed",
        }
    }
}

/// How a task has ended.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Record {
    /// Digest of the plan: a file of the same name may be another one now.
    plan: String,
    /// The machine.
    pub(crate) host: String,
    /// The number of the process there.
    process: u32,
    /// How long it took (s).
    pub(crate) seconds: f64,
    /// How often the task has failed.
    pub(crate) failures: u32,
    /// Why it has failed; absent if it is done.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) reason: Option<String>,
}

/// A locked file.
#[derive(Debug)]
pub(crate) struct Lock {
    file: File,
    /// Whether it says who holds it.
    named: bool,
}

impl Drop for Lock {
    fn drop(&mut self) {
        if self.named {
            let _ = self.file.set_len(0);
        }
    }
}

/// How to lock a file.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Sharing {
    /// For one process.
    Exclusive,
    /// For all that share it.
    Shared,
}

/// The folder.
#[derive(Debug)]
pub(crate) struct State {
    folder: PathBuf,
    /// Digest of the plan.
    digest: String,
}

impl State {
    pub(crate) fn new(folder: PathBuf, digest: String) -> Self {
        Self { folder, digest }
    }

    /// Locks the plan; the error is a description of those who have locked it.
    pub(crate) fn lock_plan(&self, sharing: Sharing) -> Result<Result<Lock, String>, PlanError> {
        let mut others = "other processes, which run single tasks";
        if sharing == Sharing::Shared {
            others = "another process";
        }
        lock(&self.folder.join("lock"), sharing, others)
    }

    /// Locks a task; the error is a description of the process that has locked it.
    pub(crate) fn lock_task(&self, name: &str) -> Result<Result<Lock, String>, PlanError> {
        lock(&self.file(name, "lock"), Sharing::Exclusive, "another process")
    }

    /// The process that runs a task.
    pub(crate) fn holder(&self, name: &str) -> Result<Option<String>, PlanError> {
        let path = self.file(name, "lock");
        let Ok(file) = File::open(&path) else { return Ok(None) };
        match file.try_lock_shared() {
            Ok(()) => Ok(None),
            Err(TryLockError::WouldBlock) => Ok(Some(holder(&path, "another process"))),
            Err(TryLockError::Error(reason)) => Err(PlanError::io("lock", &path)(reason)),
        }
    }

    /// How a task of this plan has ended the last time.
    pub(crate) fn record(&self, name: &str) -> Result<Option<Record>, PlanError> {
        let file = self.file(name, "toml");
        if !file.exists() {
            return Ok(None);
        }
        let record: Record = settings::load(&file)?;
        Ok((record.plan == self.digest).then_some(record))
    }

    /// Writes how a task has ended.
    pub(crate) fn write(
        &self,
        name: &str,
        seconds: f64,
        failures: u32,
        reason: Option<String>,
    ) -> Result<(), PlanError> {
        let (plan, host, process) = (self.digest.clone(), host(), process::id());
        let record = Record { plan, host, process, seconds, failures, reason };
        let text = toml::to_string(&record).expect("numbers and words are TOML");
        let file = self.file(name, "toml");
        atomic::replace(&file, text.as_bytes()).map_err(PlanError::io("write", &file))
    }

    fn file(&self, name: &str, extension: &str) -> PathBuf {
        // Not `with_extension`: names may have dots.
        self.folder.join(format!("{name}.{extension}"))
    }
}

/// Locks a file, which is created if it does not exist. Waits a moment for those who have locked it.
fn lock(path: &Path, sharing: Sharing, others: &str) -> Result<Result<Lock, String>, PlanError> {
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(PlanError::io("create", folder))?;
    }
    let mut options = OpenOptions::new();
    let options = options.read(true).write(true).create(true).truncate(false);
    let mut file = options.open(path).map_err(PlanError::io("open", path))?;
    let clock = Clock::start();
    loop {
        let outcome = match sharing {
            Sharing::Exclusive => file.try_lock(),
            Sharing::Shared => file.try_lock_shared(),
        };
        match outcome {
            Ok(()) => break,
            Err(TryLockError::WouldBlock) if clock.now() > PATIENCE => {
                return Ok(Err(holder(path, others)));
            }
            Err(TryLockError::WouldBlock) => thread::sleep(POLL_INTERVAL),
            Err(TryLockError::Error(reason)) => return Err(PlanError::io("lock", path)(reason)),
        }
    }
    let named = sharing == Sharing::Exclusive;
    // A process that was killed has left its name.
    file.set_len(0).map_err(PlanError::io("write", path))?;
    if named {
        let text = format!("process {} on {}", process::id(), host());
        file.write_all(text.as_bytes()).map_err(PlanError::io("write", path))?;
    }
    Ok(Ok(Lock { file, named }))
}

/// What a locked file says about the process that has locked it.
fn holder(path: &Path, others: &str) -> String {
    let text = fs::read_to_string(path).unwrap_or_default();
    if text.is_empty() { others.to_owned() } else { text }
}

/// The name of this machine.
fn host() -> String {
    sysinfo::System::host_name().unwrap_or_else(|| "an unknown host".to_owned())
}
