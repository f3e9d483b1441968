//! What a substep is computed with.

use super::{
    grid::GridShape,
    material::{DENSITY, Law, Moduli},
    solver::SolverSettings,
    water::Settling,
};

/// Parameters of a substep.
#[derive(Clone, Copy, Debug)]
pub struct Step {
    /// Length of the substep (s).
    pub dt: f32,
    /// Cell width (domain lengths).
    pub dx: f32,
    /// Cells per domain length.
    pub inverse_dx: f32,
    /// `-dt 4 / (dx^2 rho)`: converts Kirchhoff stress to the affine part of the velocity.
    pub impulse: f32,
    /// Particles per cell in an undeformed body.
    pub particles_per_cell: f32,
    /// How J changes, with the law `settling`.
    pub settling: Option<Settling>,
    /// Coefficient of friction at the walls.
    pub wall_friction: f32,
    /// Velocity along -y that gravity adds (domain lengths per s); not -0 without gravity, which would change the sign of velocities of
    /// zero.
    pub fall: f32,
    /// Material parameters.
    pub moduli: Moduli,
}

impl Step {
    /// The parameters for these settings.
    pub fn of(settings: &SolverSettings) -> Self {
        let SolverSettings { grid: GridShape { dx, .. }, dt, .. } = *settings;
        let inverse_dx = 1.0 / dx;
        let moduli = Moduli::of(&settings.materials);
        Self {
            dt,
            dx,
            inverse_dx,
            impulse: -dt * 4.0 * inverse_dx * inverse_dx / DENSITY,
            particles_per_cell: dx * dx / settings.volume(),
            settling: (moduli.law == Law::Settling).then(|| Settling::of(&moduli, inverse_dx, dt)),
            wall_friction: settings.materials.wall_friction,
            fall: dt * (0.0 - settings.gravity),
            moduli,
        }
    }

    /// The lowest node of the stencil at a position (domain lengths).
    pub(super) fn lowest(&self, position: [f32; 2]) -> [i32; 2] {
        position.map(|x| (x * self.inverse_dx - 0.5) as i32)
    }
}
