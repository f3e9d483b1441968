//! Learning curves of dense networks, one for each activation and seed.

use std::collections::VecDeque;

use super::{Curve, run::Work};
use eddy_evaluation::dataset::{Dataset, available_memory};
use eddy_learning::train::dense::train_dense;

/// Computes the missing learning curves.
pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    let config = &work.study.dense;
    for preset in work.presets {
        let mut missing = VecDeque::new();
        for &seed in &work.study.seeds {
            for &activation in &work.study.activations {
                let file = work.folders.curve(preset, activation.name(), seed);
                if Curve::find(&file, config)?.is_none() {
                    missing.push_back((activation, seed, file));
                }
            }
        }
        if missing.is_empty() {
            continue;
        }
        let data = work.folders.data(preset);
        let dataset = Dataset::load(&[data], available_memory() / 2, &mut |_, _| ())?;
        work.each(missing, "learning curves", |(activation, seed, file)| {
            let curve = train_dense(config, activation, seed, &dataset, &|| work.stops())?;
            let Some(curve) = curve else { return Ok(None) };
            let last = curve.epochs.last().map_or(f64::NAN, |epoch| epoch.validation_loss);
            Curve { activation, seed, config: config.clone(), curve }.save(&file)?;
            let name = activation.name();
            Ok(Some(format!("{preset} {name} seed {seed}: validation loss {last:.2e}")))
        })?;
    }
    Ok(())
}
