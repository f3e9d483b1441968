//! The two kinds of scenes, with the numbers that all scenes of a kind share.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Particles of every scene.
pub const PARTICLES: usize = 2500;

/// A kind of scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// Bodies of one or two of the four materials, 64 x 64 cells, 10 s.
    MultiMaterial,
    /// Bodies of liquid, 128 x 128 cells, 5 to 25 s: until little moves.
    Fluid,
}

/// How long the scenes of a preset last when nothing else is asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Length {
    /// No scene is shorter (s).
    pub shortest: f64,
    /// No scene is longer (s).
    pub longest: f64,
    /// In between, a scene ends when its mean kinetic energy per mass, `|v|^2 / 2`, falls below
    /// this (domain lengths^2 per s^2).
    pub rest: f64,
}

impl Preset {
    /// The preset's word, as on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::MultiMaterial => "multi-material",
            Self::Fluid => "fluid",
        }
    }

    /// Cells on a side of the grid.
    pub fn cells(self) -> u32 {
        match self {
            Self::MultiMaterial => 64,
            Self::Fluid => 128,
        }
    }

    /// Cell width (domain lengths).
    pub fn dx(self) -> f32 {
        1.0 / self.cells() as f32
    }

    /// Distance between neighbouring particles of an undeformed body: half a cell (domain lengths).
    pub fn spacing(self) -> f32 {
        0.5 * self.dx()
    }

    /// How long scenes last.
    pub fn length(self) -> Length {
        match self {
            Self::MultiMaterial => Length { shortest: 10.0, longest: 10.0, rest: 0.0 },
            Self::Fluid => Length { shortest: 5.0, longest: 25.0, rest: 1e-3 },
        }
    }
}

impl fmt::Display for Preset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
