//! The forces of walls on the surface of a body, and what is close to it.

use super::{Elasticity, Node, SurfacePart, Walls, add_scaled};

/// Speed away from a wall from which on its push is the share [`Elasticity::rebound`] (domain lengths per second).
const REBOUNDING: f32 = 0.1;

/// Adds the force of the walls on a part, in units of a particle's mass, to its nodes. `fall` is what gravity adds to velocities in the
/// step.
#[inline(always)]
pub(super) fn add_forces(
    Elasticity { wall_stiffness, rebound, .. }: &Elasticity,
    Walls { lower, upper }: &Walls,
    fall: [f32; 2],
    part: &SurfacePart,
    nodes: &mut [Node],
) {
    let own = part.state(nodes);
    let force = [0, 1].map(|axis| {
        let place = own.position[axis];
        let depth = (lower[axis] - place).max(0.0) - (place - upper[axis]).max(0.0);
        // Without a jump, which would turn rounding into motion where bodies lie still.
        let velocity = own.velocity[axis] + fall[axis];
        let away = (velocity * depth.signum() / REBOUNDING).clamp(0.0, 1.0);
        wall_stiffness * part.particles * (1.0 - (1.0 - rebound) * away) * depth
    });
    for (&node, &weight) in part.nodes.iter().zip(&part.weights) {
        add_scaled(&mut nodes[node as usize].force, weight, force);
    }
}

/// The smallest box around parts.
pub(super) fn bounds(parts: &[Node]) -> [[f32; 2]; 2] {
    parts.iter().fold([[f32::MAX; 2], [f32::MIN; 2]], |[lower, upper], part| {
        let along = |axis: usize| {
            let place = part.position[axis];
            [lower[axis].min(place), upper[axis].max(place)]
        };
        let [[lower_x, upper_x], [lower_y, upper_y]] = [along(0), along(1)];
        [[lower_x, lower_y], [upper_x, upper_y]]
    })
}

/// Whether a place is within `reach` of a box along both axes.
pub(super) fn is_within(reach: f32, [lower, upper]: &[[f32; 2]; 2], place: [f32; 2]) -> bool {
    (0..2).all(|axis| (lower[axis] - reach..upper[axis] + reach).contains(&place[axis]))
}
