//! What random scenes have in common: the number of particles and the domain for them, the ranges of their fill and stiffness.
//!
//! Density, body sizes, fall heights and speeds are independent of the number of particles: the domain for more particles
//! is wider, not higher, and contains several sets of bodies side by side, each like a scene of the default size. With a range of
//! the fill, the domain stays the unit square, and bodies are larger or smaller.

use super::{
    error::MpmError,
    grid::GridShape,
    preset::{PARTICLES, Preset},
    scene::MAX_STIFFNESS,
};

/// Minimum number of particles of a random scene: the smaller share of two materials is then a rope five particles thick
/// and three times as long.
const MIN_PARTICLES: usize = 250;
/// Range of the lower end of a fill: from about [`MIN_PARTICLES`] on a grid of 64 x 64 cells, to one with which every scene finds
/// places for its bodies, so that a fill that is drawn again and again fits in the end.
const LOW_FILL: [f32; 2] = [0.02, 0.15];
/// Maximum fill: a body of anything but rope still fits.
const MAX_FILL: f32 = 0.4;
/// Maximum number of cells along x.
const MAX_COLUMNS: usize = 65_535;

/// What random scenes have in common: the number of particles, whether all scenes have the same bodies, the ranges of their
/// fill and stiffness, and the domain: height 1, width 1 for up to 2,500 particles and proportional to their number above, rounded up to
/// whole cells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extent {
    preset: Preset,
    particles: usize,
    same_bodies: bool,
    fill: Option<[f32; 2]>,
    stiffness: Option<[f32; 2]>,
}

/// What a request says of its random scenes; what it leaves out is the default.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ExtentOptions {
    /// As in [`Extent::of`].
    pub particles: Option<usize>,
    /// As in [`Extent::with_fill`].
    pub fill: Option<[f32; 2]>,
    /// As in [`Extent::with_stiffness`].
    pub stiffness: Option<[f32; 2]>,
    /// As in [`Extent::with_same_bodies`].
    pub same_bodies: bool,
}

impl Extent {
    /// The extent that a request asks for.
    ///
    /// # Errors
    /// Those of [`Extent::of`], [`Extent::with_fill`] and [`Extent::with_stiffness`].
    pub fn requested(preset: Preset, options: ExtentOptions) -> Result<Self, MpmError> {
        let ExtentOptions { particles, fill, stiffness, same_bodies } = options;
        let mut extent = Self::of(preset, particles.unwrap_or(PARTICLES))?;
        for (field, is_set) in [("fill", fill.is_some()), ("same_bodies", same_bodies)] {
            if is_set && preset.has_tools() {
                let found = format!("preset {preset}, whose scenes have a tool");
                let expected = "a preset without tools".into();
                return Err(MpmError::Field { field: field.into(), found, expected });
            }
        }
        if let Some(range) = fill {
            extent = extent.with_fill(range)?;
        }
        if let Some(range) = stiffness {
            extent = extent.with_stiffness(range)?;
        }
        Ok(if same_bodies { extent.with_same_bodies() } else { extent })
    }

    /// The default: 2,500 particles in the unit square.
    pub fn usual(preset: Preset) -> Self {
        Self { preset, particles: PARTICLES, same_bodies: false, fill: None, stiffness: None }
    }

    /// The extent for a number of particles.
    ///
    /// # Errors
    /// [`MpmError::Field`] for too few particles to form bodies, or more than a grid has columns for.
    pub fn of(preset: Preset, particles: usize) -> Result<Self, MpmError> {
        let most = match preset.has_tools() {
            true => PARTICLES,
            false => MAX_COLUMNS / preset.cells() as usize * PARTICLES,
        };
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

    /// The same with bodies that fill a random fraction of the unit square, drawn for each scene: uniformly, and again if they do not
    /// fit, so that large fractions are rarer with ropes and with several bodies.
    ///
    /// # Errors
    /// [`MpmError::Field`] unless the range begins at .02 to .15 and ends above that, at .4 at most, or if the number of particles is
    /// another than 2,500.
    pub fn with_fill(self, range: [f32; 2]) -> Result<Self, MpmError> {
        let [low, high] = range;
        let [least, most] = LOW_FILL;
        let fits = (least..=most).contains(&low) && low < high && high <= MAX_FILL;
        if fits && self.particles == PARTICLES {
            return Ok(Self { fill: Some(range), ..self });
        }
        Err(MpmError::Field {
            field: "fill".into(),
            found: format!("{low}..{high}"),
            expected: format!(
                "a range that begins at {least} to {most} and ends at {MAX_FILL} at most, without a number of particles"
            ),
        })
    }

    /// The range of the fraction of the domain that bodies fill, unless all scenes have the same number of particles.
    pub fn fill(&self) -> Option<[f32; 2]> {
        self.fill
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

    /// Number of particles; 2,500 if the fill is random, and scenes then differ.
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
    fn a_fill_is_a_range_around_the_usual_one() {
        let usual = Extent::usual(Preset::Kinds);
        assert_eq!(usual.with_fill([0.02, 0.4]).unwrap().fill(), Some([0.02, 0.4]));
        for range in
            [[0.019, 0.2], [0.151, 0.3], [0.1, 0.1], [0.1, 0.05], [0.1, 0.41], [f32::NAN, 0.2]]
        {
            let said = usual.with_fill(range).unwrap_err().to_string();
            assert!(said.starts_with("fill: found "), "{said}");
        }
        assert!(Extent::of(Preset::Kinds, 10_000).unwrap().with_fill([0.1, 0.2]).is_err());
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
