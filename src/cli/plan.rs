//! `eddy plan`: its subcommands.

use std::{num::NonZeroU32, path::PathBuf};

use clap::{Args, Subcommand};

use eddy_cli::SceneArgs;
use eddy_lab::commands::{PlanListArgs, PlanRunArgs, StudyChoice};

/// `eddy plan`
#[derive(Debug, Args)]
pub struct PlanArgs {
    #[command(subcommand)]
    pub command: PlanCommand,
}

#[derive(Debug, Subcommand)]
pub enum PlanCommand {
    /// Write the tasks of `eddy simulate`: scenes, then the manifest. The data are the same, byte for byte.
    Simulate(PlanSimulateArgs),
    /// Write the tasks of `eddy study`: scenes, networks, evaluations and the report.
    Study(PlanStudyArgs),
    /// List the tasks of a plan with their states and times.
    List(PlanListArgs),
    /// Run tasks of a plan, those that are done excepted: single ones, or all of them on this machine.
    Run(PlanRunArgs),
}

/// `eddy plan simulate`
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

/// `eddy plan study`
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
