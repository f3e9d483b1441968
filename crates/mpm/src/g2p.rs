//! Grid to particles: gathers velocities and their gradients (APIC) and advances positions.

use super::{
    constitutive, grid::Grid, material::Law, matrix::Matrix2, particle::Particle, spline::Stencil,
    step::Step, water,
};

/// Gathers the velocities of the grid and advances every particle by a substep.
///
/// # Errors
/// The index of the first particle that leaves the grid or has a position that is not finite.
pub(super) fn gather(particles: &mut [Particle], grid: &Grid, step: &Step) -> Result<(), usize> {
    let Step { inverse_dx, dt, .. } = *step;
    for (index, particle) in particles.iter_mut().enumerate() {
        let stencil = Stencil::at(particle.position, inverse_dx);
        let (mut velocity, mut mass, mut area) = ([0.0; 2], 0.0, 0.0);
        // Velocity times the distance to the node (cells).
        let mut moment = Matrix2::ZERO;
        for (place, weight, [x, y]) in stencil.nodes() {
            let node = grid.node(grid.number(&stencil, place));
            let [u, v] = node.motion.map(|velocity| weight * velocity);
            velocity = [velocity[0] + u, velocity[1] + v];
            moment = moment + Matrix2::new(u * x, u * y, v * x, v * y);
            mass += weight * node.mass;
            area += weight * node.area;
        }
        particle.affine = moment * (4.0 * inverse_dx);
        particle.velocity = velocity;
        particle.position =
            [particle.position[0] + dt * velocity[0], particle.position[1] + dt * velocity[1]];
        let density = mass * inverse_dx * inverse_dx;
        if let Some(settling) = step.settling {
            constitutive::correct_area(particle, |own| settling.followed(own, area));
        } else if step.moduli.law == Law::Water {
            constitutive::correct_area(particle, |own| water::corrected(own, density, dt));
        }
        if !grid.shape().contains(particle.position) {
            return Err(index);
        }
    }
    Ok(())
}
