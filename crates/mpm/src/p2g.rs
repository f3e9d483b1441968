//! Particles to grid: scatters mass, momentum, the impulse of stress, and with the law `settling` the area of liquids to 3x3 nodes. What
//! is hidden behind tools stays with the particle ([`tool`](super::tool)).

use super::{
    constitutive,
    grid::Grid,
    material::{DENSITY, Law},
    particle::Particle,
    spline::Stencil,
    step::Step,
    tool::{Barriers, Hidden, Loads},
};
use eddy_frames::Material;

/// Advances the deformation of every particle by a substep and adds its mass and momentum to the grid. `volume` is the area of an
/// undeformed particle (domain lengths^2). Returns what each particle keeps
/// behind the surfaces of tools.
///
/// Node (i, j) receives `w (m v + (m C - dt vol 4/dx^2 tau) (x_ij - x))`, equation 29 of Hu et al. 2018.
pub(super) fn scatter(
    particles: &mut [Particle],
    grid: &mut Grid,
    step: &Step,
    volume: f32,
    barriers: &Barriers,
    loads: &mut Loads,
) -> Vec<Option<Hidden>> {
    let Step { dt, dx, inverse_dx, fall, moduli, .. } = step;
    let mass = DENSITY * volume;
    let impulse = -dt * volume * 4.0 * inverse_dx * inverse_dx;
    let scattered = |particle: &mut Particle| {
        let stress = constitutive::advance(particle, moduli, *dt);
        let (area, solid) = match (moduli.law, particle.material) {
            (Law::Water | Law::Taichi, _) => (0.0, 0.0),
            (Law::Settling, Material::Liquid) => (mass * particle.deformation.determinant(), 0.0),
            (Law::Settling, _) => (0.0, mass),
        };
        let affine = (stress * impulse + particle.affine * mass) * *dx;
        let stencil = Stencil::at(particle.position, *inverse_dx);
        let [u, v] = particle.velocity;
        let momentum = |[x, y]: [f32; 2]| {
            [mass * u + affine.xx * x + affine.xy * y, mass * v + affine.yx * x + affine.yy * y]
        };
        let given = |place: [usize; 2]| {
            let [x, y] = momentum([0, 1].map(|k| place[k] as f32 - stencil.offset[k]));
            [x / mass, y / mass - fall]
        };
        let hidden = barriers.hidden(particle.position, &stencil, given, loads);
        for (place, weight, distance) in stencil.nodes() {
            if hidden.is_some_and(|hidden| !hidden.sees(place)) {
                continue;
            }
            let number = grid.number(&stencil, place);
            let node = grid.node_mut(number);
            let [x, y] = momentum(distance);
            node.motion[0] += weight * x;
            node.motion[1] += weight * y;
            node.mass += weight * mass;
            node.solid += weight * solid;
            node.area += weight * area;
        }
        hidden
    };
    particles.iter_mut().map(scattered).collect()
}
