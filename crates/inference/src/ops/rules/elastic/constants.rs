//! `[rules.elastic]` of `model.toml`: the constants of the rule that jelly moves by its elasticity ([`lattice`](crate::kernels::lattice)).

use serde::{Deserialize, Serialize};

use super::{Network, WrongConstant};
use crate::kernels::lattice;
use eddy_frames::decimal;

/// Young's modulus of jelly relative to the stiffness of a stream, as in the solver.
pub const JELLY_MODULUS: f32 = 0.3;

/// Constants of the rule that a body of jelly moves by its own stress and the walls while nothing else is close to it and its lattice was not wrong in
/// the last frame, whatever was predicted.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ElasticRule {
    /// Young's modulus of jelly (density x velocity^2), at density 1; in a network that is conditioned on the stiffness, relative to a stream's.
    pub modulus: f32,
    /// Poisson's ratio of jelly, at least 0 and below 0.5.
    pub poisson_ratio: f32,
    /// Width of the elements (spacings at rest), 2 to 1024; in a network that is conditioned on the stiffness, at least.
    pub cell_width: f32,
    /// Steps per frame at least, 1 to 256; a body that is narrow, or has corners with few particles, has as many as it needs.
    pub steps: usize,
    /// Viscosity, relative to density x speed of pressure waves x width of an element, 0 to 0.5.
    pub viscosity: f32,
    /// Distance from the effective walls within which they push jelly away (spacings at rest), 0 to 16.
    pub wall_distance: f32,
    /// Stiffness of that push, relative to the modulus of pressure waves over the square of 3.5 spacings, 0 to 4.
    pub wall_stiffness: f32,
    /// Share of the push while jelly moves away from the wall, 0 to 1.
    pub rebound: f32,
    /// Distance of any other particle below which a body moves as predicted (spacings at rest), 0 to 64.
    pub clear_distance: f32,
    /// Stretch above which a body is torn, and moves as predicted, 1 to 4; while walls push it, it may have twice the strain; in a
    /// network that is conditioned on the stiffness, at most.
    pub most_stretch: f32,
    /// Squared error of a lattice's nodes in the last frame, relative to the square of what it moved them beside free fall, above which it moves nothing, at
    /// least 0; if it is not given, there is no such limit.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub most_error: Option<f32>,
    /// Error of the nodes (root of the mean square, spacings at rest) whose square is added to that limit, at least 0.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub small_error: f32,
}

fn is_zero(number: &f32) -> bool {
    *number == 0.0
}

impl ElasticRule {
    /// The most steps per frame.
    pub const MOST_STEPS: usize = lattice::MOST_STEPS;
    /// Modulus up to which the maximum stretch is as given: that of jelly at E = 1e3 (density x velocity^2).
    const SOFT_MODULUS: f32 = 300.0;
    /// Steps in the time that a pressure wave takes to cross an element, with which they are accurate.
    const ACCURATE_STEPS: f32 = 2.25;
    /// Width that the stiffness of walls refers to: two parts of a surface (spacings at rest).
    pub(crate) const SURFACE_WIDTH: f32 = 2.0 * lattice::PART_WIDTH;

    /// For jelly of this modulus (density x velocity^2), particles at this distance (domain lengths) and frames of `dt` seconds.
    pub fn new(modulus: f32, spacing: f32, dt: f32) -> Self {
        Self::default().with_modulus(modulus, spacing, dt)
    }

    /// For jelly of another modulus. Where 25 steps are too few for elements 3.5 spacings wide, both grow: stiffer by r^2, jelly has elements
    /// wider by r^(2/3), and r^(1/3) times as many steps, at most [`ElasticRule::MOST_STEPS`]. The maximum strain falls with the root of the
    /// modulus from that of soft matter on, so that a stretched body, however stiff, has no more elastic energy to set free.
    #[must_use]
    pub fn with_modulus(mut self, modulus: f32, spacing: f32, dt: f32) -> Self {
        self.modulus = modulus;
        let steps = Self::ACCURATE_STEPS * self.crossings(spacing, dt);
        let ratio = (steps / self.steps as f32).max(1.0);
        self.cell_width *= ratio.powf(2.0 / 3.0);
        let steps = (self.steps as f32 * ratio.cbrt()).ceil() as usize;
        self.steps = steps.min(Self::MOST_STEPS);
        let softness = (Self::SOFT_MODULUS / modulus).sqrt().min(1.0);
        self.most_stretch = 1.0 + softness * (self.most_stretch - 1.0);
        self
    }

