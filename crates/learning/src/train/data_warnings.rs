//! What the streams of a data set state, compared with the settings of a training and with the checkpoint that it starts from.

use std::collections::BTreeMap;

use super::TrainConfig;
use eddy_dataset::Dataset;
use eddy_frames::decimal;
use eddy_inference::{
    checkpoint::{Checkpoint, Description, JELLY_MODULUS, Rules},
    engine::{Warning, warnings},
};

/// Ratio of the stiffnesses of two streams above which a network that is not conditioned on it is a compromise.
const STIFFNESS_RATIO: f32 = 1.2;

/// Sentences about streams that differ from the settings, from each other or from the training of `start`, each with what to do.
pub fn data_warnings(
    config: &TrainConfig,
    dataset: &Dataset,
    start: Option<&Checkpoint>,
) -> Vec<String> {
    let Some(first) = dataset.train.first() else { return Vec::new() };
    let parts = [&dataset.train, &dataset.validation, &dataset.test];
    let all: usize = parts.iter().map(|part| part.len()).sum();
    let sizes = config.sizes(first.material.len());
    let settings = Description {
        gravity: config.gravity,
        stiffness: config.network.stiffness,
        stiffness_knots: config.network.stiffness_knots.clone(),
        domain: first.domain,
        grid: config.grid(dataset.spacing),
        rules: Rules {
            elastic: config.elastic(dataset.spacing, first.dt),
            ..Rules::standard(config.architecture)
        },
        ..Description::untrained(config.architecture, config.core, sizes)
    };
    let mut counted = BTreeMap::new();
    for stream in parts.into_iter().flatten() {
        let setup = stream.setup();
        let of_settings = warnings(&settings, &setup);
        let of_start = start.map(|start| warnings(&start.description, &setup));
        // Data that differ from both are compared with the settings, which decide.
        let of_start = of_start.into_iter().flatten().filter(|found| !of_settings.contains(found));
        let sentences =
            of_settings.iter().filter_map(against_settings).chain(of_start.filter_map(|found| {
                let is_rest = matches!(found, Warning::RestShape { .. });
                (!is_rest).then(|| format!("compared with the checkpoint to start from: {found}"))
            }));
        for sentence in sentences {
            *counted.entry(sentence).or_insert(0) += 1;
        }
    }
    let counted = counted.into_iter();
    let sentences =
        counted.map(|(sentence, streams)| format!("{sentence} ({streams} of {all} streams)"));
    sentences.chain(several_stiffnesses(config, dataset)).collect()
}

/// How a stream differs from the settings.
fn against_settings(found: &Warning) -> Option<String> {
    match found {
        Warning::Gravity { found, expected } => Some(format!(
            "gravity is {found} along y, and the settings say {expected}: features and baselines will fall wrongly; set \
             `gravity = [0.0, {found:?}]`"
        )),
        Warning::Stiffness { found, expected: [low, high], conditioned: true } => Some(format!(
            "stiffness is {found}, and network.stiffness_knots reach from {low} to {high}: widen them"
        )),
        Warning::Stiffness { found, expected: [low, _], conditioned: false } => Some(format!(
            "stiffness is {found}, and elastic_modulus is that of stiffness {low}: the rule `elastic` will move jelly wrongly; set \
             `elastic_modulus = {:?}`",
            (decimal(*found) * decimal(JELLY_MODULUS)) as f32
        )),
        Warning::Spacing { found, expected } => Some(format!(
            "particle spacing is {found:.5}, and the median of the training part is {expected:.5}: the network will be a \
             compromise; train on streams with one spacing"
        )),
        // All streams have one domain, and the shape of solids in their first frame.
        Warning::Domain { .. } | Warning::RestShape { .. } => None,
    }
}

/// Whether a network that is not conditioned on the stiffness is to learn several.
fn several_stiffnesses(config: &TrainConfig, dataset: &Dataset) -> Option<String> {
    let [low, high] = dataset.stated_stiffness()?;
    (!config.network.stiffness && high > STIFFNESS_RATIO * low).then(|| {
        format!(
            "the streams have stiffnesses from {low} to {high}: a network that is not conditioned on it will be a compromise; set \
             network.stiffness = true, or train on one stiffness"
        )
    })
}
