//! Learning curves of dense networks, one for each activation and seed.

use std::collections::VecDeque;

use super::{Curve, run::Work};
use eddy_evaluation::dataset::{Dataset, available_memory};
use eddy_learning::train::dense::train_dense;

/// Computes the missing learning curves.
pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    let config = &work.study.dense;
    let (device, precision) = (work.device, work.gpu_precision());
    for set in &work.data_sets {
        let set = set.name.as_str();
        let activations = || work.study.activations.iter();
        let all = work.study.seeds.iter().flat_map(|&seed| activations().map(move |&a| (a, seed)));
        let mut missing = VecDeque::new();
        for (number, (activation, seed)) in all.enumerate() {
            let file = work.folders.curve(set, activation.name(), seed);
            if Curve::find(&file, config, device, precision)?.is_none() {
                missing.push_back((activation, seed, work.device_of(number), file));
            }
        }
        if missing.is_empty() {
            continue;
        }
        let data = work.folders.data(set);
        let dataset = Dataset::load(&[data], available_memory() / 2, &mut |_, _| ())?;
        work.each(missing, "learning curves", |(activation, seed, place, file)| {
            let stops = || work.stops();
            let curve = train_dense(config, activation, seed, &dataset, place, work.gpu(), &stops)?;
            let Some(curve) = curve else { return Ok(None) };
            let last = curve.epochs.last().map_or(f64::NAN, |epoch| epoch.validation_loss);
            let (config, precision) = (config.clone(), precision.to_owned());
            Curve { activation, seed, device, precision, config, curve }.save(&file)?;
            let name = activation.name();
            Ok(Some(format!("{set} {name} seed {seed}: validation loss {last:.2e}")))
        })?;
    }
    Ok(())
}
