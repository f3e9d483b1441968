//! The description of the network to train, from settings and data.

use std::collections::BTreeSet;

use super::{TrainConfig, TrainError, config::setting, record::different_setting};
use eddy_dataset::Dataset;
use eddy_evaluation::LinearFit;
use eddy_frames::Material;
use eddy_inference::checkpoint::{
    Architecture, Checkpoint, Description, ElasticRule, MATERIAL_INPUTS, Rules, TrainingSummary,
    WeightFormat,
};

/// The description of the untrained network.
pub(super) fn describe(
    config: &TrainConfig,
    dataset: &Dataset,
    command: &str,
) -> Result<Description, TrainError> {
    let Some(first) = dataset.train.first() else {
        let (warm_up, unroll) = (config.windows.warm_up, 1);
        return Err(TrainError::TooShort { found: 0, expected: warm_up + 1, warm_up, unroll });
    };
    let particles = first.material.len();
    if config.architecture == Architecture::Frame {
        same_particles(dataset, particles)?;
    }
    no_constant_feature(dataset)?;
    if config.network.stiffness {
        let mut all = dataset.train.iter().chain(&dataset.validation).chain(&dataset.test);
        all.try_for_each(|stream| stream.known_stiffness().map(drop))?;
    }
    // Of all splits: in a small data set, a material may occur in the validation split only.
    let splits = [&dataset.train, &dataset.validation, &dataset.test];
    let streams = splits.into_iter().flatten();
    let materials: BTreeSet<Material> =
        streams.flat_map(|stream| stream.material.iter().copied()).collect();
    // Sand is the only material beyond those that every network has inputs for.
    let known = materials.last().map_or(0, |&last| last as usize + 1);
    let material_inputs = known.max(MATERIAL_INPUTS);
    let elastic = elastic_rule(config, dataset.spacing, first.dt)?;
    Ok(Description {
        format_version: Description::version(material_inputs),
        architecture: config.architecture,
        core: config.core,
        form: config.network.form,
        normalize_gates: config.network.normalize_gates,
        stiffness: config.network.stiffness,
        stiffness_knots: config.network.stiffness_knots.clone(),
        assumed_stiffness: config.network.assumed_stiffness,
        // Training continues from f32; what is validated and published is rounded.
        weights: WeightFormat::F32,
        dt: first.dt,
        warm_up: config.windows.warm_up as u32,
        gravity: config.gravity,
        materials: materials.into_iter().collect(),
        material_inputs,
        data: dataset.digest.clone(),
        sizes: config.sizes(particles),
        frame: config.network.frame,
        grid: config.grid(dataset.spacing),
        rules: Rules { elastic, ..Rules::standard(config.architecture) },
        domain: first.domain,
        normalization: dataset.normalization.clone(),
        training: TrainingSummary {
            command: command.to_owned(),
            seed: config.seed,
            stiffness: dataset.stated_stiffness(),
            validation_loss: f64::MAX,
            seen: dataset.seen()?.into_iter().collect(),
            linear_fit: LinearFit::of(&dataset.train)?.map(|fit| fit.rows),
            ..TrainingSummary::default()
        },
    })
}

/// The rule `elastic`, if it is on and stable with the modulus of the settings; with those of the streams, each has its own.
fn elastic_rule(
    config: &TrainConfig,
    spacing: f32,
    dt: f32,
) -> Result<Option<ElasticRule>, TrainError> {
    let elastic = config.elastic(spacing, dt);
    let is_unstable = |rule: &ElasticRule| !rule.is_stable(spacing, dt);
    if !config.network.stiffness && elastic.as_ref().is_some_and(is_unstable) {
        let expected = "a modulus whose pressure waves cross at most 256 elements a frame";
        return Err(setting("elastic_modulus", config.elastic_modulus, expected));
    }
    Ok(elastic)
}

