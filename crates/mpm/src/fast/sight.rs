//! Which nodes sixteen particles do not see because of tools, as [`Part::entered`] for single ways.

use eddy_frames::tool::{Edge, Part};

use super::{simd::Simd, stencil::Stencils};

/// Number of nodes of a stencil. Node (i, j) is number 3 i + j.
pub(super) const NODES: usize = 9;
/// Distance from a particle to the farthest node of its stencil: 1.5 along both axes (cells).
const FARTHEST_NODE: f32 = 2.13;
/// More than the rounding of a distance (cells).
const ROUNDING: f32 = 1e-3;

/// The straight ways of particles to the nodes of their stencils (domain lengths).
pub(super) struct Ways<S: Simd> {
    /// Positions of the particles: their x, and their y.
    pub(super) from: [S::Lanes; 2],
    /// Distances from their lowest nodes (cells).
    pub(super) offset: [S::Lanes; 2],
    /// x of the nodes (i, 0), and y of the nodes (0, j).
    pub(super) to: [[S::Lanes; 3]; 2],
    /// Cell width (domain lengths).
    dx: f32,
}

impl<S: Simd> Ways<S> {
    #[inline(always)]
    pub(super) fn new(simd: S, from: [S::Lanes; 2], stencils: &Stencils<S>, dx: f32) -> Self {
        let mut to = [[simd.splat(0.0); 3]; 2];
        for (to, lowest) in to.iter_mut().zip(stencils.lowest) {
            for (k, to) in to.iter_mut().enumerate() {
                *to = (lowest + simd.splat(k as f32)) * simd.splat(dx);
            }
        }
        Self { from, offset: stencils.offset, to, dx }
    }
}

/// The first surfaces on the ways to the nodes.
pub(super) struct Surfaces<S: Simd> {
    /// The share of each way in front of it; infinite if there is none.
    pub(super) share: [S::Lanes; NODES],
    /// Its outward normal.
    pub(super) normal: [[S::Lanes; 2]; NODES],
    /// The number of its tool.
    pub(super) tool: [S::Lanes; NODES],
}

impl<S: Simd> Surfaces<S> {
    /// No surface on any way.
    #[inline(always)]
    pub(super) fn none(simd: S) -> Self {
        let zero = simd.splat(0.0);
        Self {
            share: [simd.splat(f32::INFINITY); NODES],
            normal: [[zero; 2]; NODES],
            tool: [zero; NODES],
        }
    }

    /// Takes the surfaces of a part of a tool that come first.
    #[inline(always)]
    pub(super) fn meet(&mut self, simd: S, ways: &Ways<S>, part: &Part, tool: usize) {
        let others = match part {
            Part::Disc { centre, radius } => of_disc(simd, *centre, *radius, ways),
            Part::Convex { edges, .. } => of_edges(simd, edges, ways),
        };
        let tool = simd.splat(tool as f32);
        for k in 0..NODES {
            let is_first = simd.less(others.share[k], self.share[k]);
            self.share[k] = simd.select(is_first, others.share[k], self.share[k]);
            self.tool[k] = simd.select(is_first, tool, self.tool[k]);
            self.normal[k] = choose(simd, is_first, others.normal[k], self.normal[k]);
        }
    }
}

/// The particles that may not see all of their nodes because of this part, or are less than a cell in front of it, after they have moved by
/// less than a cell, as bits.
#[inline(always)]
pub(super) fn near<S: Simd>(simd: S, part: &Part, [x, y]: [S::Lanes; 2], dx: f32) -> u16 {
    let reach = (FARTHEST_NODE + 1.0 + ROUNDING) * dx;
    match part {
        Part::Disc { centre, radius } => {
            let (u, v) = (x - simd.splat(centre[0]), y - simd.splat(centre[1]));
            let reach = radius + reach;
            simd.bits(simd.less(u * u + v * v, simd.splat(reach * reach)))
        }
        Part::Convex { edges, .. } => {
            // Loops: the closures of iterators are not compiled for these instructions.
            let mut bits = u16::MAX;
            for edge in edges {
                bits &= simd.bits(simd.less(distance(simd, edge, [x, y]), simd.splat(reach)));
            }
            bits
        }
    }
}

