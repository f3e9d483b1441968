//! `eddy calibrate`: fits estimates of a checkpoint's errors to free rollouts.

use std::num::NonZeroUsize;

use anyhow::{Context as _, ensure};

use super::{counted, streams, surrogate};
use crate::cli::CalibrateArgs;
use eddy_cli::{Interrupt, TerminalProgress, on_disk, terminal};
use eddy_evaluation::{Calibration, CalibrationRequest, Reliability};
use eddy_inference::{checkpoint::Checkpoint, error_model::ERROR_MODEL_FILE};
use eddy_settings::ensure_usage;

/// Writes `error_model.toml` beside the checkpoint and prints how well the estimates hold.
pub fn run(args: &CalibrateArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    ensure_usage!(args.horizon > 0, "--horizon: found 0, expected at least 1 frame");
    ensure_usage!(args.starts > 0, "--starts: found 0, expected at least 1 per stream");
    on_disk(&args.checkpoint)?;
    let file = args.checkpoint.join(ERROR_MODEL_FILE);
    ensure!(
        args.force || !file.exists(),
        "{}: already exists; replace it with --force",
        file.display()
    );
    let checkpoint = Checkpoint::load_uncalibrated(&args.checkpoint)?;
    let surrogate = surrogate::on_device(&checkpoint, Some(NonZeroUsize::MIN), args.device)
        .with_context(|| args.checkpoint.display().to_string())?;
    let request = CalibrationRequest {
        streams: streams::load(&args.data, args.skip_streams)?,
        stiffness: args.stiffness,
        horizon: args.horizon,
        starts: args.starts,
        threads: args.threads,
    };
    let progress = TerminalProgress::new(quiet, interrupt);
    let Calibration { model, reliability, remarks } =
        Calibration::of(&surrogate, request, &progress)?;
    remarks.iter().for_each(|remark| println!("{remark}"));
    model.save(&args.checkpoint)?;
    println!(
        "{} over {}; each fifth of the streams is estimated from the others:",
        counted(model.rollouts as u64, "free rollout"),
        counted(model.streams as u64, "stream"),
    );
    print!("{}", Reliability::table([(None, &reliability[..])]).framed(terminal::columns()));
    println!("\nerror estimates: {}", file.display());
    Ok(())
}
