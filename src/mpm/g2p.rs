//! Grid to particles: velocity and its gradient come back (APIC), positions move.

use super::{
    constitutive,
    grid::{Grid, lanes},
    material::Moduli,
    matrix::Matrix2,
    particle::Particle,
    spline::Stencil,
};

/// Gathers the velocities of the grid and moves every particle `dt` seconds on.
///
/// # Errors
/// The index of the first particle that leaves the grid or has a position that is no number.
pub(super) fn gather(
    particles: &mut [Particle],
    grid: &Grid,
    moduli: &Moduli,
    dt: f32,
) -> Result<(), usize> {
    let inverse_dx = grid.inverse_dx();
    for (index, particle) in particles.iter_mut().enumerate() {
        let stencil = Stencil::at(particle.position, inverse_dx);
        let [fx, fy] = stencil.offset;
        let [weight_x, weight_y] = stencil.weight;
        let moment_weight = |weight: [f32; 3], offset: f32| {
            [weight[0] * -offset, weight[1] * (1.0 - offset), weight[2] * (2.0 - offset)]
        };
        let (moment_weight_x, moment_weight_y) =
            (moment_weight(weight_x, fx), moment_weight(weight_y, fy));
        // Velocity, then mass.
        let mut velocity = [0.0; 4];
        // Velocity times the distance to the node along x and y (cells).
        let (mut moment_x, mut moment_y) = ([0.0; 4], [0.0; 4]);
        for i in 0..3 {
            let row = grid.row(&stencil, i);
            let along_row = |weight: [f32; 3]| {
                lanes(|k| weight[0] * row[0][k] + weight[1] * row[1][k] + weight[2] * row[2][k])
            };
            let (sum, moment) = (along_row(weight_y), along_row(moment_weight_y));
            velocity = lanes(|k| velocity[k] + weight_x[i] * sum[k]);
            moment_x = lanes(|k| moment_x[k] + moment_weight_x[i] * sum[k]);
            moment_y = lanes(|k| moment_y[k] + weight_x[i] * moment[k]);
        }
        let scale = 4.0 * inverse_dx;
        particle.affine = Matrix2::new(moment_x[0], moment_y[0], moment_x[1], moment_y[1]) * scale;
        particle.velocity = [velocity[0], velocity[1]];
        particle.position =
            [particle.position[0] + dt * velocity[0], particle.position[1] + dt * velocity[1]];
        constitutive::recall(particle, velocity[2] * inverse_dx * inverse_dx, moduli, dt);
        if !grid.shape().contains(particle.position) {
            return Err(index);
        }
    }
    Ok(())
}
