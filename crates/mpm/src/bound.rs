//! How long a substep may be for particles as they are: fast, sheared, stretched and compressed.
//!
//! [`stability`](super::stability) chooses the substeps at the start of a scene, with a margin for what happens later. The limits here
//! lie in this margin: a scene reaches them when bodies collide at nearly the speed of sound.

use super::{
    error::Limit,
    material::Lame,
    particle::Particle,
    solver::{SolverSettings, Stop},
    stability::TRAVEL,
};
use eddy_frames::Material;

/// Maximum Courant number of sound in a stretched solid: cells that a pressure wave crosses in a substep.
const CFL: f32 = 1.25;
/// The same for a compressed liquid.
const LIQUID_CFL: f32 = 1.0;
/// Maximum strain of a substep: above it, the explicit update of the deformation gradient crushes particles.
const STRAIN: f32 = 0.25;

/// The limits of a substep of one length, as factors that make the square of each quantity 1 at its limit.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bound {
    /// Of a velocity (domain lengths per s).
    pub(super) travel: f32,
    /// Of an entry of C (1/s).
    pub(super) strain: f32,
    /// Of the stretch of each material: the speed of sound is proportional to it.
    pub(super) sound: [f32; Material::COUNT],
    /// Whether liquids have the law of water, in which the speed of sound is proportional to J^-3.
    pub(super) is_water: bool,
}

impl Bound {
    /// The limits with these settings.
    pub(super) fn of(settings: &SolverSettings) -> Self {
        let SolverSettings { grid, dt, materials, .. } = *settings;
        let square = |x: f32| x * x;
        let lame = Lame::of(materials.stiffness);
        let per_cell = dt / grid.dx;
        Self {
            travel: square(per_cell / TRAVEL as f32),
            strain: square(dt / STRAIN),
            sound: Material::ALL.map(|material| {
                let most = if material == Material::Liquid { LIQUID_CFL } else { CFL };
                square(lame.sound_speed(material) * per_cell / most)
            }),
            is_water: materials.law.is_water(),
        }
    }

    /// The factor by which the substep is too long for a particle, and why; `None` if it is not too long.
    pub(super) fn exceeded_by(&self, particle: &Particle) -> Option<(f32, Limit)> {
        let Particle { velocity: [u, v], affine: c, deformation: f, material, .. } = *particle;
        let travel = (u * u + v * v) * self.travel;
        let strain = [c.xx, c.xy, c.yx, c.yy].into_iter().map(|c| c * c * self.strain);
        let strain = strain.fold(0.0, f32::max);
        let half = 0.5 * (f.xx * f.xx + f.xy * f.xy + f.yx * f.yx + f.yy * f.yy);
        let area = f.xx * f.yy - f.xy * f.yx;
        // The square of the larger singular value.
        let mut stretch = half + (half * half - area * area).max(0.0).sqrt();
        if material == Material::Liquid && self.is_water {
            let packed = 1.0 / area;
            let cube = packed * packed * packed;
            stretch = cube * cube;
        }
        let sound = stretch * self.sound[material as usize];
        let limits = [
            (travel, Limit::Speed(u.hypot(v))),
            (strain, Limit::Strain(material)),
            (sound, Limit::Sound(material)),
        ];
        let (most, limit) = limits
            .into_iter()
            .fold(limits[0], |most, next| if next.0 > most.0 { next } else { most });
        (most > 1.0).then(|| (most.sqrt(), limit))
    }

    /// Checks the substep for particles with these indices, in any order.
    ///
    /// # Errors
    /// [`Stop::TooLong`] of the particle for which it is too long by the largest factor.
    pub(super) fn check<P: std::borrow::Borrow<Particle>>(
        &self,
        particles: impl IntoIterator<Item = (usize, P)>,
    ) -> Result<(), Stop> {
        let exceeding = particles.into_iter().filter_map(|(particle, state)| {
            self.exceeded_by(state.borrow()).map(|(factor, limit)| (particle, factor, limit))
        });
        // The lowest index among equals.
        match exceeding.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0))) {
            None => Ok(()),
            Some((particle, factor, limit)) => Err(Stop::TooLong { particle, factor, limit }),
        }
    }
}
