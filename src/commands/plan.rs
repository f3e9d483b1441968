//! `eddy plan`: long jobs as tasks, from [`eddy_lab`].

use std::num::NonZeroU32;

use crate::cli::{PlanArgs, PlanCommand, PlanSimulateArgs, PlanStudyArgs};
use eddy_cli::{Device, Interrupt, TerminalProgress, keep_freed_memory, with_usage};
use eddy_evaluation::dataset::simulate::MOST_SCENES;
use eddy_lab::{commands, plans::LongJob};
use eddy_learning::model::DeviceKind;

/// Runs the subcommand.
pub fn run(args: PlanArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    match args.command {
        PlanCommand::Simulate(args) => simulation(&args),
        PlanCommand::Study(args) => study(args),
        PlanCommand::List(args) => commands::plan_list(&args),
        PlanCommand::Run(args) => {
            keep_freed_memory();
            commands::plan_run(&args, &TerminalProgress::new(quiet, interrupt))
        }
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
    commands::plan_save(plan.map_err(with_usage)?, file, tasks.force)
}

fn study(args: PlanStudyArgs) -> anyhow::Result<()> {
    let PlanStudyArgs { file, study, tasks } = args;
    let request = commands::study_request(study)?;
    let per_task = per_task(tasks.scenes_per_task, request.device);
    commands::plan_save(LongJob::study(request, per_task)?, &file, tasks.force)
}

/// Scenes per task.
fn per_task(given: Option<NonZeroU32>, device: DeviceKind) -> u32 {
    let default = if device.is_cuda() { MOST_SCENES as u32 } else { 1 };
    given.map_or(default, NonZeroU32::get)
}
