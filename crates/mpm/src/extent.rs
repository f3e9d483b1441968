//! How many particles a random scene has, and the domain that they get.
//!
//! As many particles to an area, and bodies as large, falls as high and as fast as in a scene of the
//! usual size: a domain for more particles is wider, not higher, and side by side in it are several
//! sets of bodies, each what a scene of the usual size would have.

use super::{
    error::MpmError,
    grid::GridShape,
    preset::{PARTICLES, Preset},
};

/// The fewest particles of a random scene: the smaller part of two materials is a rope five
/// particles thick and three times as long then.
const FEWEST: usize = 250;
/// Cells along x that a grid has at most.
const MOST_COLUMNS: usize = 65_535;

/// How many particles a random scene has, and the domain that they get: 1 high, and 1 wide for up
/// to 2,500 particles, else as many times as wide, rounded up to whole cells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    preset: Preset,
    particles: usize,
}

impl Extent {
    /// The usual one: 2,500 particles in the unit square.
    pub fn usual(preset: Preset) -> Self {
        Self { preset, particles: PARTICLES }
    }

    /// That of so many particles.
    ///
    /// # Errors
    /// [`MpmError::Field`] for too few to make bodies of, and for more than a grid has columns for.
    pub fn of(preset: Preset, particles: usize) -> Result<Self, MpmError> {
        let most = MOST_COLUMNS / preset.cells() as usize * PARTICLES;
        if (FEWEST..=most).contains(&particles) {
            return Ok(Self { preset, particles });
        }
        Err(MpmError::Field {
            field: "particles".into(),
            found: particles.to_string(),
            expected: format!("{FEWEST} to {most} in a scene of {preset}"),
        })
    }

    /// The kind of scenes.
    pub fn preset(&self) -> Preset {
        self.preset
    }

    /// How many particles.
    pub fn particles(&self) -> usize {
        self.particles
    }

    /// The grid that covers the domain.
    pub(super) fn grid(&self) -> GridShape {
        let cells = self.preset.cells();
        let columns = (self.particles * cells as usize).div_ceil(PARTICLES) as u32;
        GridShape { cells: [columns.max(cells), cells], dx: self.preset.dx() }
    }

    /// How many sets of bodies are side by side: as few as have at most 2,500 particles each.
    pub(super) fn sets(&self) -> usize {
        self.particles.div_ceil(PARTICLES)
    }

    /// Particles of a set of bodies, the sets numbered from 0. They differ by one at most.
    pub(super) fn particles_of(&self, set: usize) -> usize {
        let (each, over) = (self.particles / self.sets(), self.particles % self.sets());
        each + usize::from(set < over)
    }

    /// Width of the part of the domain that a set gets (domain lengths).
    pub(super) fn width_of_a_set(&self) -> f32 {
        self.grid().size()[0] / self.sets() as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_domain_is_as_wide_as_its_particles_are_many_and_no_narrower_than_1() {
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
    fn too_few_particles_and_too_many_for_a_grid_are_refused() {
        for (preset, particles) in
            [(Preset::Kinds, 0), (Preset::Kinds, 249), (Preset::Fluid, usize::MAX)]
        {
            let said = Extent::of(preset, particles).unwrap_err().to_string();
            assert!(said.starts_with(&format!("particles: found {particles}, expected 250 to ")));
        }
        // The widest of all is one that a grid covers.
        for (preset, most) in [(Preset::Kinds, 2_557_500), (Preset::Fluid, 1_277_500)] {
            let extent = Extent::of(preset, most).unwrap();
            assert!(extent.grid().cells[0] < 65_536);
            assert!(Extent::of(preset, most + 1).is_err());
        }
    }
}
