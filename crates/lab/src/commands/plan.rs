//! `eddy-lab plan`: writes, lists and runs the tasks of long jobs.

use std::{
    env,
    num::NonZeroU32,
    path::{Path, PathBuf},
};

use anyhow::{Context, ensure};
use serde::Serialize;

use super::{
    PlanArgs, PlanCommand,
    output::COLUMNS,
    plan_args::{PlanListArgs, PlanRunArgs, PlanSimulateArgs, PlanStudyArgs},
    study, table,
};
use crate::plans::LongJob;
use eddy_cli::{Device, keep_freed_memory, with_usage};
use eddy_dataset::simulate::MOST_SCENES;
use eddy_frames::progress::Progress;
use eddy_learning::model::DeviceKind;
use eddy_plan::{Array, Job as _, OpenPlan, Plan, Task, TaskState};

/// Runs the subcommand.
pub fn run(args: PlanArgs, progress: &dyn Progress) -> anyhow::Result<()> {
    match args.command {
        PlanCommand::Simulate(args) => simulation(&args),
        PlanCommand::Study(args) => comparison(args),
        PlanCommand::List(args) => list(&args),
        PlanCommand::Run(args) => run_tasks(&args, progress),
    }
}

fn simulation(args: &PlanSimulateArgs) -> anyhow::Result<()> {
    let PlanSimulateArgs { file, scenes, output, tasks } = args;
    let request = scenes.request(None)?;
    let device = match scenes.device {
        Device::Cpu => DeviceKind::Flex,
        #[cfg(feature = "cuda")]
        Device::Cuda(number) => DeviceKind::Cuda(number),
    };
    let per_task = per_task(tasks.scenes_per_task, device);
    let plan = LongJob::simulate(&request, output, device, per_task);
    save(plan.map_err(with_usage)?, file, tasks.force)
}

fn comparison(args: PlanStudyArgs) -> anyhow::Result<()> {
    let PlanStudyArgs { file, study, tasks } = args;
    let request = study::request(study)?;
    let per_task = per_task(tasks.scenes_per_task, request.device);
    save(LongJob::study(request, per_task)?, &file, tasks.force)
}

/// Scenes per task.
fn per_task(given: Option<NonZeroU32>, device: DeviceKind) -> u32 {
    let default = if device.is_cuda() { MOST_SCENES as u32 } else { 1 };
    given.map_or(default, NonZeroU32::get)
}

/// Writes a plan whose paths start in the current directory.
///
/// # Errors
/// When the file exists, unless `force`, or cannot be written.
fn save(plan: Plan<LongJob>, file: &Path, force: bool) -> anyhow::Result<()> {
    let shown = file.display();
    ensure!(
        force || !file.exists(),
        "{shown}: already exists; choose another name, or replace it with --force"
    );
    let absolute = std::path::absolute(file).with_context(|| shown.to_string())?;
    let here = env::current_dir().context("current directory")?;
    let tasks = plan.tasks.len();
    let seconds: f64 = plan.tasks.iter().map(|task| task.cost.seconds).sum();
    plan.starting_in(&here, &absolute).save(file)?;
    println!("{tasks} tasks, about {} in total: {shown}", duration(seconds));
    Ok(())
}

/// Prints the states of the tasks, or the arrays of those that are not done.
///
/// # Errors
/// When the plan or the state of a task cannot be read.
fn list(args: &PlanListArgs) -> anyhow::Result<()> {
    let plan = open(&args.file)?;
    let states = plan.states()?;
    if args.arrays {
        let arrays = plan.arrays(&states);
        if args.json {
            let rows: Vec<ArrayRow> = arrays.iter().map(ArrayRow::of).collect();
            println!("{}", serde_json::to_string_pretty(&rows)?);
        } else {
            arrays.iter().enumerate().for_each(|(n, array)| println!("{}", line(n, array)));
        }
        return Ok(());
    }
    if args.json {
        let row = |number| TaskRow::of(&plan, number, &states[number]);
        let rows: Vec<TaskRow> = (0..states.len()).map(row).collect();
        println!("{}", serde_json::to_string_pretty(&rows)?);
        return Ok(());
    }
    let rows = plan.tasks().iter().zip(&states).enumerate().map(|(number, (task, state))| {
        vec![
            number.to_string(),
            task.name.clone(),
            state.name().to_owned(),
            duration(task.cost.seconds),
            match state {
                TaskState::Done { seconds, .. } => duration(*seconds),
                _ => String::new(),
            },
            match state {
                TaskState::Done { host, .. } => host.clone(),
                TaskState::Running { holder } => holder.clone(),
                _ => String::new(),
            },
        ]
    });
    let header = ["task", "name", "state", "estimate", "took", "where"];
    println!("{}", table("Tasks", header, rows).plain(COLUMNS));
    for (number, state) in states.iter().enumerate() {
        if let TaskState::Failed { failures, reason } = state {
            println!("task {number} has failed {failures} times, the last time: {reason}");
        }
    }
    let done = states.iter().filter(|state| matches!(state, TaskState::Done { .. })).count();
    println!("{done} of {} tasks are done", states.len());
    Ok(())
}