/// The particles that may not see all of their nodes because of this part, or are less than a cell in front of it, as bits: those for which
/// none of its surfaces has all nodes in front of it.
#[inline(always)]
pub(super) fn beside<S: Simd>(simd: S, part: &Part, ways: &Ways<S>) -> u16 {
    let ([x, y], dx) = (ways.from, ways.dx);
    match part {
        Part::Disc { centre, radius } => {
            let (u, v) = (x - simd.splat(centre[0]), y - simd.splat(centre[1]));
            let reach = radius + FARTHEST_NODE * dx;
            simd.bits(simd.less(u * u + v * v, simd.splat(reach * reach)))
        }
        Part::Convex { edges, .. } => {
            let mut bits = u16::MAX;
            for edge in edges {
                let reach = simd.max(reach(simd, edge.normal, ways.offset), 1.0);
                let reach = (reach + simd.splat(ROUNDING)) * simd.splat(dx);
                bits &= simd.bits(simd.less(distance(simd, edge, [x, y]), reach));
            }
            bits
        }
    }
}

/// How far the nodes of particles at these distances from their lowest nodes reach against a normal (cells).
#[inline(always)]
fn reach<S: Simd>(simd: S, normal: [f32; 2], offset: [S::Lanes; 2]) -> S::Lanes {
    let mut reach = simd.splat(0.0);
    for axis in 0..2 {
        let farthest = if normal[axis] > 0.0 { 0.0 } else { 2.0 };
        let farthest = offset[axis] - simd.splat(farthest);
        reach = reach + simd.splat(normal[axis]) * farthest;
    }
    reach
}

/// The particles whose ways from one position to another may enter a part that moves meanwhile, as bits.
#[inline(always)]
pub(super) fn may_enter<S: Simd>(
    simd: S,
    [before, after]: [&Part; 2],
    from: [S::Lanes; 2],
    to: [S::Lanes; 2],
    dx: f32,
) -> u16 {
    match (before, after) {
        (Part::Convex { edges: before, .. }, Part::Convex { edges: after, .. }) => {
            let mut bits = u16::MAX;
            for (before, after) in before.iter().zip(after) {
                let begins = simd.at_least(distance(simd, before, from), simd.splat(ROUNDING * dx));
                let ends = simd.at_least(distance(simd, after, to), simd.splat(0.0));
                bits &= !simd.bits(begins & ends);
            }
            bits
        }
        (_, Part::Disc { centre, radius }) => {
            let [x, y] = [0, 1].map(|axis| to[axis] - simd.splat(centre[axis]));
            // Particles move less than a cell.
            let reach = radius + dx;
            simd.bits(simd.less(x * x + y * y, simd.splat(reach * reach)))
        }
        (Part::Disc { .. }, Part::Convex { .. }) => unreachable!("a part keeps its kind"),
    }
}

/// `a` where the mask is true, else `b`.
#[inline(always)]
pub(super) fn choose<S: Simd>(
    simd: S,
    mask: S::Mask,
    a: [S::Lanes; 2],
    b: [S::Lanes; 2],
) -> [S::Lanes; 2] {
    [simd.select(mask, a[0], b[0]), simd.select(mask, a[1], b[1])]
}

/// [`Edge::distance`].
#[inline(always)]
fn distance<S: Simd>(simd: S, edge: &Edge, [x, y]: [S::Lanes; 2]) -> S::Lanes {
    let [u, v] = edge.normal;
    simd.splat(u) * x + simd.splat(v) * y - simd.splat(edge.offset)
}

