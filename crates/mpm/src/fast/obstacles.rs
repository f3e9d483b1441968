//! Tools beside the particles of a chunk. What particles have for nodes that they do not see they keep, as
//! [`Hidden`](super::super::tool::Hidden) of the plain solver, until they gather.

use super::{
    super::{
        grid::{WALL_CELLS, at_walls},
        step::Step,
        tool::{Barriers, Loads, MAX_TOOLS, Moving},
    },
    pack::Pack,
    sight::{NODES, Surfaces, Ways, beside, may_enter},
    simd::{LANES, Lanes, Simd},
    stencil::{Stencils, weights},
    transfer::Scratch,
};
use eddy_frames::tool::Contact;

/// The tools in a pass.
#[derive(Clone, Copy, Debug)]
pub(super) struct Obstacles<'a> {
    /// Where they were when particles have scattered, and where they are when they have moved.
    barriers: [&'a Barriers; 2],
}

/// What the particles of a pack keep that have scattered beside tools.
#[derive(Clone, Debug)]
pub(super) struct Kept {
    /// The pack in its chunk.
    pack: usize,
    /// The particles that are beside a tool, as bits.
    beside: u16,
    /// Those of them that do not see all of their nodes.
    pub(super) apart: u16,
    /// The nodes that each sees, as bits 3 i + j.
    pub(super) visible: [u16; LANES],
    /// The sum of the weights of these nodes.
    pub(super) seen: Lanes,
    /// The sum of the weights of the other nodes, times the velocities (u, v) that are there.
    pub(super) velocity: [Lanes; 2],
    /// The same with the distances (x, y) to the nodes: u x, u y, v x, v y (cells).
    pub(super) moment: [Lanes; 4],
}

/// All nodes, as bits.
const ALL_NODES: u16 = (1 << NODES) - 1;

impl Kept {
    /// Of particles that see all of their nodes.
    #[inline(always)]
    fn nothing(pack: usize, beside: u16) -> Self {
        let zero = [0.0; LANES];
        Self {
            pack,
            beside,
            apart: 0,
            visible: [ALL_NODES; LANES],
            seen: [1.0; LANES],
            velocity: [zero; 2],
            moment: [zero; 4],
        }
    }

    /// What a pack has kept, which is the first of what is `waiting` if there is any, and then left out.
    #[inline]
    pub(super) fn take<'a>(waiting: &mut &'a [Self], pack: usize) -> Option<&'a Self> {
        let (first, rest) = waiting.split_first()?;
        (first.pack == pack).then(|| {
            *waiting = rest;
            first
        })
    }
}

impl<'a> Obstacles<'a> {
    /// `None` if there are no tools.
    pub(super) fn of(barriers: [&'a Barriers; 2]) -> Option<Self> {
        (!barriers[1].is_empty()).then_some(Self { barriers })
    }

    /// The numbers of the parts that may be between nodes and particles in a box with these corners, lower first.
    pub(super) fn near(&self, bounds: [[f32; 2]; 2]) -> Vec<usize> {
        self.barriers[1].near(bounds)
    }

    /// Puts the particles of a pack that were beside a tool out of it, where they have moved into it from these positions. Unused lanes stay
    /// copies of the first.
    #[inline(always)]
    pub(super) fn resolve<S: Simd>(
        &self,
        simd: S,
        kept: &Kept,
        from: &[Lanes; 2],
        pack: &mut Pack,
        lanes: usize,
        step: &Step,
    ) {
        let [before, after] = self.barriers;
        let of = |place: &[Lanes; 2]| [simd.load(&place[0]), simd.load(&place[1])];
        let mut entering = 0;
        for (old, new) in before.parts.iter().zip(&after.parts) {
            let parts = [&old.part, &new.part];
            entering |= may_enter(simd, parts, of(from), of(&pack.position), step.dx);
        }
        entering &= kept.beside;
        for lane in (0..lanes).filter(|lane| entering >> lane & 1 == 1) {
            let [start, end] = [from, &pack.position].map(|place| place.map(|along| along[lane]));
            let [x, y] = after.resolved(before, start, end);
            (pack.position[0][lane], pack.position[1][lane]) = (x, y);
        }
        for lane in lanes..LANES {
            pack.set(lane, &pack.get(0), pack.index[0]);
        }
    }

    /// Keeps what the particles of a pack have for nodes that they do not see. `near` are the parts near the chunk. `None` if none is beside
    /// a tool.
    #[inline(always)]
    pub(super) fn hide<S: Simd>(
        &self,
        simd: S,
        (number, pack, lanes): (usize, &Pack, usize),
        (stencils, scratch): (&Stencils<S>, &Scratch),
        near: &[usize],
        step: &Step,
        loads: &mut Loads,
    ) -> Option<Kept> {
        let [_, now] = self.barriers;
        let from = [simd.load(&pack.position[0]), simd.load(&pack.position[1])];
        let ways = Ways::new(simd, from, stencils, step.dx);
        let (mut is_beside, mut tools) = (0, 0u32);
        let mut surfaces = Surfaces::none(simd);
        for &index in near {
            let posed = &now.parts[index];
            let found = beside(simd, &posed.part, &ways, step.dx);
            if found != 0 {
                surfaces.meet(simd, &ways, &posed.part, posed.tool);
                is_beside |= found;
                tools |= 1 << posed.tool;
            }
        }
        is_beside &= ((1u32 << lanes) - 1) as u16;
        if is_beside == 0 {
            return None;
        }
        let mut kept = Kept::nothing(number, is_beside);
        let is_used = simd.less(simd.load(&NUMBERS), simd.splat(lanes as f32));
        let mut hidden = [0; NODES];
        for k in 0..NODES {
            hidden[k] = simd.bits(simd.at_least(simd.splat(1.0), surfaces.share[k]) & is_used);
            kept.apart |= hidden[k];
        }
        if kept.apart != 0 {
            for lane in 0..LANES {
                for (k, hidden) in hidden.iter().enumerate() {
                    kept.visible[lane] &= !((hidden >> lane & 1) << k);
                }
            }
            let share = surfaces.share;
            for k in 0..NODES {
                let is_met = simd.at_least(simd.splat(1.0), share[k]) & is_used;
                surfaces.share[k] = simd.select(is_met, share[k], simd.splat(f32::INFINITY));
            }
            let met = Met { ways: &ways, surfaces: &surfaces, hidden: &hidden, tools };
            met.keep(simd, now, stencils, scratch, step, (&mut kept, loads));
        }
        Some(kept)
    }
}

/// What hides nodes of the particles of a pack.
struct Met<'a, S: Simd> {
    ways: &'a Ways<S>,
    surfaces: &'a Surfaces<S>,
    /// The particles that do not see each node, as bits.
    hidden: &'a [u16; NODES],
    /// The tools that may be in between, as bits.
    tools: u32,
}

