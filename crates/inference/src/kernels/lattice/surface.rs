//! The forces on the surfaces of bodies: of walls, and of other bodies that are close.

use std::ops::Range;

use super::{Contact, Elasticity, Node, SurfacePart, Walls, add_scaled};

/// Speed away from a wall from which on its push is the share [`Elasticity::rebound`] (domain lengths per second).
const REBOUNDING: f32 = 0.1;

/// The surfaces of bodies.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Surfaces {
    /// Their parts, body by body.
    pub(super) parts: Vec<SurfacePart>,
    /// Range of the parts of each body.
    pub(super) bodies: Vec<Range<u32>>,
}

impl Surfaces {
    /// Adds the forces of walls and between bodies to the nodes. `fall` is what gravity adds to velocities in the step, `parts` a scratch
    /// buffer: position, velocity and force of each part.
    pub(super) fn add_forces(
        &self,
        elasticity: &Elasticity,
        walls: &Walls,
        fall: [f32; 2],
        parts: &mut Vec<Node>,
        nodes: &mut [Node],
    ) {
        parts.clear();
        parts.extend(self.parts.iter().map(|part| {
            let mut own = Node::default();
            for (&node, &weight) in part.nodes.iter().zip(&part.weights) {
                own.add(weight, &nodes[node as usize]);
            }
            own.force = push(elasticity, walls, fall, part, &own);
            own
        }));
        let reach = elasticity.contact.distance;
        // Each body with those before it.
        for body in self.bodies.iter().skip(1) {
            let [start, end] = [body.start, body.end].map(|part| part as usize);
            let [lower, upper] = bounds(&parts[start..end]);
            let (before, later) = parts.split_at_mut(start);
            for (one, from) in before.iter_mut().enumerate() {
                let near = |axis: usize| lower[axis] - reach..upper[axis] + reach;
                if !(0..2).all(|axis| near(axis).contains(&from.position[axis])) {
                    continue;
                }
                for (other, to) in (start..end).zip(&mut *later) {
                    let pair = [&self.parts[one], &self.parts[other]];
                    if let Some(force) = contact_force(&elasticity.contact, pair, [from, to]) {
                        add_scaled(&mut from.force, 1.0, force);
                        add_scaled(&mut to.force, -1.0, force);
                    }
                }
            }
        }
        for (part, own) in self.parts.iter().zip(&*parts) {
            for (&node, &weight) in part.nodes.iter().zip(&part.weights) {
                add_scaled(&mut nodes[node as usize].force, weight, own.force);
            }
        }
    }
}

/// The smallest box around parts.
fn bounds(parts: &[Node]) -> [[f32; 2]; 2] {
    parts.iter().fold([[f32::MAX; 2], [f32::MIN; 2]], |[lower, upper], part| {
        let along = |axis: usize| {
            let place = part.position[axis];
            [lower[axis].min(place), upper[axis].max(place)]
        };
        let [[lower_x, upper_x], [lower_y, upper_y]] = [along(0), along(1)];
        [[lower_x, lower_y], [upper_x, upper_y]]
    })
}

/// The force of the walls on a part, in units of a particle's mass.
#[inline(always)]
fn push(
    Elasticity { wall_stiffness, rebound, .. }: &Elasticity,
    Walls { lower, upper }: &Walls,
    fall: [f32; 2],
    part: &SurfacePart,
    own: &Node,
) -> [f32; 2] {
    [0, 1].map(|axis| {
        let place = own.position[axis];
        let depth = (lower[axis] - place).max(0.0) - (place - upper[axis]).max(0.0);
        // Without a jump, which would turn rounding into motion where bodies lie still.
        let velocity = own.velocity[axis] + fall[axis];
        let away = (velocity * depth.signum() / REBOUNDING).clamp(0.0, 1.0);
        wall_stiffness * part.particles * (1.0 - (1.0 - rebound) * away) * depth
    })
}

/// The force of the second part on the first, in units of a particle's mass, if they are close.
#[inline(always)]
fn contact_force(
    Contact { distance, stiffness, viscosity }: &Contact,
    [one, other]: [&SurfacePart; 2],
    [from, to]: [&Node; 2],
) -> Option<[f32; 2]> {
    let apart = [0, 1].map(|axis| from.position[axis] - to.position[axis]);
    let squared = apart[0] * apart[0] + apart[1] * apart[1];
    // Not if it is NaN: a body that has diverged leaves others alone.
    let is_near = squared < distance * distance;
    if !is_near {
        return None;
    }
    let gap = squared.sqrt().max(1e-9);
    let particles = 2.0 * one.particles * other.particles / (one.particles + other.particles);
    let depth = particles * (distance - gap);
    let (spring, exchange) = (stiffness * depth / gap, viscosity * depth / distance);
    let force =
        |axis: usize| spring * apart[axis] - exchange * (from.velocity[axis] - to.velocity[axis]);
    Some([force(0), force(1)])
}