#[inline(always)]
fn of_edges<S: Simd>(simd: S, edges: &[Edge], ways: &Ways<S>) -> Surfaces<S> {
    let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
    let mut found = Surfaces::none(simd);
    // As in `entered`; never for a way that stays in front of an edge.
    let (mut least, mut most) = ([simd.splat(f32::INFINITY); NODES], [one; NODES]);
    let never = simd.splat(f32::NEG_INFINITY);
    let (mut depth, mut nearest) = (never, [zero; 2]);
    for edge in edges {
        let normal = [simd.splat(edge.normal[0]), simd.splat(edge.normal[1])];
        let before = distance(simd, edge, ways.from);
        let is_nearer = simd.less(depth, before);
        depth = simd.select(is_nearer, before, depth);
        nearest = choose(simd, is_nearer, normal, nearest);
        let (begins_in_front, begins_behind) =
            (simd.at_least(before, zero), simd.less(before, zero));
        let reach = reach(simd, edge.normal.map(|x| -x), ways.offset) + simd.splat(ROUNDING);
        let farthest = before + reach * simd.splat(ways.dx);
        if simd.bits(simd.at_least(farthest, zero)) == 0 {
            // All nodes of all particles are behind it.
            continue;
        }
        let inverse = one / before;
        for k in 0..NODES {
            let [x, y] = [normal[0] * ways.to[0][k / 3], normal[1] * ways.to[1][k % 3]];
            let after = x + y - simd.splat(edge.offset);
            let relative = one - after * inverse;
            let ends_in_front = simd.at_least(after, zero);
            let enters =
                begins_in_front & simd.less(after, zero) & simd.at_least(least[k], relative);
            least[k] = simd.select(enters, relative, least[k]);
            least[k] = simd.select(begins_in_front & ends_in_front, never, least[k]);
            let leaves = begins_behind & ends_in_front & simd.less(most[k], relative);
            most[k] = simd.select(leaves, relative, most[k]);
            found.normal[k] = choose(simd, enters, normal, found.normal[k]);
        }
    }
    let begins_inside = simd.less(depth, zero);
    let some_begin_inside = simd.bits(begins_inside) != 0;
    for k in 0..NODES {
        let enters = simd.at_least(least[k], most[k]);
        found.share[k] = simd.select(enters, one / least[k], simd.splat(f32::INFINITY));
        if some_begin_inside {
            found.share[k] = simd.select(begins_inside, zero, found.share[k]);
            found.normal[k] = choose(simd, begins_inside, nearest, found.normal[k]);
        }
    }
    found
}

#[inline(always)]
fn of_disc<S: Simd>(simd: S, centre: [f32; 2], radius: f32, ways: &Ways<S>) -> Surfaces<S> {
    let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
    let mut found = Surfaces::none(simd);
    let [x, y] = [ways.from[0] - simd.splat(centre[0]), ways.from[1] - simd.splat(centre[1])];
    let square = x * x + y * y;
    let c = square - simd.splat(radius * radius);
    let begins_inside = simd.less(simd.sqrt(square) - simd.splat(radius), zero);
    for k in 0..NODES {
        let [u, v] = [ways.to[0][k / 3] - ways.from[0], ways.to[1][k % 3] - ways.from[1]];
        let (a, b) = (u * u + v * v, x * u + y * v);
        let square = b * b - a * c;
        let share = (zero - b - simd.sqrt(square)) / a;
        let enters = simd.less(b, zero) & simd.at_least(square, zero) & simd.less(share, one);
        let share = simd.select(enters, share, simd.splat(f32::INFINITY));
        let share = simd.select(begins_inside, zero, share);
        let is_met = simd.less(share, simd.splat(f32::INFINITY));
        let point = [x + share * u, y + share * v];
        let length = simd.sqrt(point[0] * point[0] + point[1] * point[1]);
        let points_outwards = is_met & simd.less(zero, length);
        // Upwards at the centre.
        let upwards = [zero, simd.select(is_met, one, zero)];
        let outwards = [point[0] / length, point[1] / length];
        found.normal[k] = choose(simd, points_outwards, outwards, upwards);
        found.share[k] = share;
    }
    found
}
