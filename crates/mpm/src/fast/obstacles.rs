//! Tools beside the particles of a chunk. What particles have for nodes that they do not see they keep, as
//! [`Hidden`](super::super::tool::Hidden) of the plain solver, until they gather.

use super::{
    super::{
        grid::{WALL_CELLS, at_walls},
        step::Step,
        tool::{Barriers, Loads, MAX_TOOLS, Moving, Posed},
    },
    field::Nodes,
    gather::gather,
    level::Work,
    pack::Pack,
    sight::{NODES, Surfaces, Ways, beside, choose, may_enter, near},
    simd::{LANES, Lanes, Simd, Vectors},
    stencil::{Stencils, Weights, weights},
    transfer::Scratch,
};
use eddy_frames::tool::Contact;

/// What the particles of a pack keep that have scattered beside tools.
#[derive(Clone, Debug)]
pub(super) struct Kept {
    /// The pack in its chunk.
    pub(super) pack: usize,
    /// The particles that are beside a tool, as bits.
    beside: u16,
    /// Those of them that do not see all of their nodes.
    apart: u16,
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

/// Finds for each pack whether particles may be beside a tool after their next motion.
pub(super) struct NearTools<'a> {
    pub(super) packs: &'a [Pack],
    pub(super) parts: &'a [Posed],
    /// The numbers of the parts near the chunk.
    pub(super) near: &'a [usize],
    pub(super) step: &'a Step,
}

impl Work for NearTools<'_> {
    type Output = Vec<bool>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Vec<bool> {
        let mut is_near = vec![false; self.packs.len()];
        for (pack, is_near) in self.packs.iter().zip(&mut is_near) {
            let position = [simd.load(&pack.position[0]), simd.load(&pack.position[1])];
            for &index in self.near {
                *is_near |= near(simd, &self.parts[index].part, position, self.step.dx) != 0;
            }
        }
        is_near
    }
}

/// Gathers velocities for a pack, as [`gather`], of which some particles were beside a tool, and puts these out of the tools into which they
/// have moved.
pub(super) struct GatherSeen<'a> {
    pub(super) pack: &'a mut Pack,
    pub(super) lanes: usize,
    pub(super) kept: &'a Kept,
    pub(super) field: Nodes<'a>,
    pub(super) step: &'a Step,
    /// The tools where they were when particles have scattered, and where they are when they have moved.
    pub(super) barriers: [&'a Barriers; 2],
}

impl Work for GatherSeen<'_> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { pack, lanes, kept, field, step, barriers: [before, after] } = self;
        let from = pack.position;
        let mut scratch = Scratch::EMPTY;
        gather(simd, &Weights::new(simd), pack, field, step, (&mut scratch, Some(kept)));
        let start = [simd.load(&from[0]), simd.load(&from[1])];
        let end = [simd.load(&pack.position[0]), simd.load(&pack.position[1])];
        let mut entering = 0;
        for (old, new) in before.parts.iter().zip(&after.parts) {
            entering |= may_enter(simd, [&old.part, &new.part], start, end, step.dx);
        }
        for lane in lanes_of(entering & kept.beside) {
            let [start, end] = [&from, &pack.position].map(|place| place.map(|along| along[lane]));
            let [x, y] = after.resolved(before, start, end);
            (pack.position[0][lane], pack.position[1][lane]) = (x, y);
        }
        // Unused lanes stay copies of the first.
        for lane in lanes..LANES {
            pack.set(lane, &pack.get(0), pack.index[0]);
        }
    }
}

/// The lanes whose bits are set.
fn lanes_of(bits: u16) -> impl Iterator<Item = usize> {
    (0..LANES).filter(move |lane| bits >> lane & 1 == 1)
}

/// Keeps what the particles of a pack have for nodes that they do not see. Returns the nodes (i, j) that each sees, as bits 3 i + j, unless all
/// see all.
pub(super) struct Hide<'a> {
    /// The pack in its chunk.
    pub(super) number: usize,
    pub(super) pack: &'a Pack,
    pub(super) lanes: usize,
    /// What each gives to its nodes, as `scatter::prepare` leaves it.
    pub(super) given: [Vectors; 3],
    pub(super) barriers: &'a Barriers,
    /// The numbers of the parts near the chunk.
    pub(super) near: &'a [usize],
    pub(super) step: &'a Step,
    pub(super) loads: &'a mut Loads,
    pub(super) kept: &'a mut Vec<Kept>,
}

impl Work for Hide<'_> {
    type Output = Option<[u16; LANES]>;

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) -> Option<[u16; LANES]> {
        let Self { number, pack, lanes, given, barriers, near, step, loads, kept: all } = self;
        let from = [simd.load(&pack.position[0]), simd.load(&pack.position[1])];
        let inverse_dx = simd.splat(step.inverse_dx);
        let stencils = Stencils::of(simd, [from[0] * inverse_dx, from[1] * inverse_dx]);
        let ways = Ways::new(simd, from, &stencils, step.dx);
        let (mut is_beside, mut tools) = (0, 0);
        let mut surfaces = Surfaces::none(simd);
        for &index in near {
            let posed = &barriers.parts[index];
            let found = beside(simd, &posed.part, &ways);
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
        all.push(Kept::nothing(number, is_beside));
        let kept = all.last_mut()?;
        let is_used = simd.less(simd.load(&NUMBERS), simd.splat(lanes as f32));
        let mut hidden = [0; NODES];
        for (share, hidden) in surfaces.share.iter_mut().zip(&mut hidden) {
            let is_met = simd.at_least(simd.splat(1.0), *share) & is_used;
            *share = simd.select(is_met, *share, simd.splat(f32::INFINITY));
            *hidden = simd.bits(is_met);
            kept.apart |= *hidden;
        }
        if kept.apart == 0 {
            return None;
        }
        for lane in lanes_of(kept.apart) {
            for (k, hidden) in hidden.iter().enumerate() {
                kept.visible[lane] &= !((hidden >> lane & 1) << k);
            }
        }
        let met = Met { stencils, ways, surfaces, hidden, tools };
        met.keep(simd, barriers, &given, step, (kept, loads));
        Some(kept.visible)
    }
}

