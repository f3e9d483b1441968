//! Learning curves of dense networks, one for each activation and seed.

use rayon::prelude::*;

use super::Work;
use crate::commands::{pages, progress_bar, simulate::memory};
use eddy::{dataset::Dataset, study::Curve, train::dense::train_dense};

/// Computes what is not there yet, side by side.
pub(super) fn run(work: &Work) -> anyhow::Result<()> {
    pages::keep_freed();
    let config = &work.study.dense;
    for preset in work.presets {
        let mut missing = Vec::new();
        for &seed in &work.study.seeds {
            for &activation in &work.study.activations {
                let file = work.folders.curve(preset, activation.name(), seed);
                if Curve::find(&file, config)?.is_none() {
                    missing.push((activation, seed, file));
                }
            }
        }
        if missing.is_empty() {
            continue;
        }
        let data = work.folders.data(preset);
        let dataset = Dataset::load(&[data], memory::available() / 2, &mut |_, _| ())?;
        let bar = progress_bar(missing.len() as u64, "learning curves", work.quiet);
        missing.into_par_iter().try_for_each(|(activation, seed, file)| -> anyhow::Result<()> {
            let stops = || work.stops();
            let curve = train_dense(config, activation, seed, &dataset, &stops)?;
            if let Some(curve) = curve {
                let data = dataset.digest.clone();
                Curve { data, activation, seed, config: config.clone(), curve }.save(&file)?;
            }
            bar.inc(1);
            Ok(())
        })?;
        bar.finish_and_clear();
    }
    Ok(())
}
