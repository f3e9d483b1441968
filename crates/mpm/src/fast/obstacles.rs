//! Tools beside the particles of a chunk. Those that may not see all of their nodes are looked at one by one: what they have for nodes that
//! they do not see they keep, as in the plain solver, until they gather, one by one, too.

use super::{
    super::{
        g2p,
        grid::Node,
        material::DENSITY,
        particle::Particle,
        spline::Stencil,
        step::Step,
        tool::{ALL_NODES, Barriers, Hidden, WAYS},
    },
    chunk::Chunk,
    field::Nodes,
    pack::Pack,
    simd::{LANES, Simd},
    transfer::Scratch,
};
use eddy_frames::tool::Part;

/// The tools in a pass.
#[derive(Clone, Copy, Debug)]
pub(super) struct Obstacles<'a> {
    /// Where they were when particles have scattered, and where they are when they have moved.
    pub(super) barriers: [&'a Barriers; 2],
}

/// Particles of a chunk that have scattered beside tools, in the order of packs and lanes.
#[derive(Clone, Debug, Default)]
pub(super) struct Beside {
    /// Those that did not see all of their nodes.
    apart: Vec<Kept>,
    /// The others.
    whole: Vec<Start>,
}

impl Beside {
    pub(super) fn clear(&mut self) {
        self.apart.clear();
        self.whole.clear();
    }

    /// All of them, before any has gathered.
    pub(super) fn waiting(&self) -> Waiting<'_> {
        Waiting { apart: &self.apart, whole: &self.whole }
    }
}

/// A particle that did not see all of its nodes.
#[derive(Clone, Debug)]
struct Kept {
    /// Its pack in the chunk.
    pack: usize,
    lane: usize,
    /// As it was then.
    particle: Particle,
    hidden: Hidden,
}

/// Where a particle was that saw all of its nodes.
#[derive(Clone, Copy, Debug)]
struct Start {
    pack: usize,
    lane: usize,
    position: [f32; 2],
}

/// Those that have not gathered yet.
#[derive(Clone, Copy, Debug)]
pub(super) struct Waiting<'a> {
    apart: &'a [Kept],
    whole: &'a [Start],
}

impl<'a> Obstacles<'a> {
    /// `None` if there are no tools.
    pub(super) fn of(barriers: [&'a Barriers; 2]) -> Option<Self> {
        (!barriers[1].is_empty()).then_some(Self { barriers })
    }

    /// The parts that may be between nodes and particles in a box with these corners, lower first.
    pub(super) fn near(&self, bounds: [[f32; 2]; 2]) -> impl Iterator<Item = &'a Part> {
        self.barriers[1].near(bounds)
    }

    /// Gathers the particles of a pack that did not see all of their nodes, in place of what the pack has gathered, and keeps all that
    /// were beside a tool out of it. They are the first of those that are `waiting`, which are left out then.
    pub(super) fn gather(
        &self,
        number: usize,
        pack: &mut Pack,
        lanes: usize,
        waiting: &mut Waiting<'_>,
        field: Nodes<'_>,
        step: &Step,
    ) {
        let [before, after] = self.barriers;
        while let Some((first, rest)) = waiting.whole.split_first()
            && first.pack == number
        {
            waiting.whole = rest;
            let to = pack.position.map(|along| along[first.lane]);
            let [x, y] = after.resolved(before, first.position, to);
            (pack.position[0][first.lane], pack.position[1][first.lane]) = (x, y);
        }
        let mass = DENSITY * step.dx * step.dx / step.particles_per_cell;
        while let Some((first, rest)) = waiting.apart.split_first()
            && first.pack == number
        {
            waiting.apart = rest;
            let stencil = Stencil::at(first.particle.position, step.inverse_dx);
            let node = |[i, j]: [usize; 2]| {
                let at = (stencil.base[0] + i) * field.stride + stencil.base[1] + j;
                let liquid = field.liquid[at];
                Node { motion: field.velocity[at], mass: liquid * mass, area: liquid, solid: 0.0 }
            };
            let mut particle = first.particle;
            g2p::advance(&mut particle, &stencil, node, Some(&first.hidden), self.barriers, step);
            pack.set(first.lane, &particle, pack.index[first.lane]);
        }
        // Unused lanes stay copies of another particle.
        for lane in lanes..LANES {
            pack.set(lane, &pack.get(0), pack.index[0]);
        }
    }

