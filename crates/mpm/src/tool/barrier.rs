//! Tools between particles and nodes.
//!
//! A node that a particle does not see, because a tool is between them, gets nothing of it: what the particle would have given to it stays
//! with the particle, meets the surface of the tool and is gathered again with the other nodes. Matter on the two sides of a wall, however
//! thin, never meets at a node; the momentum that the surface takes is the impulse on the tool. Particles whose way enters a tool end
//! beside its surface. Sides are those of the particles' positions: nothing has to be remembered.
//!
//! After the compatible particle-in-cell method (CPIC) of Hu et al. 2018, section 5, which marks the sides of nodes and particles instead.

use super::{
    super::{
        grid::{WALL_CELLS, at_walls},
        matrix::Matrix2,
        spline::Stencil,
        step::Step,
    },
    Contact, Edge, Entries, Part, Pose, ToolMotion, met,
};

/// Distance from the surface at which particles end that would enter a tool (cells).
const GAP: f32 = 1e-3;
/// Distance along an axis beyond which tools do not matter to a particle or a node (cells): half of its kernel, and a little more.
pub(in super::super) const SIGHT: f32 = 1.6;
/// Distance from a surface within which nodes in front of it meet it (cells). With less, nodes that no surface stops press matter against it
/// until it is several times as dense (`docs/lab/tools.md`).
const BESIDE: f32 = 1.0;
/// Number of nodes of a stencil, and all of them as bits.
const NODES: usize = 9;
pub(in super::super) const ALL_NODES: u16 = (1 << NODES) - 1;
/// How many surfaces a particle may slide along in a substep: two in a corner, and again.
const SLIDES: usize = 4;

/// All tools, as they are at one moment.
#[derive(Clone, Debug, Default)]
pub(in super::super) struct Barriers {
    parts: Vec<Posed>,
    tools: Vec<Moving>,
    /// Cell width (domain lengths).
    dx: f32,
    /// Nodes along x and y.
    sides: [usize; 2],
    /// Coefficient of friction at the walls of the domain.
    wall_friction: f32,
}

/// A part of a tool.
#[derive(Clone, Debug)]
struct Posed {
    part: Part,
    /// Index of its tool.
    tool: usize,
    /// Corners of the box beyond which it does not matter to nodes and particles, lower first.
    bounds: [[f32; 2]; 2],
}

impl Posed {
    /// Whether a point lies in its box.
    #[inline]
    fn holds(&self, point: [f32; 2]) -> bool {
        let [lower, upper] = self.bounds;
        (0..2).all(|axis| point[axis] >= lower[axis] && point[axis] <= upper[axis])
    }
}

/// A tool that moves.
#[derive(Clone, Copy, Debug)]
struct Moving {
    pose: Pose,
    /// Cosine and sine of its angle.
    direction: [f32; 2],
    /// Velocity of its position (domain lengths per s).
    velocity: [f32; 2],
    /// Angular velocity (rad/s).
    spin: f32,
    contact: Contact,
}

impl Moving {
    /// Where a point that was there when the tool was at `before` is now, if it moves with the tool.
    fn follows(&self, before: &Self, [x, y]: [f32; 2]) -> [f32; 2] {
        if self.pose == before.pose {
            return [x, y];
        }
        let [x0, y0] = before.pose.position;
        let (dx, dy) = (x - x0, y - y0);
        let [cos, sin] = before.direction;
        let [along, across] = [cos * dx + sin * dy, cos * dy - sin * dx];
        let [cos, sin] = self.direction;
        let [x1, y1] = self.pose.position;
        [x1 + cos * along - sin * across, y1 + sin * along + cos * across]
    }
}

/// Where matter meets surfaces of a tool.
struct Places<const N: usize> {
    /// Their x, and their y.
    point: [[f32; N]; 2],
    /// Outwards.
    normal: [[f32; N]; 2],
    /// The mass there, in units of a particle's; 0 where none meets them.
    mass: [f32; N],
}

