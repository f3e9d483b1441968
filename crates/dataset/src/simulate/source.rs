//! Source of scenes: random from a seed, or a scene file.

use eddy_mpm::{Extent, Scene};

/// Source of scenes.
#[derive(Clone, Debug)]
pub enum Source {
    /// Random scenes from a seed.
    Random(Extent),
    /// A fixed scene, from a file.
    Written(Box<Scene>),
}

impl Source {
    /// What random scenes have in common.
    pub(super) fn extent(&self) -> Option<&Extent> {
        match self {
            Self::Random(extent) => Some(extent),
            Self::Written(_) => None,
        }
    }

    /// The number of particles of random scenes, unless it is the preset's default.
    pub(super) fn unusual_particles(&self) -> Option<usize> {
        let extent = self.extent()?;
        let particles = extent.particles();
        (particles != Extent::usual(extent.preset()).particles()).then_some(particles)
    }

    /// Scene `index` of the request; a scene from a file keeps its own id.
    pub(super) fn scene(&self, seed: u64, index: u64) -> Scene {
        match self {
            Self::Random(extent) => Scene::generate_in(extent, seed, index),
            Self::Written(scene) => Scene::clone(scene),
        }
    }
}
