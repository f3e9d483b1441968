//! `[elastic]` of `model.toml`: the constants of the elastic impulse of jelly ([`lattice`](crate::kernels::lattice)).

use std::path::Path;

use serde::{Deserialize, Serialize};

use super::{CheckpointError, description::field};
use crate::{
    engine::Ballistic,
    kernels::lattice::{Contact, Elasticity, Walls},
};

/// Constants of the impulse that its own stress and the walls give jelly within a frame, after which the network sees it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ElasticOptions {
    /// Young's modulus of jelly (density x velocity^2), at density 1.
    pub modulus: f32,
    /// Poisson's ratio of jelly, at least 0 and below 0.5.
    pub poisson_ratio: f32,
    /// Width of the elements (spacings at rest), 2 to 32.
    pub cell_width: f32,
    /// Steps per frame, 1 to 256.
    pub steps: usize,
    /// Viscosity, relative to density x speed of pressure waves x width of an element, 0 to 0.5.
    pub viscosity: f32,
    /// Distance from the effective walls within which they push jelly away (spacings at rest), 0 to 16.
    pub wall_distance: f32,
    /// Stiffness of that push, relative to an element's, 0 to 4.
    pub wall_stiffness: f32,
    /// Share of the push while jelly moves away from the wall, 0 to 1.
    pub rebound: f32,
    /// Distance of points at the surfaces of two bodies, below which they are in contact (spacings at rest), 0 to 16.
    pub contact_distance: f32,
    /// Stiffness of what keeps them apart, relative to an element's, 0 to 1.
    pub contact_stiffness: f32,
    /// Viscosity that makes them move alike, relative to density x speed of pressure waves x width of an element, 0 to 4.
    pub contact_viscosity: f32,
}

impl ElasticOptions {
    /// The most steps per frame.
    pub const MOST_STEPS: usize = 256;
    /// Steps in the time that a pressure wave takes to cross an element.
    const STEPS_PER_CROSSING: f32 = 2.25;

    /// For jelly of this modulus (density x velocity^2), particles at this distance (domain lengths) and frames of `dt` seconds: with as
    /// many steps as are accurate, at most [`ElasticOptions::MOST_STEPS`].
    pub fn new(modulus: f32, spacing: f32, dt: f32) -> Self {
        let mut options = Self {
            modulus,
            poisson_ratio: 0.2,
            cell_width: 3.5,
            steps: 1,
            viscosity: 0.07,
            wall_distance: 2.85,
            wall_stiffness: 1.0,
            rebound: 0.8,
            contact_distance: 3.5,
            contact_stiffness: 0.2,
            contact_viscosity: 4.0,
        };
        let steps = (Self::STEPS_PER_CROSSING * options.crossings(spacing, dt)).ceil() as usize;
        options.steps = steps.clamp(1, Self::MOST_STEPS);
        options
    }

    /// Elements that a pressure wave crosses in a frame of `dt` seconds.
    fn crossings(&self, spacing: f32, dt: f32) -> f32 {
        let [mu, lambda] = self.lame();
        dt * (2.0 * mu + lambda).sqrt() / (self.cell_width * spacing)
    }

    /// Whether the steps are stable: at least one in the time that a pressure wave takes to cross an element.
    pub fn is_stable(&self, spacing: f32, dt: f32) -> bool {
        self.steps as f32 >= self.crossings(spacing, dt)
    }

    /// Shear modulus and first Lame parameter (density x velocity^2).
    fn lame(&self) -> [f32; 2] {
        let Self { modulus, poisson_ratio: nu, .. } = *self;
        [modulus / (2.0 * (1.0 + nu)), modulus * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))]
    }

    /// The law for frames with this ballistic step, with particles at this distance (domain lengths).
    pub fn elasticity(&self, ballistic: &Ballistic, spacing: f32) -> Elasticity {
        let &Ballistic { gravity, dt, .. } = ballistic;
        let Self { viscosity, wall_stiffness, rebound, steps, .. } = *self;
        let lame = self.lame();
        let contact = Contact {
            distance: self.contact_distance * spacing,
            stiffness: self.contact_stiffness,
            viscosity: self.contact_viscosity,
        };
        Elasticity { lame, viscosity, wall_stiffness, rebound, contact, steps, dt, gravity }
    }

    /// Where jelly touches the walls of a ballistic step, with particles at this distance (domain lengths).
    pub fn walls(&self, ballistic: &Ballistic, spacing: f32) -> Walls {
        let distance = self.wall_distance * spacing;
        Walls {
            lower: ballistic.lower.map(|wall| wall + distance),
            upper: ballistic.upper.map(|wall| wall - distance),
        }
    }
}

/// Checks the constants.
pub(super) fn check(
    file: &Path,
    options: &ElasticOptions,
    spacing: f32,
    dt: f32,
) -> Result<(), CheckpointError> {
    let ElasticOptions { modulus, poisson_ratio, cell_width, steps, wall_distance, .. } = *options;
    let ElasticOptions { viscosity, wall_stiffness, rebound, .. } = *options;
    let ElasticOptions { contact_distance, contact_stiffness, contact_viscosity, .. } = *options;
    // NaN is in none of these ranges.
    let checks = [
        ("modulus", modulus, modulus > 0.0 && modulus.is_finite(), "a positive number"),
        (
            "poisson_ratio",
            poisson_ratio,
            (0.0..0.5).contains(&poisson_ratio),
            "at least 0, below 0.5",
        ),
        ("cell_width", cell_width, (2.0..=32.0).contains(&cell_width), "2 to 32"),
        ("viscosity", viscosity, (0.0..=0.5).contains(&viscosity), "0 to 0.5"),
        ("wall_distance", wall_distance, (0.0..=16.0).contains(&wall_distance), "0 to 16"),
        ("wall_stiffness", wall_stiffness, (0.0..=4.0).contains(&wall_stiffness), "0 to 4"),
        ("rebound", rebound, (0.0..=1.0).contains(&rebound), "0 to 1"),
        ("contact_distance", contact_distance, (0.0..=16.0).contains(&contact_distance), "0 to 16"),
        (
            "contact_stiffness",
            contact_stiffness,
            (0.0..=1.0).contains(&contact_stiffness),
            "0 to 1",
        ),
        (
            "contact_viscosity",
            contact_viscosity,
            (0.0..=4.0).contains(&contact_viscosity),
            "0 to 4",
        ),
    ];
    for (key, found, fits, expected) in checks {
        if !fits {
            return Err(field(file, format!("elastic.{key}"), found.to_string(), expected));
        }
    }
    if !(1..=ElasticOptions::MOST_STEPS).contains(&steps) {
        return Err(field(file, "elastic.steps", steps.to_string(), "1 to 256"));
    }
    if !options.is_stable(spacing, dt) {
        let expected =
            "at least one step in the time that a pressure wave takes to cross an element";
        return Err(field(file, "elastic.steps", steps.to_string(), expected));
    }
    Ok(())
}