/// What a particle keeps of itself behind surfaces, instead of giving it to nodes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(in super::super) struct Hidden {
    /// The nodes (i, j) that it sees, as bits 3 i + j.
    pub(in super::super) visible: u16,
    /// The sum of the weights of the nodes that it does not see, times the velocities that are there.
    pub(in super::super) velocity: [f32; 2],
    /// The same with the distances to the nodes (cells).
    pub(in super::super) moment: Matrix2,
}

/// Ways from a particle to its nodes, and some that fill vectors.
pub(in super::super) const WAYS: usize = 16;

impl Hidden {
    /// Of a particle at this distance from its lowest node that sees these nodes: it keeps `weight` times `velocity` at the others.
    #[inline(always)]
    fn of(
        visible: u16,
        offset: [f32; 2],
        weight: &[f32; WAYS],
        velocity: &[[f32; WAYS]; 2],
    ) -> Self {
        let mut kept = [[0.0; WAYS]; 6];
        for k in 0..WAYS {
            let is_kept = visible >> k & 1 == 0;
            let weight = if is_kept { weight[k] } else { 0.0 };
            let [x, y] = [(k / 3 % 3) as f32 - offset[0], (k % 3) as f32 - offset[1]];
            let [u, v] = [weight * velocity[0][k], weight * velocity[1][k]];
            (kept[0][k], kept[1][k]) = (u, v);
            (kept[2][k], kept[3][k]) = (u * x, u * y);
            (kept[4][k], kept[5][k]) = (v * x, v * y);
        }
        let mut sums = [0.0; 6];
        for (sum, kept) in sums.iter_mut().zip(&kept) {
            *sum = added_up(kept);
        }
        let [u, v, xx, xy, yx, yy] = sums;
        Self { visible, velocity: [u, v], moment: Matrix2::new(xx, xy, yx, yy) }
    }

    /// Whether it sees node (i, j) of its stencil.
    #[inline]
    pub(in super::super) fn sees(&self, [i, j]: [usize; 2]) -> bool {
        self.visible >> (3 * i + j) & 1 == 1
    }
}

/// What matter has given to each tool, in units of a particle's mass.
#[derive(Clone, Debug, Default, PartialEq)]
pub(in super::super) struct Loads(pub(in super::super) Vec<ToolLoad>);

/// What matter has given to a tool in an interval.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ToolLoad {
    /// Impulse (density x domain lengths^3 per s): its mean force is this by the length of the interval.
    pub impulse: [f64; 2],
    /// Angular impulse about the tool's position (density x domain lengths^4 per s).
    pub angular: f64,
    /// Work of matter on the tool (density x domain lengths^4 per s^2).
    pub work: f64,
}

impl ToolLoad {
    /// That of matter with this mass instead of 1.
    pub(in super::super) fn of_mass(self, mass: f64) -> Self {
        let Self { impulse, angular, work } = self;
        Self { impulse: impulse.map(|x| mass * x), angular: mass * angular, work: mass * work }
    }
}

impl Loads {
    /// None yet, for so many tools.
    pub(in super::super) fn new(tools: usize) -> Self {
        Self(vec![ToolLoad::default(); tools])
    }

    /// Adds others.
    pub(in super::super) fn add(&mut self, others: &Self) {
        for (sum, more) in self.0.iter_mut().zip(&others.0) {
            sum.impulse = [0, 1].map(|k| sum.impulse[k] + more.impulse[k]);
            sum.angular += more.angular;
            sum.work += more.work;
        }
    }
}

