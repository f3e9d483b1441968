//! `eddy simulate`: ground truth as one bag per scene, as a live source, or both.
//!
//! 1. [`SceneArgs`](eddy_cli::SceneArgs): scenes from a preset and a seed, or from a file.
//! 2. [`eddy_dataset::simulate`]: missing scenes, in parallel, each into a bag.
//! 3. [`publish`]: scenes one after the other in real time. [`live_tools`]: their tools, if messages move them.

mod live_tools;
mod publish;

use anyhow::bail;

use crate::cli::SimulateArgs;
use eddy_cli::{Interrupt, Output, OutputKind, TerminalProgress, with_usage};
use eddy_dataset::simulate::{Job, MOST_SCENES};
use eddy_mpm::Accelerator;
use eddy_storage::is_remote;

/// Simulates the scenes that do not exist yet.
pub fn run(args: SimulateArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let request = args.scenes.request(args.threads)?;
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
    let mut device = args.scenes.device.open_solver()?;
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