    /// The stiffness of a stream whose jelly has this modulus (density x velocity^2).
    pub fn stiffness(&self) -> f32 {
        (decimal(self.modulus) / decimal(JELLY_MODULUS)) as f32
    }

    /// Elements that a pressure wave crosses in a frame of `dt` seconds.
    fn crossings(&self, spacing: f32, dt: f32) -> f32 {
        dt * self.wave_speed() / (self.cell_width * spacing)
    }

    /// Speed of pressure waves (domain lengths per second).
    pub(crate) fn wave_speed(&self) -> f32 {
        let [mu, lambda] = self.lame();
        (2.0 * mu + lambda).sqrt()
    }

    /// Whether the steps are stable: at least one in the time that a pressure wave takes to cross an element.
    pub fn is_stable(&self, spacing: f32, dt: f32) -> bool {
        self.steps as f32 >= self.crossings(spacing, dt)
    }

    /// Checks the constants; those of a network that is conditioned on the stiffness fit every stream.
    pub(super) fn check_constants(&self, network: &Network) -> Result<(), WrongConstant> {
        let Self { modulus, poisson_ratio, cell_width, steps, wall_distance, .. } = *self;
        let Self { viscosity, wall_stiffness, rebound, .. } = *self;
        let Self { clear_distance, most_stretch, most_error, small_error, .. } = *self;
        let most_error = most_error.unwrap_or_default();
        let positive = |error: f32| error >= 0.0 && error.is_finite();
        // NaN is in none of these ranges.
        let number = WrongConstant::unless::<f32>;
        number(modulus > 0.0 && modulus.is_finite(), "modulus", modulus, "a positive number")?;
        let expected = "at least 0, below 0.5";
        number((0.0..0.5).contains(&poisson_ratio), "poisson_ratio", poisson_ratio, expected)?;
        number((2.0..=1024.0).contains(&cell_width), "cell_width", cell_width, "2 to 1024")?;
        number((0.0..=0.5).contains(&viscosity), "viscosity", viscosity, "0 to 0.5")?;
        number((0.0..=16.0).contains(&wall_distance), "wall_distance", wall_distance, "0 to 16")?;
        let fits = (0.0..=4.0).contains(&wall_stiffness);
        number(fits, "wall_stiffness", wall_stiffness, "0 to 4")?;
        number((0.0..=1.0).contains(&rebound), "rebound", rebound, "0 to 1")?;
        let fits = (0.0..=64.0).contains(&clear_distance);
        number(fits, "clear_distance", clear_distance, "0 to 64")?;
        number((1.0..=4.0).contains(&most_stretch), "most_stretch", most_stretch, "1 to 4")?;
        number(positive(most_error), "most_error", most_error, "a number of at least 0")?;
        number(positive(small_error), "small_error", small_error, "a number of at least 0")?;
        let fits = (1..=Self::MOST_STEPS).contains(&steps);
        WrongConstant::unless(fits, "steps", steps, "1 to 256")?;
        let fits = network.is_conditioned || self.is_stable(network.spacing, network.dt);
        let expected =
            "at least one step in the time that a pressure wave takes to cross an element";
        WrongConstant::unless(fits, "steps", steps, expected)
    }

    /// Shear modulus and first Lame parameter (density x velocity^2).
    pub(crate) fn lame(&self) -> [f32; 2] {
        let Self { modulus, poisson_ratio: nu, .. } = *self;
        [modulus / (2.0 * (1.0 + nu)), modulus * nu / ((1.0 + nu) * (1.0 - 2.0 * nu))]
    }
}

impl Default for ElasticRule {
    /// For jelly whose modulus is .3 of a stream's stiffness.
    fn default() -> Self {
        Self {
            modulus: JELLY_MODULUS,
            poisson_ratio: 0.2,
            cell_width: 3.5,
            steps: 25,
            viscosity: 0.07,
            wall_distance: 2.85,
            wall_stiffness: 1.0,
            rebound: 0.8,
            clear_distance: 7.0,
            most_stretch: 1.25,
            most_error: Some(0.1),
            small_error: 0.035,
        }
    }
}