impl Barriers {
    /// The tools of a motion after a number of substeps.
    pub(in super::super) fn new(motion: &ToolMotion<'_>, substep: u32, step: &Step) -> Self {
        let ToolMotion { tools, motions, substeps, grid } = *motion;
        let (dx, wall_friction) = (step.dx, step.wall_friction);
        let sides = grid.cells.map(|cells| cells as usize + 1);
        let (parts, moving) = (Vec::new(), Vec::new());
        let mut barriers = Self { parts, tools: moving, dx, sides, wall_friction };
        let (share, time) = (substep as f32 / substeps as f32, substeps as f32 * step.dt);
        for (number, (tool, motion)) in tools.iter().zip(motions).enumerate() {
            let pose = motion.at(share);
            let direction = pose.direction();
            let (start, end) = (motion.start, motion.end);
            barriers.tools.push(Moving {
                pose,
                direction,
                velocity: [0, 1].map(|k| (end.position[k] - start.position[k]) / time),
                spin: (end.angle - start.angle) / time,
                contact: tool.contact,
            });
            barriers.parts.extend(tool.shape.parts().iter().map(|part| {
                let part = part.posed(pose, direction);
                let [lower, upper] = part.bounds();
                let (lower, upper) = (lower.map(|x| x - SIGHT * dx), upper.map(|x| x + SIGHT * dx));
                Posed { part, tool: number, bounds: [lower, upper] }
            }));
        }
        barriers
    }

    /// Whether there are none.
    pub(in super::super) fn is_empty(&self) -> bool {
        self.tools.is_empty()
    }

    /// The parts that may be between nodes and particles in a box. `lower` and `upper` are its corners.
    pub(in super::super) fn near(
        &self,
        [lower, upper]: [[f32; 2]; 2],
    ) -> impl Iterator<Item = &Part> + Clone {
        let middle = [0, 1].map(|k| 0.5 * (lower[k] + upper[k]));
        let reach = (upper[0] - lower[0]) + (upper[1] - lower[1]) + 2.0 * SIGHT * self.dx;
        let near = self.parts.iter().filter(move |Posed { part, bounds: [from, to], .. }| {
            let meets = (0..2).all(|axis| lower[axis] < to[axis] && upper[axis] > from[axis]);
            meets && part.distance(middle) < reach
        });
        near.map(|posed| &posed.part)
    }