/// What hides nodes of the particles of a pack.
struct Met<S: Simd> {
    stencils: Stencils<S>,
    ways: Ways<S>,
    surfaces: Surfaces<S>,
    /// The particles that do not see each node, as bits.
    hidden: [u16; NODES],
    /// The tools that may be in between, as bits.
    tools: u32,
}

/// What sixteen particles keep.
struct Sums<S: Simd> {
    /// Of weights.
    weight: S::Lanes,
    velocity: [S::Lanes; 2],
    moment: [S::Lanes; 4],
}

impl<S: Simd> Met<S> {
    /// Adds what particles keep, and what it has given to tools.
    #[inline(always)]
    fn keep(
        &self,
        simd: S,
        barriers: &Barriers,
        [lowest, along_x, along_y]: &[Vectors; 3],
        step: &Step,
        (kept, loads): (&mut Kept, &mut Loads),
    ) {
        let zero = simd.splat(0.0);
        let lowest = simd.load_vectors(lowest);
        let (along_x, along_y) = (simd.load_vectors(along_x), simd.load_vectors(along_y));
        let across = weights(simd, self.stencils.offset[1]);
        let is_at_walls = is_at_walls(&self.stencils.base, barriers.sides);
        let mut given = [[zero; 4]; MAX_TOOLS];
        let mut sums = Sums { weight: zero, velocity: [zero; 2], moment: [zero; 4] };
        for k in 0..NODES {
            if self.hidden[k] == 0 {
                continue;
            }
            let (i, j) = (simd.splat((k / 3) as f32), simd.splat((k % 3) as f32));
            let mut velocity = [
                lowest[0] + i * along_x[0] + j * along_y[0],
                lowest[1] + i * along_x[1] + j * along_y[1] - simd.splat(step.fall),
            ];
            let is_hidden = simd.at_least(simd.splat(1.0), self.surfaces.share[k]);
            let weight = self.stencils.weight[k / 3] * across[k % 3];
            let weight = simd.select(is_hidden, weight, zero);
            velocity = self.meet(simd, barriers, k, (weight, velocity), &mut given);
            if is_at_walls {
                velocity = at_walls_one_by_one(simd, velocity, k, &self.stencils.base, barriers);
            }
            sums.add(weight, velocity, [i - self.ways.offset[0], j - self.ways.offset[1]]);
        }
        sums.store(simd, kept);
        for (tool, given) in given.iter().enumerate() {
            if self.tools >> tool & 1 == 1 {
                let load = &mut loads.0[tool];
                load.impulse[0] += added_up(simd, given[0]);
                load.impulse[1] += added_up(simd, given[1]);
                load.angular += added_up(simd, given[2]);
                load.work += added_up(simd, given[3]);
            }
        }
    }

    /// The velocities for node `k` after matter with this weight and velocity has met the surfaces.
    #[inline(always)]
    fn meet(
        &self,
        simd: S,
        barriers: &Barriers,
        k: usize,
        (weight, mut velocity): (S::Lanes, [S::Lanes; 2]),
        given: &mut [[S::Lanes; 4]; MAX_TOOLS],
    ) -> [S::Lanes; 2] {
        let zero = simd.splat(0.0);
        let Self { ways, surfaces, tools, .. } = self;
        let is_hidden = simd.at_least(simd.splat(1.0), surfaces.share[k]);
        let share = simd.select(is_hidden, surfaces.share[k], zero);
        let point = [
            ways.from[0] + share * (ways.to[0][k / 3] - ways.from[0]),
            ways.from[1] + share * (ways.to[1][k % 3] - ways.from[1]),
        ];
        for (tool, moving) in barriers.tools.iter().enumerate() {
            if tools >> tool & 1 == 1 {
                let is_met = is_hidden & simd.equal(surfaces.tool[k], simd.splat(tool as f32));
                let mass = simd.select(is_met, weight, zero);
                let normal = surfaces.normal[k];
                let met = meet(simd, moving, point, normal, (mass, velocity), &mut given[tool]);
                velocity = choose(simd, is_met, met, velocity);
            }
        }
        velocity
    }
}

impl<S: Simd> Sums<S> {
    /// Adds what is at nodes at this distance (cells).
    #[inline(always)]
    fn add(&mut self, weight: S::Lanes, [u, v]: [S::Lanes; 2], [x, y]: [S::Lanes; 2]) {
        let (u, v) = (weight * u, weight * v);
        self.weight = self.weight + weight;
        self.velocity = [self.velocity[0] + u, self.velocity[1] + v];
        let [a, b, c, d] = self.moment;
        self.moment = [a + u * x, b + u * y, c + v * x, d + v * y];
    }

    #[inline(always)]
    fn store(self, simd: S, kept: &mut Kept) {
        simd.store(simd.splat(1.0) - self.weight, &mut kept.seen);
        for (sum, kept) in self.velocity.into_iter().zip(&mut kept.velocity) {
            simd.store(sum, kept);
        }
        for (sum, kept) in self.moment.into_iter().zip(&mut kept.moment) {
            simd.store(sum, kept);
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
    choose(simd, leaves, relative, [along[0] * share, along[1] * share])
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
