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
    /// The number of particles of random scenes, unless it is the preset's default.
    pub(super) fn unusual_particles(&self) -> Option<usize> {
        match self {
            Self::Random(extent) => {
                let particles = extent.particles();
                (particles != Extent::usual(extent.preset()).particles()).then_some(particles)
            }
            Self::Written(_) => None,
        }
    }

    /// Whether all random scenes have the same bodies.
    pub(super) fn same_bodies(&self) -> bool {
        matches!(self, Self::Random(extent) if extent.same_bodies())
    }

    /// The range of the fraction of the domain that the bodies of a random scene fill.
    pub(super) fn fill(&self) -> Option<[f32; 2]> {
        match self {
            Self::Random(extent) => extent.fill(),
            Self::Written(_) => None,
        }
    }

    /// The range of the stiffness of random scenes.
    pub(super) fn stiffness(&self) -> Option<[f32; 2]> {
        match self {
            Self::Random(extent) => extent.stiffness(),
            Self::Written(_) => None,
        }
    }

    /// Scene `index` of the request; a scene from a file keeps its own id.
    pub(super) fn scene(&self, seed: u64, index: u64) -> Scene {
        match self {
            Self::Random(extent) => Scene::generate_in(extent, seed, index),
            Self::Written(scene) => Scene::clone(scene),
        }
    }
}
