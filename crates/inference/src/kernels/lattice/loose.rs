//! Particles of other matter close to bodies of jelly: snow, liquid, rope, and jelly in pieces that are too small for a lattice.

use std::ops::Range;

use super::{
    Contact, Node,
    surface::{bounds, is_within},
};

/// Inertia of a loose particle (masses of a particle): what lies behind it moves with it.
const INERTIA: f32 = 4.0;
/// Rate at which it exchanges momentum with a part of a surface that it touches, relative to [`Contact::viscosity`].
const EXCHANGE: f32 = 0.4;
/// Distance from a part within which it is found at the beginning of a frame (contact distances).
const FOUND: f32 = 2.0;

/// The particles of other matter that are close to surfaces in a frame.
#[derive(Clone, Debug, Default)]
pub(super) struct Loose {
    /// The row of each, its state before the frame, and within it.
    pub(super) rows: Vec<u32>,
    pub(super) start: Vec<Node>,
    pub(super) nodes: Vec<Node>,
    /// Those that were close at the beginning: a part, and a loose particle.
    pairs: Vec<[u32; 2]>,
    /// Around the parts of each body.
    boxes: Vec<[[f32; 2]; 2]>,
}

impl Loose {
    /// Finds those among the rows `others` that are close to parts of surfaces, which are by bodies.
    pub(super) fn find(
        &mut self,
        others: &[u32],
        motion: (&[[f32; 2]], &[[f32; 2]]),
        (parts, bodies): (&[Node], &[Range<u32>]),
        contact: &Contact,
    ) {
        let Self { rows, start, nodes, pairs, boxes } = self;
        rows.clear();
        start.clear();
        pairs.clear();
        boxes.clear();
        let of = |body: &Range<u32>| bounds(&parts[body.start as usize..body.end as usize]);
        boxes.extend(bodies.iter().map(of));
        let reach = FOUND * contact.distance;
        for &row in others {
            let (own, number, before) = (Node::of(motion, row as usize), rows.len(), pairs.len());
            for (body, bounds) in bodies.iter().zip(&*boxes) {
                if !is_within(reach, bounds, own.position) {
                    continue;
                }
                let is_close =
                    |part: &u32| squared_distance(&own, &parts[*part as usize]) < reach * reach;
                let close = body.clone().filter(is_close);
                pairs.extend(close.map(|part| [part, number as u32]));
            }
            if pairs.len() > before {
                rows.push(row);
                start.push(own);
            }
        }
        nodes.clone_from(start);
    }

    /// Adds the forces between loose particles and parts, in units of a particle's mass.
    pub(super) fn exchange(&mut self, contact: &Contact, step: f32, parts: &mut [Node]) {
        let Contact { distance, viscosity, .. } = *contact;
        // A faster one would be unstable.
        let rate = (EXCHANGE * viscosity).min(1.0 / step);
        for &[part, number] in &self.pairs {
            let (part, own) = (&mut parts[part as usize], &mut self.nodes[number as usize]);
            let squared = squared_distance(own, part);
            // Not if it is NaN.
            let is_near = squared < distance * distance;
            if !is_near {
                continue;
            }
            let share = rate * (1.0 - squared.sqrt() / distance);
            for axis in 0..2 {
                let force = share * (part.velocity[axis] - own.velocity[axis]);
                part.force[axis] -= force;
                own.force[axis] += force;
            }
        }
    }

    /// A step of all.
    pub(super) fn advance(&mut self, step: f32, fall: [f32; 2]) {
        for node in &mut self.nodes {
            node.advance(step, 1.0 / INERTIA, fall);
        }
    }
}

fn squared_distance(one: &Node, other: &Node) -> f32 {
    let [x, y] = [0, 1].map(|axis| one.position[axis] - other.position[axis]);
    x * x + y * y
}
