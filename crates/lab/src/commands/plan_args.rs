//! Arguments of `eddy-lab plan`.

use std::{
    num::{NonZeroU32, NonZeroUsize},
    path::PathBuf,
};

use clap::{Args, Subcommand};

use super::StudyChoice;
use eddy_cli::SceneArgs;

/// `eddy-lab plan`
#[derive(Debug, Args)]
pub struct PlanArgs {
    #[command(subcommand)]
    pub command: PlanCommand,
}

#[derive(Debug, Subcommand)]
pub enum PlanCommand {
    /// Write the tasks of `eddy simulate`: scenes, then the manifest. The data are the same, byte for byte.
    Simulate(PlanSimulateArgs),
    /// Write the tasks of `eddy-lab study`: scenes, networks, evaluations and the report.
    Study(PlanStudyArgs),
    /// List the tasks of a plan with their states and times.
    List(PlanListArgs),
    /// Run tasks of a plan, those that are done excepted: single ones, or all of them on this machine.
    Run(PlanRunArgs),
}

/// `eddy-lab plan simulate`
#[derive(Debug, Args)]
pub struct PlanSimulateArgs {
    /// Plan to write (JSON).
    #[arg(value_name = "PLAN")]
    pub file: PathBuf,
    #[command(flatten)]
    pub scenes: SceneArgs,
    /// Directory that the tasks write to; one bag per scene.
    #[arg(long, short, value_name = "DIR")]
    pub output: PathBuf,
    #[command(flatten)]
    pub tasks: TaskArgs,
}

/// `eddy-lab plan study`
#[derive(Debug, Args)]
pub struct PlanStudyArgs {
    /// Plan to write (JSON).
    #[arg(value_name = "PLAN")]
    pub file: PathBuf,
    #[command(flatten)]
    pub study: StudyChoice,
    #[command(flatten)]
    pub tasks: TaskArgs,
}

/// How a job is divided.
#[derive(Debug, Args)]
pub struct TaskArgs {
    /// Scenes per task, simulated one after the other, or side by side on a GPU [default: 1; 256 on a GPU].
    #[arg(long, value_name = "N")]
    pub scenes_per_task: Option<NonZeroU32>,
    /// Replace an existing plan. Tasks whose outputs exist end at once.
    #[arg(long)]
    pub force: bool,
}

/// `eddy-lab plan list`
#[derive(Debug, Args)]
pub struct PlanListArgs {
    /// Plan.
    #[arg(value_name = "PLAN")]
    pub file: PathBuf,
    /// List the tasks that are not done as job arrays: position, kind, number of the first task, tasks relative to it, arrays that
    /// must be done before, cores, GPUs, memory (MiB) and estimated time (s) of a task.
    #[arg(long)]
    pub arrays: bool,
    /// Print JSON instead of tables.
    #[arg(long)]
    pub json: bool,
}

/// `eddy-lab plan run`
#[derive(Debug, Args)]
pub struct PlanRunArgs {
    /// Plan.
    #[arg(value_name = "PLAN")]
    pub file: PathBuf,
    /// Run these tasks, by number or name, one after the other [default: all, in an order in which each has its inputs].
    #[arg(long, value_name = "TASK", num_args = 1.., conflicts_with = "jobs")]
    pub task: Vec<String>,
    /// Number of tasks to run in parallel.
    #[arg(long, value_name = "N", default_value_t = NonZeroUsize::MIN)]
    pub jobs: NonZeroUsize,
}
