//! Tools between particles and nodes.
//!
//! A node that a particle does not see, because a tool is between them, gets nothing of it: what the particle would have given to it stays
//! with the particle, meets the surface of the tool and is gathered again with the other nodes. Matter on the two sides of a wall, however
//! thin, never meets at a node; the momentum that the surface takes is the impulse on the tool. Particles whose way enters a tool end
//! beside its surface. Sides are those of the particles' positions: nothing has to be remembered.
//!
//! After the compatible particle-in-cell method (CPIC) of Hu et al. 2018, section 5, which marks the sides of nodes and particles instead.

use super::{
    super::{grid::at_walls, matrix::Matrix2, spline::Stencil, step::Step},
    Contact, Edge, Part, Pose, ToolMotion, met,
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
    pub(in super::super) parts: Vec<Posed>,
    pub(in super::super) tools: Vec<Moving>,
    /// Cell width (domain lengths).
    dx: f32,
    /// Nodes along x and y.
    pub(in super::super) sides: [usize; 2],
    /// Coefficient of friction at the walls of the domain.
    pub(in super::super) wall_friction: f32,
}

/// A part of a tool.
#[derive(Clone, Debug)]
pub(in super::super) struct Posed {
    pub(in super::super) part: Part,
    /// Index of its tool.
    pub(in super::super) tool: usize,
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
pub(in super::super) struct Moving {
    pub(in super::super) pose: Pose,
    /// Cosine and sine of its angle.
    direction: [f32; 2],
    /// Velocity of its position (domain lengths per s).
    pub(in super::super) velocity: [f32; 2],
    /// Angular velocity (rad/s).
    pub(in super::super) spin: f32,
    pub(in super::super) contact: Contact,
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

impl Hidden {
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

    /// The numbers of the parts that may be between nodes and particles in a box. `lower` and `upper` are its corners.
    pub(in super::super) fn near(&self, [lower, upper]: [[f32; 2]; 2]) -> Vec<usize> {
        let middle = [0, 1].map(|k| 0.5 * (lower[k] + upper[k]));
        let reach = (upper[0] - lower[0]) + (upper[1] - lower[1]) + 2.0 * SIGHT * self.dx;
        let is_near = |number: &usize| {
            let Posed { part, bounds: [from, to], .. } = &self.parts[*number];
            let meets = (0..2).all(|axis| lower[axis] < to[axis] && upper[axis] > from[axis]);
            meets && part.distance(middle) < reach
        };
        (0..self.parts.len()).filter(is_near).collect()
    }

    /// The nodes of a row at this x that are near tools: the range of their y (domain lengths).
    pub(in super::super) fn near_row(&self, x: f32) -> Option<[f32; 2]> {
        let near =
            self.parts.iter().filter(|posed| x >= posed.bounds[0][0] && x <= posed.bounds[1][0]);
        let ranges = near.map(|Posed { bounds: [lower, upper], .. }| [lower[1], upper[1]]);
        ranges.reduce(|a, b| [a[0].min(b[0]), a[1].max(b[1])])
    }

    /// What a particle keeps behind the surfaces of tools. `velocity` is that which it would give to node (i, j) of its stencil, after
    /// gravity. `None` if it sees all of its nodes and is further than a cell from all tools. The impulses on the tools are added to
    /// `loads`.
    pub(in super::super) fn hidden(
        &self,
        position: [f32; 2],
        stencil: &Stencil,
        velocity: impl Fn([usize; 2]) -> [f32; 2],
        loads: &mut Loads,
    ) -> Option<Hidden> {
        let near = || self.parts.iter().filter(|posed| posed.holds(position));
        let is_beside = near().any(|posed| posed.part.distance(position) < self.dx);
        let mut hidden = Hidden { visible: ALL_NODES, velocity: [0.0; 2], moment: Matrix2::ZERO };
        for (place, weight, [x, y]) in stencil.nodes() {
            let index = [0, 1].map(|axis| stencil.base[axis] + place[axis]);
            let node = index.map(|k| k as f32 * self.dx);
            let met = near().filter_map(|Posed { part, tool, .. }| {
                part.entered(position, node).map(|(share, surface)| (share, surface, *tool))
            });
            let first = met.reduce(|first, other| if other.0 < first.0 { other } else { first });
            let Some((share, Edge { normal, .. }, tool)) = first else { continue };
            hidden.visible &= !(1 << (3 * place[0] + place[1]));
            let point = [0, 1].map(|k| position[k] + share * (node[k] - position[k]));
            let kept = self.meet(tool, point, normal, weight, velocity(place), loads);
            let [u, v] = at_walls(kept, index, self.sides, self.wall_friction).map(|v| weight * v);
            hidden.velocity = [hidden.velocity[0] + u, hidden.velocity[1] + v];
            hidden.moment = hidden.moment + Matrix2::new(u * x, u * y, v * x, v * y);
        }
        (is_beside || hidden.visible != ALL_NODES).then_some(hidden)
    }

    /// The velocity of matter that has met the surface of a tool at a point, in place of that which it had. `mass` is in units of a
    /// particle's.
    fn meet(
        &self,
        tool: usize,
        [x, y]: [f32; 2],
        normal: [f32; 2],
        mass: f32,
        velocity: [f32; 2],
        loads: &mut Loads,
    ) -> [f32; 2] {
        let Moving { pose, velocity: [u0, v0], spin, contact, .. } = self.tools[tool];
        let arm = [x - pose.position[0], y - pose.position[1]];
        let surface = [u0 - spin * arm[1], v0 + spin * arm[0]];
        let relative = [velocity[0] - surface[0], velocity[1] - surface[1]];
        let left = met(contact, relative, normal);
        let [u, v] = [0, 1].map(|k| mass * (relative[k] - left[k]));
        let load = &mut loads.0[tool];
        load.impulse = [load.impulse[0] + f64::from(u), load.impulse[1] + f64::from(v)];
        load.angular += f64::from(arm[0] * v - arm[1] * u);
        load.work += f64::from(u * surface[0] + v * surface[1]);
        [left[0] + surface[0], left[1] + surface[1]]
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
                velocity = self.meet(*tool, node, normal, particles, velocity, loads);
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
