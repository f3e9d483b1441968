//! The order in which a scene numbers its particles.

use serde::{Deserialize, Serialize};

use super::particle::Particle;

/// Bits of a cell's number along an axis of the curve.
const CURVE_BITS: u8 = 16;

/// The order in which a scene numbers the particles of its bodies.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum ParticleOrder {
    /// Body by body, row by row.
    #[default]
    Bodies,
    /// Along a Hilbert curve through their initial positions: neighbours mostly have neighbouring numbers, and the same number
    /// is at a similar place in scenes that fill the domain alike.
    Curve,
}

impl ParticleOrder {
    /// Sorts particles, `spacing` apart (domain lengths).
    pub(super) fn sort<T>(self, particles: &mut [(Particle, T)], spacing: f32) {
        if self == Self::Bodies {
            return;
        }
        particles.sort_by_cached_key(|(particle, _)| {
            // The cast saturates.
            let [x, y] = particle.position.map(|x| u32::from((x / spacing) as u16));
            fast_hilbert::xy2h(x, y, CURVE_BITS)
        });
    }
}

/// The value that is omitted from files.
#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde passes a reference")]
pub(super) fn is_usual(order: &ParticleOrder) -> bool {
    *order == ParticleOrder::Bodies
}

#[cfg(test)]
mod tests {
    use super::{
        super::{Preset, Scene},
        *,
    };

    #[test]
    fn a_curve_renumbers_the_same_particles_so_that_neighbours_follow_each_other() {
        let bodies = Scene::generate(Preset::Fluid, 1, 3);
        let curve = Scene { order: ParticleOrder::Curve, ..bodies.clone() };
        let [bodies, curve] = [&bodies, &curve].map(|scene| scene.particles().unwrap());
        let sorted = |particles: &[Particle]| {
            let mut positions: Vec<_> =
                particles.iter().map(|particle| particle.position.map(f32::to_bits)).collect();
            positions.sort_unstable();
            positions
        };
        assert_eq!(sorted(&bodies), sorted(&curve));
        let far = |particles: &[Particle]| {
            let apart = |pair: &[Particle]| {
                let [a, b] = [pair[0].position, pair[1].position];
                (a[0] - b[0]).hypot(a[1] - b[1])
            };
            particles.windows(2).filter(|pair| apart(pair) > 0.02).count()
        };
        assert!(far(&curve) < 100, "{} of 2,499 steps are far", far(&curve));
    }
}