impl<S: Simd> Met<'_, S> {
    /// Adds what particles keep, and what it has given to tools.
    #[inline(always)]
    fn keep(
        &self,
        simd: S,
        barriers: &Barriers,
        stencils: &Stencils<S>,
        scratch: &Scratch,
        step: &Step,
        (kept, loads): (&mut Kept, &mut Loads),
    ) {
        let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
        let [lowest, along_x, along_y] = [0, 1, 2].map(|k| simd.load_vectors(&scratch.vectors[k]));
        let (from, offset) = (self.ways.from, stencils.offset);
        let across = weights(simd, offset[1]);
        let is_at_walls = is_at_walls(&stencils.base, barriers.sides);
        let mut given = [[zero; 4]; MAX_TOOLS];
        let (mut unseen, mut velocity_sum, mut moment) = (zero, [zero; 2], [zero; 4]);
        for k in 0..NODES {
            if self.hidden[k] == 0 {
                continue;
            }
            let place = [simd.splat((k / 3) as f32), simd.splat((k % 3) as f32)];
            let is_hidden = simd.at_least(one, self.surfaces.share[k]);
            let share = simd.select(is_hidden, self.surfaces.share[k], zero);
            let weight = simd.select(is_hidden, stencils.weight[k / 3] * across[k % 3], zero);
            let (mut velocity, mut point) = ([zero; 2], [zero; 2]);
            let node = [self.ways.to[0][k / 3], self.ways.to[1][k % 3]];
            for axis in 0..2 {
                velocity[axis] = lowest[axis] + place[0] * along_x[axis] + place[1] * along_y[axis];
                point[axis] = from[axis] + share * (node[axis] - from[axis]);
            }
            velocity[1] = velocity[1] - simd.splat(step.fall);
            for tool in 0..barriers.tools.len() {
                if self.tools >> tool & 1 == 0 {
                    continue;
                }
                let is_met = is_hidden & simd.equal(self.surfaces.tool[k], simd.splat(tool as f32));
                let mass = simd.select(is_met, weight, zero);
                let moving = &barriers.tools[tool];
                let normal = self.surfaces.normal[k];
                let met = meet(simd, moving, point, normal, (mass, velocity), &mut given[tool]);
                for axis in 0..2 {
                    velocity[axis] = simd.select(is_met, met[axis], velocity[axis]);
                }
            }
            if is_at_walls {
                velocity = at_walls_one_by_one(simd, velocity, k, &stencils.base, barriers);
            }
            unseen = unseen + weight;
            for axis in 0..2 {
                let product = weight * velocity[axis];
                velocity_sum[axis] = velocity_sum[axis] + product;
                for along in 0..2 {
                    let distance = place[along] - offset[along];
                    moment[2 * axis + along] = moment[2 * axis + along] + product * distance;
                }
            }
        }
        simd.store(one - unseen, &mut kept.seen);
        for axis in 0..2 {
            simd.store(velocity_sum[axis], &mut kept.velocity[axis]);
        }
        for (moment, kept) in moment.into_iter().zip(&mut kept.moment) {
            simd.store(moment, kept);
        }
        for (tool, given) in given.iter().enumerate().take(barriers.tools.len()) {
            let [x, y, angular, work] = given.map(|lanes| added_up(simd, lanes));
            let load = &mut loads.0[tool];
            load.impulse = [load.impulse[0] + x, load.impulse[1] + y];
            load.angular += angular;
            load.work += work;
        }
    }
}