/// Runs tasks, or all of them.
///
/// # Errors
/// When a task has failed, cannot start, or is being run by another process.
fn run_tasks(args: &PlanRunArgs, progress: &dyn Progress) -> anyhow::Result<()> {
    keep_freed_memory();
    let plan = open(&args.file)?;
    if args.task.is_empty() {
        return Ok(plan.run_all(args.jobs, progress)?);
    }
    let numbers = args.task.iter().map(|word| plan.find(word));
    let numbers: Vec<usize> = numbers.collect::<Result<_, _>>()?;
    Ok(plan.run_tasks(&numbers, progress)?)
}

/// Reads a plan, and goes where its paths start.
fn open(file: &Path) -> anyhow::Result<OpenPlan<LongJob>> {
    let file = std::path::absolute(file).with_context(|| file.display().to_string())?;
    let plan = OpenPlan::read(&file)?;
    let directory = plan.directory()?;
    env::set_current_dir(&directory).with_context(|| directory.display().to_string())?;
    Ok(plan)
}

/// A task in JSON.
#[derive(Serialize)]
struct TaskRow<'a> {
    task: usize,
    name: &'a str,
    kind: &'static str,
    state: &'static str,
    /// Tasks that must be done before.
    after: &'a [usize],
    inputs: &'a [PathBuf],
    outputs: &'a [PathBuf],
    cores: u32,
    gpus: u32,
    /// MiB.
    memory: u64,
    /// Estimated time (s).
    seconds: f64,
    /// Time that it took (s).
    took: Option<f64>,
}

impl<'a> TaskRow<'a> {
    fn of(plan: &'a OpenPlan<LongJob>, number: usize, state: &TaskState) -> Self {
        let Task { name, work, inputs, outputs, cost } = &plan.tasks()[number];
        let took = match state {
            TaskState::Done { seconds, .. } => Some(*seconds),
            _ => None,
        };
        Self {
            task: number,
            name,
            kind: plan.job().kind(work),
            state: state.name(),
            after: plan.before(number),
            inputs,
            outputs,
            cores: cost.cores,
            gpus: cost.gpus,
            memory: cost.memory,
            seconds: cost.seconds,
            took,
        }
    }
}

/// An array in JSON.
#[derive(Serialize)]
struct ArrayRow<'a> {
    kind: &'static str,
    /// Number of the first task.
    first: usize,
    /// Tasks relative to the first.
    indices: &'a str,
    tasks: usize,
    /// Positions of arrays that must be done before.
    after: &'a [usize],
    cores: u32,
    gpus: u32,
    /// MiB.
    memory: u64,
    /// Estimated time of a task (s).
    seconds: f64,
}

impl<'a> ArrayRow<'a> {
    fn of(array: &'a Array) -> Self {
        let Array { kind, first, indices, tasks, after, cost } = array;
        Self {
            kind,
            first: *first,
            indices,
            tasks: *tasks,
            after,
            cores: cost.cores,
            gpus: cost.gpus,
            memory: cost.memory,
            seconds: cost.seconds,
        }
    }
}

/// An array as words that a shell reads.
fn line(position: usize, array: &Array) -> String {
    let Array { kind, first, indices, after, cost, .. } = array;
    let after: Vec<String> = after.iter().map(usize::to_string).collect();
    let after = if after.is_empty() { "-".to_owned() } else { after.join(",") };
    let (cores, gpus, memory) = (cost.cores, cost.gpus, cost.memory);
    let seconds = cost.seconds.ceil();
    format!("{position} {kind} {first} {indices} {after} {cores} {gpus} {memory} {seconds}")
}

/// A time in the largest unit that gives at least 1.
fn duration(seconds: f64) -> String {
    match seconds {
        s if s < 60.0 => format!("{s:.1} s"),
        s if s < 3600.0 => format!("{:.1} min", s / 60.0),
        s => format!("{:.1} h", s / 3600.0),
    }
}
