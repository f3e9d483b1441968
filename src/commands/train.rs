//! `eddy train`: bags to a checkpoint.

use anyhow::Context as _;
use eddy::{
    config::Overrides,
    dataset::Dataset,
    model::Architecture,
    train::{Run, TrainConfig, train},
};

use super::{Interrupt, pages};
use crate::cli::TrainArgs;

/// Trains a network on the bags at `args.data`; the best checkpoint ends up in `args.output`.
pub fn run(args: TrainArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    pages::keep_freed();
    let config = settings(&args)?;
    let dataset = Dataset::load(&args.data)?;
    if !quiet {
        println!(
            "{} {}: {} streams to train on, {} to validate on, {} set aside",
            config.architecture.name(),
            config.core.name(),
            dataset.train.len(),
            dataset.validation.len(),
            dataset.test.len(),
        );
    }
    let run = Run {
        device: args.device,
        output: &args.output,
        command: std::env::args().collect::<Vec<_>>().join(" "),
        quiet,
        interrupted: &|| interrupt.requested(),
    };
    let outcome = train(&config, &dataset, &run)?;
    let Some(best) = outcome.best else {
        anyhow::bail!("{}: interrupted before the first epoch was done", args.output.display());
    };
    if !quiet {
        let summary = &best.description.training;
        let how = if outcome.interrupted { "interrupted" } else { "done" };
        println!(
            "{how} after {} epochs: {} holds epoch {} (validation loss {:.4}), {} parameters, digest {}",
            summary.epochs,
            args.output.display(),
            summary.best_epoch,
            summary.validation_loss,
            best.parameters(),
            best.short_digest(),
        );
    }
    Ok(())
}

/// The defaults of the architecture, then the file, then the command line.
fn settings(args: &TrainArgs) -> anyhow::Result<TrainConfig> {
    let overrides = match &args.config {
        None => Overrides::default(),
        Some(file) => Overrides::read(file)?,
    };
    let architecture: Option<Architecture> = match args.architecture {
        Some(architecture) => Some(architecture),
        None => overrides.get("architecture")?,
    };
    let architecture = architecture.unwrap_or_default();
    let mut config = overrides.over(&TrainConfig::defaults(architecture))?;
    config.architecture = architecture;
    config.core = args.core.unwrap_or(config.core);
    config.epochs = args.epochs.unwrap_or(config.epochs);
    config.seed = args.seed.unwrap_or(config.seed);
    config.check().with_context(|| match &args.config {
        Some(file) => format!("{}", file.display()),
        None => "command line".to_owned(),
    })?;
    Ok(config)
}