/// The velocities of matter that has met the surface of a tool at these points. Adds impulse along x and y, angular impulse and work to what
/// is `given` to the tool.
#[inline(always)]
fn meet<S: Simd>(
    simd: S,
    moving: &Moving,
    point: [S::Lanes; 2],
    normal: [S::Lanes; 2],
    (mass, velocity): (S::Lanes, [S::Lanes; 2]),
    given: &mut [S::Lanes; 4],
) -> [S::Lanes; 2] {
    let position = moving.pose.position;
    let arm = [point[0] - simd.splat(position[0]), point[1] - simd.splat(position[1])];
    let spin = simd.splat(moving.spin);
    let surface = [
        simd.splat(moving.velocity[0]) - spin * arm[1],
        simd.splat(moving.velocity[1]) + spin * arm[0],
    ];
    let relative = [velocity[0] - surface[0], velocity[1] - surface[1]];
    let left = met(simd, moving.contact, relative, normal);
    let u = mass * (relative[0] - left[0]);
    let v = mass * (relative[1] - left[1]);
    given[0] = given[0] + u;
    given[1] = given[1] + v;
    given[2] = given[2] + (arm[0] * v - arm[1] * u);
    given[3] = given[3] + (u * surface[0] + v * surface[1]);
    [left[0] + surface[0], left[1] + surface[1]]
}

/// As the function of the same name of the plain solver.
#[inline(always)]
fn met<S: Simd>(
    simd: S,
    contact: Contact,
    relative: [S::Lanes; 2],
    normal: [S::Lanes; 2],
) -> [S::Lanes; 2] {
    let (zero, one) = (simd.splat(0.0), simd.splat(1.0));
    let friction = match contact {
        Contact::Sticky => return [zero; 2],
        Contact::Slip => 0.0,
        Contact::Friction(friction) => friction,
    };
    let into = relative[0] * normal[0] + relative[1] * normal[1];
    let along = [relative[0] - into * normal[0], relative[1] - into * normal[1]];
    let speed = simd.sqrt(along[0] * along[0] + along[1] * along[1]);
    let taken = zero - simd.splat(friction) * into;
    let share = simd.select(simd.at_least(taken, speed), zero, one - taken / speed);
    let leaves = simd.at_least(into, zero);
    [
        simd.select(leaves, relative[0], along[0] * share),
        simd.select(leaves, relative[1], along[1] * share),
    ]
}

/// Whether any of these stencils has nodes at the walls of the domain.
fn is_at_walls(base: &[[i32; LANES]; 2], sides: [usize; 2]) -> bool {
    (0..2).any(|axis| {
        let last = (sides[axis] - WALL_CELLS - 2) as i32;
        base[axis].iter().any(|&base| base < WALL_CELLS as i32 || base >= last)
    })
}

/// Velocities at node `k` of each stencil after the walls of the domain, which few are at.
fn at_walls_one_by_one<S: Simd>(
    simd: S,
    velocity: [S::Lanes; 2],
    k: usize,
    base: &[[i32; LANES]; 2],
    barriers: &Barriers,
) -> [S::Lanes; 2] {
    let mut lanes = [[0.0; LANES]; 2];
    simd.store(velocity[0], &mut lanes[0]);
    simd.store(velocity[1], &mut lanes[1]);
    for lane in 0..LANES {
        let index = [base[0][lane] as usize + k / 3, base[1][lane] as usize + k % 3];
        let free = [lanes[0][lane], lanes[1][lane]];
        [lanes[0][lane], lanes[1][lane]] =
            at_walls(free, index, barriers.sides, barriers.wall_friction);
    }
    [simd.load(&lanes[0]), simd.load(&lanes[1])]
}

/// The sum over all particles of a pack, first of those that are eight apart.
#[inline(always)]
fn added_up<S: Simd>(simd: S, value: S::Lanes) -> f64 {
    let mut lanes = [0.0; LANES];
    simd.store(value, &mut lanes);
    let mut half = LANES / 2;
    while half > 0 {
        for k in 0..half {
            lanes[k] += lanes[k + half];
        }
        half /= 2;
    }
    f64::from(lanes[0])
}

/// The number of each lane.
const NUMBERS: Lanes =
    [0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0, 13.0, 14.0, 15.0];
