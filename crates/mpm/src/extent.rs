//! What random scenes have in common: the number of particles and the domain for them, the range of their stiffness.
//!
//! Density, body sizes, fall heights and speeds are independent of the number of particles: the domain for more particles
//! is wider, not higher, and contains several sets of bodies side by side, each like a scene of the default size.

use super::{
    error::MpmError,
    grid::GridShape,
    preset::{PARTICLES, Preset},
    scene::MAX_STIFFNESS,
};

/// Minimum number of particles of a random scene: the smaller share of two materials is then a rope five particles thick
/// and three times as long.
const MIN_PARTICLES: usize = 250;
/// Maximum number of cells along x.
const MAX_COLUMNS: usize = 65_535;

/// What random scenes have in common: the number of particles, whether all scenes have the same bodies, the range of their
/// stiffness, and the domain: height 1, width 1 for up to 2,500 particles and proportional to their number above, rounded up to
/// whole cells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    preset: Preset,
    particles: usize,
    same_bodies: bool,
    stiffness: Option<[f32; 2]>,
}

impl Extent {
    /// The default: 2,500 particles in the unit square.
    pub fn usual(preset: Preset) -> Self {
        Self { preset, particles: PARTICLES, same_bodies: false, stiffness: None }
    }

    /// The extent for a number of particles.
    ///
    /// # Errors
    /// [`MpmError::Field`] for too few particles to form bodies, or more than a grid has columns for.
    pub fn of(preset: Preset, particles: usize) -> Result<Self, MpmError> {
        let most = MAX_COLUMNS / preset.cells() as usize * PARTICLES;
        if (MIN_PARTICLES..=most).contains(&particles) {
            return Ok(Self { particles, ..Self::usual(preset) });
        }
        Err(MpmError::Field {
            field: "particles".into(),
            found: particles.to_string(),
            expected: format!("{MIN_PARTICLES} to {most} in a scene of {preset}"),
        })
    }

    /// The same, with the materials, shapes, places and angles of bodies that scene 0 has; only their velocities and the
    /// attractor differ.
    #[must_use]
    pub fn with_same_bodies(self) -> Self {
        Self { same_bodies: true, ..self }
    }

    /// The same, with a random Young's modulus for each scene: its logarithm is uniform in a range (density x velocity^2).
    ///
    /// # Errors
    /// [`MpmError::Field`] unless the range goes from a positive number to a larger one, at most 1e9.
    pub fn with_stiffness(self, range: [f32; 2]) -> Result<Self, MpmError> {
        let [low, high] = range;
        if low > 0.0 && low < high && f64::from(high) <= MAX_STIFFNESS {
            return Ok(Self { stiffness: Some(range), ..self });
        }
        Err(MpmError::Field {
            field: "stiffness".into(),
            found: format!("{low}..{high}"),
            expected: format!("a positive number and a larger one, at most {MAX_STIFFNESS:e}"),
        })
    }

    /// The range of the stiffness, unless it is the preset's.
    pub fn stiffness(&self) -> Option<[f32; 2]> {
        self.stiffness
    }

    /// Whether all scenes have the same bodies, at the same places.
    pub fn same_bodies(&self) -> bool {
        self.same_bodies
    }

    /// The preset.
    pub fn preset(&self) -> Preset {
        self.preset
    }

    /// Number of particles.
    pub fn particles(&self) -> usize {
        self.particles
    }

    /// The grid that covers the domain.
    pub(super) fn grid(&self) -> GridShape {
        let cells = self.preset.cells();
        let columns = (self.particles * cells as usize).div_ceil(PARTICLES) as u32;
        GridShape { cells: [columns.max(cells), cells], dx: self.preset.dx() }
    }

    /// Number of sets of bodies side by side, of at most 2,500 particles each.
    pub(super) fn sets(&self) -> usize {
        self.particles.div_ceil(PARTICLES)
    }

    /// Number of particles of a set of bodies. Sets differ by at most one.
    pub(super) fn particles_of(&self, set: usize) -> usize {
        let (each, over) = (self.particles / self.sets(), self.particles % self.sets());
        each + usize::from(set < over)
    }

    /// Width of the part of the domain for one set (domain lengths).
    pub(super) fn width_of_a_set(&self) -> f32 {
        self.grid().size()[0] / self.sets() as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_width_of_a_domain_is_proportional_to_its_particles_and_at_least_1() {
        for (particles, width, sets) in [
            (250, 1.0, 1),
            (2500, 1.0, 1),
            (2501, 1.0 + 1.0 / 64.0, 2),
            (4000, 1.0 + 39.0 / 64.0, 2),
            (10_000, 4.0, 4),
            (100_000, 40.0, 40),
        ] {
            let extent = Extent::of(Preset::Kinds, particles).unwrap();
            assert_eq!((extent.grid().size(), extent.sets()), ([width, 1.0], sets), "{particles}");
            let shares: Vec<usize> = (0..sets).map(|set| extent.particles_of(set)).collect();
            assert_eq!(shares.iter().sum::<usize>(), particles);
            assert!(shares.iter().all(|share| shares[0] - share <= 1), "{shares:?}");
        }
    }

    #[test]
    fn too_few_and_too_many_particles_are_rejected() {
        for (preset, particles) in
            [(Preset::Kinds, 0), (Preset::Kinds, 249), (Preset::Fluid, usize::MAX)]
        {
            let said = Extent::of(preset, particles).unwrap_err().to_string();
            assert!(said.starts_with(&format!("particles: found {particles}, expected 250 to ")));
        }
        // The widest domain fits the largest grid.
        for (preset, most) in [(Preset::Kinds, 2_557_500), (Preset::Fluid, 1_277_500)] {
            let extent = Extent::of(preset, most).unwrap();
            assert!(extent.grid().cells[0] < 65_536);
            assert!(Extent::of(preset, most + 1).is_err());
        }
    }
}
