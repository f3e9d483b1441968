//! Where scenes come from: drawn from a seed, or written in a file.

use eddy_mpm::{Extent, Scene};

/// Where scenes come from.
#[derive(Clone, Debug)]
pub enum Source {
    /// Drawn from a seed.
    Random(Extent),
    /// Written down: always the same scene.
    Written(Box<Scene>),
}

impl Source {
    /// The particles of random scenes, where they are not the usual number.
    pub(super) fn unusual_particles(&self) -> Option<usize> {
        match self {
            Self::Random(extent) if *extent != Extent::usual(extent.preset()) => {
                Some(extent.particles())
            }
            Self::Random(_) | Self::Written(_) => None,
        }
    }

    /// Scene number `index` of those asked for; one that is written down has its own id.
    pub(super) fn scene(&self, seed: u64, index: u64) -> Scene {
        match self {
            Self::Random(extent) => Scene::generate_in(extent, seed, index),
            Self::Written(scene) => Scene::clone(scene),
        }
    }
}
