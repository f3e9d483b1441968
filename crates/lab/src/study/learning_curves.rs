//! Learning curves of dense networks, one for each activation and seed.

use std::collections::VecDeque;

use super::{Curve, ResultError, run::Work};
use crate::dense;
use eddy_dataset::Dataset;
use eddy_inference::checkpoint::Activation;
use eddy_learning::model::DeviceKind;

/// Computes the missing learning curves.
pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    for set in &work.data_sets {
        let set = set.name.as_str();
        let activations = || work.study.activations.iter();
        let all = work.study.seeds.iter().flat_map(|&seed| activations().map(move |&a| (a, seed)));
        let mut missing = VecDeque::new();
        for (number, (activation, seed)) in all.enumerate() {
            if is_missing(work, set, activation, seed)? {
                missing.push_back((activation, seed, work.device_of(number)));
            }
        }
        if missing.is_empty() {
            continue;
        }
        let dataset = work.load_data(set)?;
        work.each(missing, "learning curves", |(activation, seed, device)| {
            train(work, set, activation, seed, device, &dataset)
        })?;
    }
    Ok(())
}

/// Computes a learning curve, unless it exists. Returns a message; `None` if it was stopped.
pub(super) fn run_one(
    work: &Work,
    set: &str,
    activation: Activation,
    seed: u64,
) -> anyhow::Result<Option<String>> {
    if !is_missing(work, set, activation, seed)? {
        return Ok(Some("already exists".to_owned()));
    }
    train(work, set, activation, seed, work.device, &work.load_data(set)?)
}

fn is_missing(
    work: &Work,
    set: &str,
    activation: Activation,
    seed: u64,
) -> Result<bool, ResultError> {
    let file = work.folders.curve(set, activation.name(), seed);
    Ok(Curve::find(&file, &work.study.dense, work.device, work.gpu_precision())?.is_none())
}

fn train(
    work: &Work,
    set: &str,
    activation: Activation,
    seed: u64,
    device: DeviceKind,
    dataset: &Dataset,
) -> anyhow::Result<Option<String>> {
    let (config, stops) = (&work.study.dense, || work.stops());
    let curve = dense::train(config, activation, seed, dataset, device, work.gpu(), &stops)?;
    let Some(curve) = curve else { return Ok(None) };
    let last = curve.epochs.last().map_or(f64::NAN, |epoch| epoch.validation_loss);
    let name = activation.name();
    let (config, precision) = (config.clone(), work.gpu_precision().to_owned());
    let curve = Curve { activation, seed, device: work.device, precision, config, curve };
    curve.save(&work.folders.curve(set, name, seed))?;
    Ok(Some(format!("{set} {name} seed {seed}: validation loss {last:.2e}")))
}