    /// The nodes of a row at this x that are near tools: the range of their y (domain lengths).
    pub(in super::super) fn near_row(&self, x: f32) -> Option<[f32; 2]> {
        let near =
            self.parts.iter().filter(|posed| x >= posed.bounds[0][0] && x <= posed.bounds[1][0]);
        let ranges = near.map(|Posed { bounds: [lower, upper], .. }| [lower[1], upper[1]]);
        ranges.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])
    }

    /// What a particle keeps behind the surfaces of tools: `velocity` is that which it would give to each node of its stencil, after
    /// gravity: their x, and their y. `None` if it sees all of its nodes and is further than a cell from all tools. The impulses on the tools
    /// are added to `loads`.
    #[inline(always)]
    #[expect(clippy::needless_range_loop, reason = "several arrays go in step, in vectors")]
    pub(in super::super) fn hidden(
        &self,
        position: [f32; 2],
        stencil: &Stencil,
        velocity: &[[f32; WAYS]; 2],
        loads: &mut Loads,
    ) -> Option<Hidden> {
        // In the order of their bits; the last ones are copies.
        let mut nodes = [[0.0; WAYS]; 2];
        for k in 0..WAYS {
            nodes[0][k] = (stencil.base[0] + k / 3 % 3) as f32 * self.dx;
            nodes[1][k] = (stencil.base[1] + k % 3) as f32 * self.dx;
        }
        let (first, tools, is_beside) = self.first_met(position, &nodes);
        let mut visible = 0;
        for k in 0..NODES {
            visible |= u16::from(first.share[k] > 1.0) << k;
        }
        if visible == ALL_NODES {
            let (velocity, moment) = ([0.0; 2], Matrix2::ZERO);
            return is_beside.then_some(Hidden { visible, velocity, moment });
        }
        let mut weight = [0.0; WAYS];
        for k in 0..NODES {
            weight[k] = stencil.weight[0][k / 3] * stencil.weight[1][k % 3];
        }
        let mut kept = *velocity;
        let mut point = [[0.0; WAYS]; 2];
        for k in 0..WAYS {
            let share = if first.share[k] <= 1.0 { first.share[k] } else { 1.0 };
            point[0][k] = position[0] + share * (nodes[0][k] - position[0]);
            point[1][k] = position[1] + share * (nodes[1][k] - position[1]);
        }
        for tool in 0..self.tools.len() as u32 {
            let (mut mass, mut all) = ([0.0; WAYS], 0.0);
            for k in 0..WAYS {
                let is_met = first.share[k] <= 1.0 && tools[k] == tool;
                mass[k] = if is_met { weight[k] } else { 0.0 };
                all += mass[k];
            }
            if all > 0.0 {
                let places = Places { point, normal: first.normal, mass };
                self.meet(tool as usize, &places, &mut kept, loads);
            }
        }
        let is_at_walls = (0..2).any(|axis| {
            stencil.base[axis] < WALL_CELLS
                || stencil.base[axis] + 2 + WALL_CELLS >= self.sides[axis]
        });
        if is_at_walls {
            for k in 0..NODES {
                let index = [stencil.base[0] + k / 3, stencil.base[1] + k % 3];
                [kept[0][k], kept[1][k]] =
                    at_walls([kept[0][k], kept[1][k]], index, self.sides, self.wall_friction);
            }
        }
        Some(Hidden::of(visible, stencil.offset, &weight, &kept))
    }

    /// The first surfaces on the ways from a particle to several points, their tools, and whether the particle is less than a cell in front
    /// of a tool.
    #[inline(always)]
    fn first_met(
        &self,
        position: [f32; 2],
        points: &[[f32; WAYS]; 2],
    ) -> (Entries<WAYS>, [u32; WAYS], bool) {
        let (mut first, mut tools, mut is_beside) = (Entries::NONE, [0; WAYS], false);
        for posed in &self.parts {
            if !posed.holds(position) {
                continue;
            }
            let Posed { part, tool, .. } = posed;
            is_beside |= part.distance(position) < self.dx;
            let Entries { share, normal, .. } = part.entries(position, points);
            for k in 0..WAYS {
                let is_earlier = share[k] < first.share[k];
                first.normal[0][k] = if is_earlier { normal[0][k] } else { first.normal[0][k] };
                first.normal[1][k] = if is_earlier { normal[1][k] } else { first.normal[1][k] };
                tools[k] = if is_earlier { *tool as u32 } else { tools[k] };
                first.share[k] = if is_earlier { share[k] } else { first.share[k] };
            }
        }
        (first, tools, is_beside)
    }

    /// The velocities of matter that has met surfaces of a tool, in place of those that it had: their x, and their y.
    #[inline(always)]
    fn meet<const N: usize>(
        &self,
        tool: usize,
        places: &Places<N>,
        velocity: &mut [[f32; N]; 2],
        loads: &mut Loads,
    ) {
        let Places { point: [x, y], normal, mass } = places;
        let load = &mut loads.0[tool];
        let Moving {
            pose: Pose { position: [x0, y0], .. }, velocity: [u0, v0], spin, contact, ..
        } = self.tools[tool];
        let (mut surface, mut relative) = ([[0.0; N]; 2], [[0.0; N]; 2]);
        for k in 0..N {
            surface[0][k] = u0 - spin * (y[k] - y0);
            surface[1][k] = v0 + spin * (x[k] - x0);
            relative[0][k] = velocity[0][k] - surface[0][k];
            relative[1][k] = velocity[1][k] - surface[1][k];
        }
        let left = met(contact, &relative, normal);
        let mut given = [[0.0; N]; 4];
        for k in 0..N {
            let u = mass[k] * (relative[0][k] - left[0][k]);
            let v = mass[k] * (relative[1][k] - left[1][k]);
            given[0][k] = u;
            given[1][k] = v;
            given[2][k] = (x[k] - x0) * v - (y[k] - y0) * u;
            given[3][k] = u * surface[0][k] + v * surface[1][k];
        }
        for k in 0..N {
            let u = left[0][k] + surface[0][k];
            let v = left[1][k] + surface[1][k];
            velocity[0][k] = if mass[k] > 0.0 { u } else { velocity[0][k] };
            velocity[1][k] = if mass[k] > 0.0 { v } else { velocity[1][k] };
        }
        let [x, y, angular, work] = given.each_ref().map(|given| f64::from(added_up(given)));
        load.impulse = [load.impulse[0] + x, load.impulse[1] + y];
        load.angular += angular;
        load.work += work;
    }

    /// The velocity of a node with the mass of so many particles: less than a cell in front of a surface, it meets that surface.
    #[inline]
    pub(in super::super) fn beside(
        &self,
        node: [f32; 2],
        mut velocity: [f32; 2],
        particles: f32,
        loads: &mut Loads,
    ) -> [f32; 2] {
        for Posed { part, tool, .. } in self.parts.iter().filter(|posed| posed.holds(node)) {
            let faced = part.faced(node).filter(|(distance, _)| *distance < BESIDE * self.dx);
            if let Some((_, Edge { normal, .. })) = faced {
                let [point, normal] = [node, normal].map(|[x, y]| [[x], [y]]);
                let place = Places { point, normal, mass: [particles] };
                let mut met = velocity.map(|v| [v]);
                self.meet(*tool, &place, &mut met, loads);
                velocity = met.map(|[v]| v);
            }
        }
        velocity
    }

    /// The share of a node's kernel that is not behind the surfaces that it faces, as if these were straight.
    pub(in super::super) fn open(&self, node: [f32; 2]) -> f32 {
        let held = self.parts.iter().filter(|posed| posed.holds(node));
        let faced = held.filter_map(|posed| posed.part.faced(node));
        faced.map(|(distance, _)| share_before(distance / self.dx)).product()
    }

    /// Where a particle ends that moves from one position to another while the tools move from where they are in `before` to where they
    /// are now: beside the surfaces that it meets.
    pub(in super::super) fn resolved(
        &self,
        before: &Self,
        from: [f32; 2],
        mut to: [f32; 2],
    ) -> [f32; 2] {
        let gap = GAP * self.dx;
        let mut carried = None;
        for _ in 0..SLIDES {
            let held = self.parts.iter().filter(|posed| posed.holds(to));
            let entered = held.filter_map(|Posed { part, tool, .. }| {
                // As seen from the tool.
                let from = self.tools[*tool].follows(&before.tools[*tool], from);
                part.entered(from, to).map(|(share, surface)| (share, surface, from))
            });
            let first =
                entered.reduce(|first, other| if other.0 < first.0 { other } else { first });
            let Some((_, surface, from)) = first else { return to };
            carried.get_or_insert(from);
            // Not further than a cell out of a tool in which it began.
            let out = (gap - surface.distance(to)).min(self.dx);
            to = [to[0] + out * surface.normal[0], to[1] + out * surface.normal[1]];
        }
        // Between surfaces that leave no room it moves with the first that it has met.
        carried.unwrap_or(to)
    }
}

/// The sum of all numbers: of [`WAYS`], those that are half of them apart first.
#[inline(always)]
fn added_up<const N: usize>(numbers: &[f32; N]) -> f32 {
    let (mut eight, mut four) = ([0.0; 8], [0.0; 4]);
    if N != WAYS {
        return numbers.iter().sum();
    }
    for k in 0..8 {
        eight[k] = numbers[k] + numbers[k + 8];
    }
    for k in 0..4 {
        four[k] = eight[k] + eight[k + 4];
    }
    (four[0] + four[2]) + (four[1] + four[3])
}

/// The share of a node's kernel on its side of a straight surface at this distance (cells): the integral of the quadratic spline.
fn share_before(distance: f32) -> f32 {
    let cube = |x: f32| x * x * x;
    match distance {
        ..-1.5 => 0.0,
        ..-0.5 => cube(1.5 + distance) / 6.0,
        ..0.5 => 0.5 + 0.75 * distance - cube(distance) / 3.0,
        ..1.5 => 1.0 - cube(1.5 - distance) / 6.0,
        _ => 1.0,
    }
}
