//! Grid to particles: gathers velocities and their gradients (APIC) and advances positions.

use super::{
    constitutive,
    grid::{Grid, Node},
    material::{DENSITY, Law},
    matrix::Matrix2,
    particle::Particle,
    spline::Stencil,
    step::Step,
    tool::{Barriers, Hidden},
    water,
};

/// Gathers the velocities of the grid and advances every particle by a substep, in which tools move from where they are in the first of
/// `barriers` to the second. `hidden` is what the particles have kept for themselves.
///
/// # Errors
/// The index of the first particle that leaves the grid or has a position that is not finite.
pub(super) fn gather(
    particles: &mut [Particle],
    grid: &Grid,
    step: &Step,
    hidden: &[Option<Hidden>],
    barriers: [&Barriers; 2],
) -> Result<(), usize> {
    for (index, (particle, hidden)) in particles.iter_mut().zip(hidden).enumerate() {
        let stencil = Stencil::at(particle.position, step.inverse_dx);
        let node = |place| *grid.node(grid.number(&stencil, place));
        advance(particle, &stencil, node, hidden.as_ref(), barriers, step);
        if !grid.shape().contains(particle.position) {
            return Err(index);
        }
    }
    Ok(())
}

/// Gathers from the nodes (i, j) of its stencil, and advances a particle.
#[inline]
pub(super) fn advance(
    particle: &mut Particle,
    stencil: &Stencil,
    node: impl Fn([usize; 2]) -> Node,
    hidden: Option<&Hidden>,
    [before, after]: [&Barriers; 2],
    step: &Step,
) {
    let Step { inverse_dx, dx, dt, .. } = *step;
    let (mut velocity, mut mass, mut area) = ([0.0; 2], 0.0, 0.0);
    // Velocity times the distance to the node (cells).
    let mut moment = Matrix2::ZERO;
    let mut seen = 0.0;
    for (place, weight, [x, y]) in stencil.nodes() {
        if hidden.is_some_and(|hidden| !hidden.sees(place)) {
            continue;
        }
        let node = node(place);
        let [u, v] = node.motion.map(|velocity| weight * velocity);
        velocity = [velocity[0] + u, velocity[1] + v];
        moment = moment + Matrix2::new(u * x, u * y, v * x, v * y);
        mass += weight * node.mass;
        area += weight * node.area;
        seen += weight;
    }
    let from = particle.position;
    if let Some(hidden) = hidden {
        velocity = [velocity[0] + hidden.velocity[0], velocity[1] + hidden.velocity[1]];
        moment = moment + hidden.moment;
        // Of the nodes that it does not see it assumes the mean of the others, of too few of them its own state.
        let share = f32::max(seen, LEAST_SEEN);
        let own = particle.deformation.determinant();
        let own_mass = DENSITY * dx * dx / own;
        mass = (mass + (share - seen) * own_mass) / share;
        area = (area + (share - seen) * own) / share;
    }
    particle.affine = moment * (4.0 * inverse_dx);
    particle.velocity = velocity;
    particle.position = [from[0] + dt * velocity[0], from[1] + dt * velocity[1]];
    if hidden.is_some() {
        particle.position = after.resolved(before, from, particle.position);
    }
    let density = mass * inverse_dx * inverse_dx;
    if let Some(settling) = step.settling {
        constitutive::correct_area(particle, |own| settling.followed(own, area));
    } else if step.moduli.law == Law::Water {
        constitutive::correct_area(particle, |own| water::corrected(own, density, dt));
    }
}

/// The smallest share of its kernel that a particle takes for all of it.
pub(super) const LEAST_SEEN: f32 = 0.05;
