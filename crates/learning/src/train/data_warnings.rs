//! What the streams of a data set state, compared with the settings of a training and with the checkpoint that it starts from.

use super::TrainConfig;
use eddy_dataset::Dataset;
use eddy_frames::decimal;
use eddy_inference::{
    checkpoint::{Checkpoint, Description, JELLY_MODULUS, Rules},
    engine::{Warning, WarningCounts, warnings},
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
    let mut counts = WarningCounts::default();
    for stream in parts.into_iter().flatten() {
        let setup = stream.setup();
        let of_settings = warnings(&settings, &setup);
        for found in &of_settings {
            if let Some(sentence) = against_settings(found) {
                counts.add("settings", found, sentence);
            }
        }
        // Data that differ from both are compared with the settings, which decide.
        let of_start = start.map(|start| warnings(&start.description, &setup));
        for found in of_start.into_iter().flatten().filter(|found| !of_settings.contains(found)) {
            if !matches!(found, Warning::RestShape { .. }) {
                let sentence = format!("compared with the checkpoint to start from: {found}");
                counts.add("start", &found, sentence);
            }
        }
    }
    counts.sentences(all).chain(several_stiffnesses(config, dataset)).collect()
}

/// How a stream differs from the settings.
fn against_settings(found: &Warning) -> Option<String> {
    match found {
        Warning::Gravity { found, expected } => Some(format!(
            "gravity is {found} along y, and the settings say {expected}: features and baselines will fall wrongly; set \
             `gravity = [0.0, {found:?}]`"
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
        // All streams have one domain, and the shape of solids in their first frame; those that must state their stiffness do.
        Warning::Domain { .. } | Warning::RestShape { .. } | Warning::AssumedStiffness { .. } => {
            None
        }
        // Beyond the outermost knots, the weights are those of the nearest, and the stiffness is an input.
        Warning::Stiffness { conditioned: true, .. } => None,
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
