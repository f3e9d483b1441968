//! `eddy simulate`: ground truth as one bag per scene, as a live source, or both.
//!
//! 1. [`mod@source`]: scenes from a preset and a seed, or from a file.
//! 2. [`eddy_evaluation::dataset::simulate`]: missing scenes, in parallel, each into a bag.
//! 3. [`publish`]: scenes one after the other in real time.

mod publish;
pub(crate) mod source;

use std::num::NonZeroUsize;

use anyhow::bail;

use super::{
    Interrupt, TerminalProgress,
    output::{Output, OutputKind},
};
use crate::cli::{Device, SceneArgs, SimulateArgs, Stiffness};
use eddy_evaluation::dataset::simulate::{
    Job, MOST_SCENES, SimulateError, SimulationRequest, Source,
};
use eddy_mpm::{Accelerator, Settings};
use eddy_settings::usage::Usage;
use eddy_storage::is_remote;
use source::source;

/// Simulates the scenes that do not exist yet.
pub fn run(args: SimulateArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let request = request(&args.scenes, args.threads)?;
    if let (Some(output), true) = (&args.output, args.force)
        && is_remote(output)
    {
        bail!("{}: --force replaces only what is on this machine", output.display());
    }
    let room = match (&args.output, args.force) {
        (Some(output), true) => Some(Output::at(output, OutputKind::Bags, true, &[])?),
        _ => None,
    };
    let at_once = match (&args.publish, request.device) {
        (Some(link), Some(_)) => {
            bail!("{link}: --publish simulates on the processor; omit --device")
        }
        (Some(_), None) => Some(1),
        (None, Some(_)) => Some(MOST_SCENES),
        (None, None) => None,
    };
    let job = Job::plan(&request, args.output.as_deref(), at_once).map_err(with_usage)?;
    let present = job.present();
    if let (Some(output), 1..) = (&args.output, present) {
        println!("{}", job.present_scenes(output));
    }
    if let (Some(link), 1..) = (&args.publish, present) {
        bail!(
            "{link}: {present} scenes already exist; publish them with `eddy replay`, or choose another --output"
        );
    }
    // Before anything is written, and after what needs no device is checked.
    let mut device = open(args.scenes.device)?;
    let store = args.output.as_ref().map(|output| job.open_store(output)).transpose()?;
    let outcome = match (&args.publish, &store) {
        (Some(link), store) => publish::run(&job, link, &args, store.as_ref(), quiet, interrupt),
        (None, Some(store)) => {
            let progress = TerminalProgress::new(quiet, interrupt);
            let device = device.as_mut().map(|device| &mut **device as &mut dyn Accelerator);
            let summary = job.write(store, &progress, device);
            if !job.planned().is_empty() {
                println!("{summary}");
            }
            summary.complete().map_err(Into::into)
        }
        (None, None) => bail!("expected --output or --publish"),
    };
    if let Some(store) = store {
        store.close();
    }
    outcome?;
    room.into_iter().for_each(Output::replaced);
    Ok(())
}

/// The device of this name; `None` for the processor.
fn open(device: Device) -> anyhow::Result<Option<Box<dyn Accelerator>>> {
    match device {
        Device::Cpu => Ok(None),
        #[cfg(feature = "cuda")]
        Device::Cuda(number) => Ok(Some(Box::new(eddy_cuda::open_solver(number.into())?))),
    }
}

/// An invalid request is wrong usage: its numbers are all from the command line.
pub(super) fn with_usage(error: impl Into<anyhow::Error>) -> anyhow::Error {
    let error = error.into();
    match error.downcast_ref() {
        Some(SimulateError::Request { .. }) => Usage::new(format_args!("--{error}")).into(),
        _ => error,
    }
}

/// The request of the command line.
pub(super) fn request(
    args: &SceneArgs,
    threads: Option<NonZeroUsize>,
) -> anyhow::Result<SimulationRequest> {
    let source = source(args)?;
    let scene_name = match (&source, &args.scene) {
        (_, Some(file)) => Some(file.display().to_string()),
        (Source::Written(_), None) => Some(args.preset.clone()),
        (Source::Random(_), None) => None,
    };
    let name = match &args.scene {
        Some(file) => file.file_stem().unwrap_or_default().to_string_lossy().into_owned(),
        None => args.preset.clone(),
    };
    let SceneArgs { law, viscosity, substeps, duration, particle_order: order, .. } = *args;
    // A range is part of the source.
    let stiffness = args.stiffness.and_then(Stiffness::one);
    Ok(SimulationRequest {
        source,
        name,
        scene_name,
        scenes: args.scenes,
        seed: args.seed,
        settings: Settings { stiffness, law, viscosity, substeps, duration, order },
        fields: args.fields,
        device: (args.device != Device::Cpu).then_some("cuda"),
        threads,
    })
}
