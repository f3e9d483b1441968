//! Why plans and tasks cannot be run.

use std::{
    io,
    path::{Path, PathBuf},
};

use eddy_settings::ConfigError;

/// Why a plan or a task cannot be run.
#[derive(Debug, thiserror::Error)]
pub enum PlanError {
    /// The file is not a plan.
    #[error("{}: not a plan of this version of eddy: {reason}", file.display())]
    NoPlan {
        /// The file.
        file: PathBuf,
        /// What is wrong in it.
        reason: serde_json::Error,
    },
    /// The file with the state of a task cannot be read.
    #[error(transparent)]
    State(#[from] ConfigError),
    /// A field of the file is missing, out of range, or contradicts others.
    #[error("{}: {field}: found {found}, expected {expected}", file.display())]
    Invalid {
        /// The file.
        file: PathBuf,
        /// The field.
        field: String,
        /// Its value.
        found: String,
        /// What it should be.
        expected: String,
    },
    /// A file or folder cannot be read, written or locked.
    #[error("cannot {action} {}: {reason}", path.display())]
    Io {
        /// The failed operation.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// The reason from the operating system.
        reason: io::Error,
    },
    /// There is no such task.
    #[error("{}: --task: found {found}, expected a name from `eddy-lab plan list`, or a number below {tasks}{hint}", file.display())]
    NoTask {
        /// The plan.
        file: PathBuf,
        /// The number or name that was asked for.
        found: String,
        /// How many tasks there are.
        tasks: usize,
        /// A similar name, as the end of the sentence.
        hint: String,
    },
    /// Another process runs this task.
    #[error("{task}: is being run by {holder}; this process has done nothing")]
    Busy {
        /// Number and name of the task.
        task: String,
        /// The other process.
        holder: String,
    },
    /// Another process runs all tasks of this plan, or others run single tasks of it.
    #[error("{}: is being run by {holder}; this process has done nothing", file.display())]
    PlanBusy {
        /// The plan.
        file: PathBuf,
        /// The other process.
        holder: String,
    },
    /// Inputs of a task do not exist.
    #[error("{task}: cannot start without {}", missing.join("; "))]
    Inputs {
        /// Number and name of the task.
        task: String,
        /// The paths, with the tasks that write them.
        missing: Vec<String>,
    },
    /// A task has ended without one of its outputs.
    #[error("{task}: found no {} after it had ended, expected this output", missing.display())]
    Outputs {
        /// Number and name of the task.
        task: String,
        /// The output.
        missing: PathBuf,
    },
    /// A task has failed.
    #[error("{task}: {reason:#}")]
    Task {
        /// Number and name of the task.
        task: String,
        /// Why.
        reason: anyhow::Error,
    },
    /// A signal came before all tasks were done.
    #[error("interrupted: {done} of {tasks} tasks are done; run the same command again to resume")]
    Interrupted {
        /// Tasks that are done, including those of earlier runs.
        done: usize,
        /// Tasks that were asked for.
        tasks: usize,
    },
    /// Some tasks have failed, and others need their outputs.
    #[error(
        "{}{done} of {tasks} tasks are done; run the same command again to resume",
        lines(failures)
    )]
    Failed {
        /// One error for each failed task.
        failures: Vec<Self>,
        /// Tasks that are done, including those of earlier runs.
        done: usize,
        /// Tasks that were asked for.
        tasks: usize,
    },
}

impl PlanError {
    /// Adds the failed operation to an I/O error.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> Self {
        move |reason| Self::Io { action, path: path.to_owned(), reason }
    }
}

fn lines(failures: &[PlanError]) -> String {
    failures.iter().map(|failure| format!("{failure}\n")).collect()
}
