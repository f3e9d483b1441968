//! `[rules]` of `model.toml`: the constants of the rules that correct the particle model's predictions ([`rules`](crate::ops::rules)).
//! The digest so covers everything that changes a prediction.

use std::path::Path;

use super::{Architecture, CheckpointError, Description, description::field};
use crate::ops::rules::{AreaRule, Network, Rules};

impl Rules {
    /// The rules of a new network: [`Rules::STANDARD`] for the particle model, none for the frame model.
    pub fn standard(architecture: Architecture) -> Self {
        match architecture {
            Architecture::Frame => Self::default(),
            Architecture::Particle => Self::STANDARD,
        }
    }

    /// The rules that format version 1 implied: four of those of a new network, but for the rate of the rule `area` and the speeds of
    /// the rule `rest`.
    pub(super) fn of_version_1(architecture: Architecture) -> Self {
        let Self { area, shape, flight, rest, .. } = Self::standard(architecture);
        let mut rules = Self { area, shape, flight, rest, ..Self::default() };
        if let Some(area) = &mut rules.area {
            area.rate = AreaRule::ALL_AT_ONCE;
        }
        if let Some(rest) = &mut rules.rest {
            (rest.asleep_below, rest.awake_from) = (0.25, 1.0);
        }
        rules
    }
}

/// Checks the constants of the rules.
pub(super) fn check(file: &Path, description: &Description) -> Result<(), CheckpointError> {
    description.rules.check(&Network::of(description)).map_err(|(rule, wrong)| {
        field(file, format!("rules.{rule}.{}", wrong.key), wrong.found, wrong.expected)
    })
}
