//! Particles to grid: scatters mass, momentum, the impulse of stress, and with the law `settling` the area of liquids to 3x3 nodes.

use super::{
    constitutive,
    grid::Grid,
    material::{DENSITY, Law, Moduli},
    particle::Particle,
    spline::Stencil,
};
use eddy_frames::Material;

/// Advances the deformation of every particle by `dt` seconds and adds its mass and momentum to the
/// grid. `volume` is the area of an undeformed particle (domain lengths^2).
///
/// Node (i, j) receives `w (m v + (m C - dt vol 4/dx^2 tau) (x_ij - x))`, equation 29 of Hu et al. 2018.
pub(super) fn scatter(
    particles: &mut [Particle],
    grid: &mut Grid,
    moduli: &Moduli,
    volume: f32,
    dt: f32,
) {
    let (dx, inverse_dx) = (grid.dx(), grid.inverse_dx());
    let mass = DENSITY * volume;
    let impulse = -dt * volume * 4.0 * inverse_dx * inverse_dx;
    for particle in particles {
        let stress = constitutive::advance(particle, moduli, dt);
        let (area, solid) = match (moduli.law, particle.material) {
            (Law::Water | Law::Taichi, _) => (0.0, 0.0),
            (Law::Settling, Material::Liquid) => (mass * particle.deformation.determinant(), 0.0),
            (Law::Settling, _) => (0.0, mass),
        };
        let affine = (stress * impulse + particle.affine * mass) * dx;
        let stencil = Stencil::at(particle.position, inverse_dx);
        for (place, weight, [x, y]) in stencil.nodes() {
            let number = grid.number(&stencil, place);
            let node = grid.node_mut(number);
            let [u, v] = particle.velocity;
            node.motion[0] += weight * (mass * u + affine.xx * x + affine.xy * y);
            node.motion[1] += weight * (mass * v + affine.yx * x + affine.yy * y);
            node.mass += weight * mass;
            node.solid += weight * solid;
            node.area += weight * area;
        }
    }
}
