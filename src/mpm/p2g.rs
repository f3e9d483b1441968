//! Particles to grid: mass, momentum and the impulse of stress are spread over 3x3 nodes.

use super::{
    constitutive,
    grid::{Grid, lanes},
    material::{DENSITY, Moduli},
    particle::Particle,
    spline::Stencil,
};

/// Advances the deformation of every particle by `dt` seconds and adds its mass and momentum to the
/// grid. `volume` is the area of an undeformed particle (domain lengths^2).
///
/// Node (i, j) gets `w (m v + (m C - dt vol 4/dx^2 tau) (x_ij - x))`, equation 29 of Hu et al. 2018.
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
        let affine = (stress * impulse + particle.affine * mass) * dx;
        let stencil = Stencil::at(particle.position, inverse_dx);
        let [fx, fy] = stencil.offset;
        let [u, v] = particle.velocity;
        // What a node at distance (i, j) cells from the lowest one gets, before its weight:
        // lowest + i along_x + j along_y, as [momentum x, momentum y, mass, unused].
        let lowest = [
            mass * u - affine.xx * fx - affine.xy * fy,
            mass * v - affine.yx * fx - affine.yy * fy,
            mass,
            0.0,
        ];
        let along_x = [affine.xx, affine.yx, 0.0, 0.0];
        let along_y = [affine.xy, affine.yy, 0.0, 0.0];
        for (i, weight_x) in stencil.weight[0].into_iter().enumerate() {
            let mut value = lanes(|k| weight_x * (lowest[k] + i as f32 * along_x[k]));
            let step = lanes(|k| weight_x * along_y[k]);
            for (node, weight_y) in grid.row_mut(&stencil, i).iter_mut().zip(stencil.weight[1]) {
                *node = lanes(|k| node[k] + weight_y * value[k]);
                value = lanes(|k| value[k] + step[k]);
            }
        }
    }
}
