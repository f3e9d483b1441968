//! The forces between bodies that are close to each other.

use std::ops::Range;

use super::{Contact, Elasticity, Node, Point, add_scaled};

/// The points at the surfaces of bodies.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Surfaces {
    /// Their numbers.
    pub(super) points: Vec<u32>,
    /// Those of each body.
    pub(super) bodies: Vec<Range<u32>>,
}

/// Scratch buffers of a step.
#[derive(Clone, Debug, Default)]
pub(super) struct Scratch {
    /// Of each point at a surface.
    points: Vec<Node>,
    /// Lower and upper corner of each body (domain lengths).
    boxes: Vec<[[f32; 2]; 2]>,
}

impl Surfaces {
    /// Adds the forces between points of different bodies to their nodes.
    pub(super) fn add_forces(
        &self,
        elasticity: &Elasticity,
        points: &[Point],
        Scratch { points: own, boxes }: &mut Scratch,
        nodes: &mut [Node],
    ) {
        if self.bodies.len() < 2 {
            return;
        }
        let point = |index: usize| &points[self.points[index] as usize];
        own.clear();
        own.extend((0..self.points.len()).map(|index| {
            let mut sum = Node::default();
            for (&node, &weight) in point(index).nodes.iter().zip(&point(index).weights) {
                sum.add(weight, &nodes[node as usize]);
            }
            sum
        }));
        let body = |number: usize| {
            let Range { start, end } = self.bodies[number];
            start as usize..end as usize
        };
        boxes.clear();
        boxes.extend((0..self.bodies.len()).map(|number| bounds(&own[body(number)])));
        let reach = elasticity.contact.distance;
        for (number, [lower, upper]) in boxes.iter().enumerate() {
            let Range { start, end } = body(number);
            let (before, this) = own.split_at_mut(start);
            for (one, from) in before.iter_mut().enumerate() {
                let near = |axis: usize| lower[axis] - reach..upper[axis] + reach;
                if !(0..2).all(|axis| near(axis).contains(&from.position[axis])) {
                    continue;
                }
                for (other, to) in (start..end).zip(&mut *this) {
                    if let Some(force) = force(elasticity, [point(one), point(other)], [from, to]) {
                        add_scaled(&mut from.force, 1.0, force);
                        add_scaled(&mut to.force, -1.0, force);
                    }
                }
            }
        }
        for (index, own) in own.iter().enumerate() {
            for (&node, &weight) in point(index).nodes.iter().zip(&point(index).weights) {
                add_scaled(&mut nodes[node as usize].force, weight, own.force);
            }
        }
    }
}

/// The smallest box around points.
fn bounds(points: &[Node]) -> [[f32; 2]; 2] {
    points.iter().fold([[f32::MAX; 2], [f32::MIN; 2]], |[lower, upper], point| {
        let along = |axis: usize| {
            let place = point.position[axis];
            [lower[axis].min(place), upper[axis].max(place)]
        };
        let [[lower_x, upper_x], [lower_y, upper_y]] = [along(0), along(1)];
        [[lower_x, lower_y], [upper_x, upper_y]]
    })
}

/// The force of the second point on the first, in units of a particle's mass, if they are close.
#[inline(always)]
fn force(
    Elasticity { lame: [mu, lambda], contact, .. }: &Elasticity,
    [one, other]: [&Point; 2],
    [from, to]: [&Node; 2],
) -> Option<[f32; 2]> {
    let Contact { distance, stiffness, viscosity } = *contact;
    let apart = [0, 1].map(|axis| from.position[axis] - to.position[axis]);
    let squared = apart[0] * apart[0] + apart[1] * apart[1];
    if squared >= distance * distance {
        return None;
    }
    let gap = squared.sqrt().max(1e-9);
    let modulus = lambda + 2.0 * mu;
    let width = 0.5 * (one.width + other.width);
    let particles = 2.0 * one.particles * other.particles / (one.particles + other.particles);
    let depth = particles * (distance - gap);
    let spring = stiffness * modulus / (width * width) * depth / gap;
    let exchange = viscosity * modulus.sqrt() / width * depth / distance;
    Some(
        [0, 1].map(|axis| {
            spring * apart[axis] - exchange * (from.velocity[axis] - to.velocity[axis])
        }),
    )
}
