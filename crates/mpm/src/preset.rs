//! Presets of random scenes, with the settings that all scenes of a preset share.

use std::fmt;

use serde::{Deserialize, Serialize};

use super::{
    material::Materials,
    scene::{Frames, Scene},
};

/// Default number of particles of a random scene.
pub const PARTICLES: usize = 2500;

/// A preset of random scenes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "kebab-case")]
pub enum Preset {
    /// Bodies of two of the four materials, 64 x 64 cells, 10 s.
    MultiMaterial,
    /// Bodies of liquid, 128 x 128 cells, 5 to 25 s: until little moves.
    Fluid,
    /// The multi-material scenes with a hundred times the stiffness (E = 1e5).
    Stiff,
    /// Liquid, snow, jelly, rope and two materials together, in turn, 64 x 64 cells, 4.8 s: until
    /// little moves, and a while longer. The particle model is trained and evaluated on it.
    Kinds,
    /// Bodies of sand, in turn alone and with liquid, snow, jelly or rope; otherwise as `kinds`.
    Sand,
    /// A blade pushes a heap of sand, liquid, snow or jelly, in turn, 64 x 64 cells, 4.8 s.
    Push,
    /// A cup pours sand, liquid, snow or jelly, in turn, over a bed of the same, 64 x 64 cells, 4.8 s.
    Pour,
    /// A bucket scoops sand, liquid or snow, in turn, out of a bed, 64 x 64 cells, 4.8 s.
    Scoop,
}

impl Preset {
    /// Its name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::MultiMaterial => "multi-material",
            Self::Fluid => "fluid",
            Self::Stiff => "stiff",
            Self::Kinds => "kinds",
            Self::Sand => "sand",
            Self::Push => "push",
            Self::Pour => "pour",
            Self::Scoop => "scoop",
        }
    }

    /// Cells on a side of the grid.
    pub fn cells(self) -> u32 {
        match self {
            Self::Fluid => 128,
            _ => 64,
        }
    }

    /// Whether a tool moves in its scenes.
    pub fn has_tools(self) -> bool {
        matches!(self, Self::Push | Self::Pour | Self::Scoop)
    }

    /// Cell width (domain lengths).
    pub fn dx(self) -> f32 {
        1.0 / self.cells() as f32
    }

    /// Distance between neighbouring particles of an undeformed body: half a cell (domain lengths).
    pub fn spacing(self) -> f32 {
        0.5 * self.dx()
    }

    /// A scene with the preset's settings, without bodies.
    pub(super) fn empty_scene(self) -> Scene {
        let frames = match self {
            Self::MultiMaterial | Self::Stiff => Frames::default(),
            Self::Fluid => Frames { duration: 25.0, shortest: Some(5.0), ..Frames::default() },
            Self::Kinds | Self::Sand | Self::Push | Self::Pour | Self::Scoop => {
                Frames { duration: 4.8, ..Frames::default() }
            }
        };
        let materials = match self {
            Self::Stiff => Materials { stiffness: 1e5, ..Materials::default() },
            _ => Materials::default(),
        };
        Scene { cell_width: self.dx(), frames, materials, ..Scene::default() }
    }
}

impl fmt::Display for Preset {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