    /// The particles of a pack that may not see all of their nodes or are less than a cell in front of a tool, as bits. `near` are the parts
    /// near the chunk.
    #[inline(always)]
    pub(super) fn beside<S: Simd>(
        &self,
        simd: S,
        pack: &Pack,
        offset: [S::Lanes; 2],
        lanes: usize,
        near: &[&Part],
        step: &Step,
    ) -> u16 {
        let position = [simd.load(&pack.position[0]), simd.load(&pack.position[1])];
        // Loops: the closures of iterators are not compiled for these instructions.
        let mut beside = 0;
        for part in near {
            beside |= beside_part(simd, part, position, offset, step.dx);
        }
        beside & ((1u32 << lanes) - 1) as u16
    }

    /// Keeps what a particle has for nodes that it does not see, and returns those that it sees.
    #[inline(always)]
    #[expect(clippy::needless_range_loop, reason = "several arrays go in step, in vectors")]
    pub(super) fn hide(
        &self,
        number: usize,
        lane: usize,
        pack: &Pack,
        scratch: &Scratch,
        chunk: &mut Chunk,
        step: &Step,
    ) -> u16 {
        let [_, now] = self.barriers;
        let position = pack.position.map(|along| along[lane]);
        let stencil = Stencil::at(position, step.inverse_dx);
        let [[x, y], [x_of_i, y_of_i], [x_of_j, y_of_j]] =
            [scratch.vectors[0][lane], scratch.vectors[1][lane], scratch.vectors[2][lane]];
        let mut falling = [[0.0; WAYS]; 2];
        for k in 0..WAYS {
            let [i, j] = [(k / 3 % 3) as f32, (k % 3) as f32];
            falling[0][k] = x + i * x_of_i + j * x_of_j;
            falling[1][k] = y + i * y_of_i + j * y_of_j - step.fall;
        }
        let Some(hidden) = now.hidden(position, &stencil, &falling, &mut chunk.loads) else {
            return ALL_NODES;
        };
        if hidden.visible == ALL_NODES {
            chunk.beside.whole.push(Start { pack: number, lane, position });
        } else {
            let particle = pack.get(lane);
            chunk.beside.apart.push(Kept { pack: number, lane, particle, hidden });
        }
        hidden.visible
    }
}

/// The particles that may not see all of their nodes because of this part, or are less than a cell in front of it: those for which none
/// of its surfaces has all nodes in front of it. `offset` is the distance from their lowest nodes (cells).
#[inline(always)]
fn beside_part<S: Simd>(
    simd: S,
    part: &Part,
    [x, y]: [S::Lanes; 2],
    offset: [S::Lanes; 2],
    dx: f32,
) -> u16 {
    match part {
        Part::Disc { centre, radius } => {
            let (u, v) = (x - simd.splat(centre[0]), y - simd.splat(centre[1]));
            let reach = radius + FARTHEST_NODE * dx;
            simd.bits(simd.less(u * u + v * v, simd.splat(reach * reach)))
        }
        Part::Convex { edges, .. } => {
            let mut bits = u16::MAX;
            for edge in edges {
                let [u, v] = edge.normal;
                let along = simd.splat(u) * x + simd.splat(v) * y - simd.splat(edge.offset);
                let back = backwards(simd, u, offset[0]) + backwards(simd, v, offset[1]);
                let back = simd.max(back, 1.0) + simd.splat(ROUNDING);
                bits &= simd.bits(simd.less(along, back * simd.splat(dx)));
            }
            bits
        }
    }
}

/// How far behind a particle its nodes reach along one component of a normal (cells).
#[inline(always)]
fn backwards<S: Simd>(simd: S, normal: f32, offset: S::Lanes) -> S::Lanes {
    match normal > 0.0 {
        true => simd.splat(normal) * offset,
        false => simd.splat(normal) * (offset - simd.splat(2.0)),
    }
}

/// Distance from a particle to the farthest node of its stencil: 1.5 along both axes (cells).
const FARTHEST_NODE: f32 = 2.13;
/// More than the rounding of a distance (cells).
const ROUNDING: f32 = 1e-3;
