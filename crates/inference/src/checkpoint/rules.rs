//! `[rules]` of `model.toml`: the constants of the rules that correct the particle model's predictions (`engine/rules`). The
//! digest so covers everything that changes a prediction.

use std::{fmt, path::Path};

use serde::{Deserialize, Serialize};

use super::{Architecture, CheckpointError, ElasticRule, description::field, elastic};

/// The rules that correct predictions, in the order in which they run. An absent rule is off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rules {
    /// Bodies of jelly that nothing else is close to move by their elasticity.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub elastic: Option<ElasticRule>,
    /// Liquids keep their area.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub area: Option<AreaRule>,
    /// Jelly and rope keep their shape.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shape: Option<ShapeRule>,
    /// Bodies that touch nothing keep their momentum and angular momentum.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flight: Option<FlightRule>,
    /// Bodies that touch a wall and hardly move come to rest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rest: Option<RestRule>,
}

/// Constants of the rule that liquids keep their area: where predicted liquid is too dense, a pressure pushes it apart.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AreaRule {
    /// Cell width of the grid for the pressure (spacings at rest), 0.5 to 16.
    pub cell_width: f32,
    /// Fill of a node above which there is pressure; 1 inside a body at rest. In the ground truth, irregularly placed particles
    /// reach up to 1.25.
    pub fill_limit: f32,
    /// Fill of a node below which it is outside the surface and has no pressure; at most `fill_limit`.
    pub surface_fill: f32,
    /// Number of sweeps of the pressure solver, 1 to 1000.
    pub sweeps: usize,
    /// Factor of successive over-relaxation, above 0 and below 2.
    pub relaxation: f32,
    /// Largest shift of a particle per frame, along an axis (cells of this grid).
    pub longest_shift: f32,
    /// Share of the excess fill that is removed per frame, above 0 and at most 1; 1 where the key is absent. In the ground truth,
    /// jets that collide reach a fill of 4 and spread over many frames; a network's errors add far less in a frame.
    #[serde(default = "all_at_once", skip_serializing_if = "is_all_at_once")]
    pub rate: f32,
}

/// The [`AreaRule::rate`] of checkpoints without one.
fn all_at_once() -> f32 {
    1.0
}

/// Whether the rate is left out, so that checkpoints without one keep their digest.
fn is_all_at_once(rate: &f32) -> bool {
    *rate == all_at_once()
}

/// Constants of the rule that jelly and rope keep their shape: each particle moves to the position that its neighbours and
/// the rest shape imply.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShapeRule {
    /// Largest strain: stretches of the deformation gradient are limited to 1 - `strain_limit`..1 + `strain_limit`; at least 0,
    /// below 1.
    pub strain_limit: f32,
    /// Number of relaxation sweeps, 1 to 1000.
    pub sweeps: usize,
}

/// Constants of the rule that a body in free flight keeps its momentum and angular momentum.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FlightRule {
    /// Distance from walls that a body in free flight keeps, now and where its mean velocity takes it (cells of the network's
    /// finest level).
    pub wall_distance: f32,
}

/// Constants of the rule that a body which touches a wall and hardly moves comes to rest. The speed of a body is that of its
/// fastest cell, relative to the velocity that gravity adds per frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RestRule {
    /// Distance from a wall below which a body touches it, now or where its mean velocity takes it (cells of the network's
    /// finest level).
    pub wall_distance: f32,
    /// Speed below which the body does not move (relative to the velocity that gravity adds per frame).
    pub asleep_below: f32,
    /// Speed above which the body moves as predicted (relative to the velocity that gravity adds per frame); in between, its
    /// motion is scaled down.
    pub awake_from: f32,
}

/// One of the rules.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Rule {
    /// Bodies of jelly that nothing else is close to move by their elasticity.
    Elastic,
    /// Liquids keep their area.
    Area,
    /// Jelly and rope keep their shape.
    Shape,
    /// Bodies that touch nothing keep momentum and spin.
    Flight,
    /// Bodies that touch a wall and hardly move come to rest.
    Rest,
}

impl Rule {
    /// All rules, in the order in which they run.
    pub const ALL: [Self; 5] = [Self::Elastic, Self::Area, Self::Shape, Self::Flight, Self::Rest];

    /// Its key in `model.toml` and name on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Elastic => "elastic",
            Self::Area => "area",
            Self::Shape => "shape",
            Self::Flight => "flight",
            Self::Rest => "rest",
        }
    }
}

impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Rules {
    /// The rules of new particle models, beside `elastic`, whose constants depend on the material.
    pub const STANDARD: Self = Self {
        elastic: None,
        area: Some(AreaRule {
            cell_width: 2.0,
            fill_limit: 1.25,
            surface_fill: 0.5,
            sweeps: 20,
            relaxation: 1.7,
            longest_shift: 0.5,
            rate: 0.2,
        }),
        shape: Some(ShapeRule { strain_limit: 0.03, sweeps: 5 }),
        flight: Some(FlightRule { wall_distance: 1.5 }),
        rest: Some(RestRule { wall_distance: 1.5, asleep_below: 0.02, awake_from: 0.1 }),
    };

    /// The rules of a new network: [`Rules::STANDARD`] for the particle model, none for the frame model.
    pub fn standard(architecture: Architecture) -> Self {
        match architecture {
            Architecture::Frame => Self::default(),
            Architecture::Particle => Self::STANDARD,
        }
    }

    /// The rules that format version 1 implied: those of a new network, but for the rate of the rule `area` and the speeds of the rule `rest`.
    pub(super) fn of_version_1(architecture: Architecture) -> Self {
        let mut rules = Self::standard(architecture);
        if let Some(area) = &mut rules.area {
            area.rate = all_at_once();
        }
        if let Some(rest) = &mut rules.rest {
            (rest.asleep_below, rest.awake_from) = (0.25, 1.0);
        }
        rules
    }

    /// Whether every rule is off.
    pub fn is_empty(&self) -> bool {
        Rule::ALL.into_iter().all(|rule| !self.has(rule))
    }

    /// Whether a rule is on.
    pub fn has(&self, rule: Rule) -> bool {
        match rule {
            Rule::Elastic => self.elastic.is_some(),
            Rule::Area => self.area.is_some(),
            Rule::Shape => self.shape.is_some(),
            Rule::Flight => self.flight.is_some(),
            Rule::Rest => self.rest.is_some(),
        }
    }

    /// Switches rules off. Returns those that were on, in the order in which they run.
    pub fn disable(&mut self, rules: &[Rule]) -> Vec<Rule> {
        let mut disabled = Rule::ALL.to_vec();
        disabled.retain(|rule| rules.contains(rule) && self.has(*rule));
        disabled.iter().for_each(|rule| self.remove(*rule));
        disabled
    }

    /// Switches a rule off.
    pub fn remove(&mut self, rule: Rule) {
        match rule {
            Rule::Elastic => self.elastic = None,
            Rule::Area => self.area = None,
            Rule::Shape => self.shape = None,
            Rule::Flight => self.flight = None,
            Rule::Rest => self.rest = None,
        }
    }
}

/// Checks the constants, for particles at a distance (domain lengths) and frames of `dt` seconds; those of a network that is conditioned on
/// the stiffness fit every stream.
pub(super) fn check(
    file: &Path,
    rules: &Rules,
    (spacing, dt): (f32, f32),
    is_conditioned: bool,
) -> Result<(), CheckpointError> {
    let reject = |key: &str, found: String, expected: &str| {
        Err(field(file, format!("rules.{key}"), found, expected))
    };
    let number = |key: &str, found: f32, fits: bool, expected: &str| match fits {
        true => Ok(()),
        false => reject(key, found.to_string(), expected),
    };
    let sweeps = |key: &str, found: usize| match found {
        1..=1000 => Ok(()),
        _ => reject(key, found.to_string(), "1 to 1000"),
    };
    // NaN is in none of these ranges.
    let positive = |x: f32| x > 0.0 && x.is_finite();
    let distance = |key: &str, x: f32| number(key, x, (0.0..=64.0).contains(&x), "0 to 64");
    if let Some(rule) = &rules.elastic {
        elastic::check(file, rule, (spacing, dt), is_conditioned)?;
    }
    if let Some(area) = rules.area {
        let AreaRule { cell_width, fill_limit, surface_fill, relaxation, longest_shift, .. } = area;
        let fits = (0.5..=16.0).contains(&cell_width);
        number("area.cell_width", cell_width, fits, "0.5 to 16")?;
        number("area.fill_limit", fill_limit, positive(fill_limit), "a positive number")?;
        let fits = surface_fill > 0.0 && surface_fill <= fill_limit;
        number("area.surface_fill", surface_fill, fits, "above 0, at most rules.area.fill_limit")?;
        sweeps("area.sweeps", area.sweeps)?;
        let fits = relaxation > 0.0 && relaxation < 2.0;
        number("area.relaxation", relaxation, fits, "above 0 and below 2")?;
        number("area.longest_shift", longest_shift, positive(longest_shift), "a positive number")?;
        let fits = area.rate > 0.0 && area.rate <= 1.0;
        number("area.rate", area.rate, fits, "above 0, at most 1")?;
    }
    if let Some(ShapeRule { strain_limit, sweeps: count }) = rules.shape {
        let fits = (0.0..1.0).contains(&strain_limit);
        number("shape.strain_limit", strain_limit, fits, "at least 0 and below 1")?;
        sweeps("shape.sweeps", count)?;
    }
    if let Some(FlightRule { wall_distance }) = rules.flight {
        distance("flight.wall_distance", wall_distance)?;
    }
    if let Some(RestRule { wall_distance, asleep_below, awake_from }) = rules.rest {
        distance("rest.wall_distance", wall_distance)?;
        let fits = asleep_below >= 0.0 && asleep_below.is_finite();
        number("rest.asleep_below", asleep_below, fits, "at least 0")?;
        let fits = awake_from > asleep_below && awake_from.is_finite();
        number("rest.awake_from", awake_from, fits, "above rules.rest.asleep_below")?;
    }
    Ok(())
}