impl TrainConfig {
    /// Checks that a run with these settings can start from a network.
    ///
    /// # Errors
    /// [`TrainError::OtherNetwork`] with the first setting that asks for another network.
    pub fn check_start(&self, start: &Description) -> Result<(), TrainError> {
        let expected = Self {
            architecture: start.architecture,
            core: start.core,
            network: self.network.with_layers_of(start),
            ..self.clone()
        };
        different_setting(self, &expected).map_or(Ok(()), |(field, found, expected)| {
            Err(TrainError::OtherNetwork { field, found, expected })
        })
    }
}

/// Turns the description of an untrained network into that of one that starts from a checkpoint: with the scales of features and
/// the rules that its weights were trained with, but for `elastic`, whose modulus the settings say, and with its materials and streams beside
/// those of the data.
pub(super) fn start_from(
    description: &mut Description,
    config: &TrainConfig,
    start: &Checkpoint,
) -> Result<(), TrainError> {
    let digest = start.digest();
    let start = &start.description;
    config.check_start(start)?;
    let other = |field: &str, found: String, expected: String| {
        Err(TrainError::OtherNetwork { field: field.to_owned(), found, expected })
    };
    if !start.has_interval(description.dt) {
        let [found, expected] = [description.dt, start.dt].map(|interval| interval.to_string());
        return other("frame interval (s)", found, expected);
    }
    // The frame model's layers depend on the number of particles, its features on the domain.
    let both = [&*description, start];
    if let [Some(found), Some(expected)] = both.map(|network| network.sizes.particles) {
        if found != expected {
            return other("particles", found.to_string(), expected.to_string());
        }
        let [found, expected] = both.map(|network| network.domain);
        if found != expected {
            return other("domain", found.to_string(), expected.to_string());
        }
    }
    // The particle model gets inputs for further materials, whose weights begin as zeros; the frame model's features would change.
    let inputs = match description.architecture {
        Architecture::Particle => start.material_inputs.max(description.material_inputs),
        Architecture::Frame => start.material_inputs,
    };
    description.material_inputs = inputs;
    description.format_version = Description::version(inputs);
    if let Some(material) =
        description.materials.iter().find(|&&kind| usize::from(kind as u8) >= inputs)
    {
        let expected = format!("the first {inputs} materials");
        return other("material", material.name().to_owned(), expected);
    }
    description.training.start = Some(digest);
    description.normalization = start.normalization.clone();
    let own = start.rules.elastic.filter(|rule| rule.modulus == config.elastic_modulus);
    description.rules = Rules { elastic: own.or(description.rules.elastic), ..start.rules };
    let materials = description.materials.iter().chain(&start.materials).copied();
    description.materials = materials.collect::<BTreeSet<_>>().into_iter().collect();
    let seen = description.training.seen.iter().chain(start.training.seen.iter());
    description.training.seen =
        seen.map(str::to_owned).collect::<BTreeSet<_>>().into_iter().collect();
    Ok(())
}

/// Rejects streams that differ in the number of particles.
fn same_particles(dataset: &Dataset, particles: usize) -> Result<(), TrainError> {
    let mut streams = dataset.train.iter().chain(&dataset.validation).chain(&dataset.test);
    match streams.find(|stream| stream.material.len() != particles) {
        None => Ok(()),
        Some(other) => Err(TrainError::Particles {
            source_file: other.source.clone(),
            stream: other.id,
            found: other.material.len(),
            expected: particles,
        }),
    }
}

/// Rejects constant features, which cannot be normalised.
fn no_constant_feature(dataset: &Dataset) -> Result<(), TrainError> {
    let scale = &dataset.normalization;
    let constant = |&feature: &usize| scale.minimum[feature] >= scale.maximum[feature];
    match (0..4).find(constant) {
        None => Ok(()),
        Some(feature) => {
            let found = scale.minimum[feature];
            Err(TrainError::Constant { feature: ["x", "y", "vx", "vy"][feature], found })
        }
    }
}
