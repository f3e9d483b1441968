//! Jelly as an elastic continuum on coarse lattices, one for each body: the impulse that its own stress and walls give it within a frame,
//! while nothing else is close.
//!
//! A frame is as long as a pressure wave needs to cross a body of jelly, so that from one frame to the next only the phase of a
//! body's vibration tells how it goes on. A network does not learn it to the accuracy that a rebound needs, but it can be
//! computed: the total Lagrangian finite-element method with bilinear elements, lumped masses, and symplectic Euler steps
//! (Belytschko et al., "Nonlinear Finite Elements for Continua and Structures", 2014, chapter 4), with the fixed-corotated law of the
//! ground truth (Stomakhin et al. 2012). The elements are larger than the distance of particles, so that few, large steps are stable.
//!
//! 1. Bodies (`cover`): particles of jelly that are connected at rest. A lattice of elements covers each. The particles of an element that
//!    they hardly fill belong to the nearest neighbour that they fill, whose shape functions are extrapolated to them: no node is left
//!    with little mass.
//! 2. Nodes (`fit`; their motion: `node`): their positions and velocities are the least-squares fit to those of the particles. What the
//!    lattice cannot resolve is orthogonal to it, moves freely, and does not disturb the steps of the nodes from frame to frame.
//! 3. Points (`stress`): a quarter of an element each, where the mean of its particles is, with their mass and area. From the deformation
//!    gradient and its rate there follow the stress (first Piola-Kirchhoff; a viscosity damps the waves that are as short as elements, as the
//!    grid of the material-point method does), and its forces on the nodes.
//! 4. The surface (`surface`), in parts that are as wide as a cell of that grid, whatever the width of elements is. Beyond a plane
//!    at some distance from a wall, a part is pushed back by a spring, less while it moves away, without friction.
//! 5. What the steps change at the nodes is interpolated at the particles ([`Impulse`]). A lattice that diverges gives none, nor does one of a
//!    body that other matter is close to, whose forces are not known here, or that is torn, as the ground truth allows.
//! 6. Nor does one whose nodes did not come where it expected them in the last frame ([`Expected`]): a force that is not known here (an
//!    attractor, a hand), another stiffness or a tear shows in a frame, and most often stays for the next. A lattice that had no steps in
//!    the last frame expects nothing, and moves its body.

mod cover;
mod expected;
mod fit;
mod node;
mod stress;
mod surface;

use std::ops::Range;

use eddy_frames::Material;

use super::rest_shape::RestShape;
use cover::Cover;
pub use expected::Expected;
pub use fit::Band;
use node::{Node, add_scaled, squared_distance};
use surface::{bounds, is_within};

/// Particles of a body at least: smaller ones have no lattice.
const MIN_PARTICLES: usize = 16;
/// Width of the parts of a surface: about that of a cell of the ground truth's grid, which is two spacings wide (spacings).
pub const PART_WIDTH: f32 = 1.75;
/// Steps at least in the time that a pressure wave takes to cross the narrowest element. Fewer are unstable; more are accurate.
const STEPS_PER_CROSSING: f32 = 1.5;
/// Square of a step times the frequency of the springs of walls, at most: 4 is unstable, and elasticity adds to it.
const STABLE: f32 = 1.5;
/// Steps per frame at most.
pub const MOST_STEPS: usize = 256;
/// Mass of a node at least, as a share of that of a full element.
const LIGHTEST: f64 = 0.1;
/// Strain that tears a body while walls push it, relative to that of a free one.
const PUSHED_STRAIN: f32 = 2.0;
/// Largest change of a node's velocity within a frame (domain lengths per second): beyond it, its lattice has diverged.
const FASTEST: f32 = 64.0;

/// The law of an elastic material of density 1, and the frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Elasticity {
    /// Shear modulus mu, and first Lame parameter lambda (density x velocity^2).
    pub lame: [f32; 2],
    /// Viscosity, relative to density x speed of pressure waves x width of an element.
    pub viscosity: f32,
    /// Distance from walls within which they push (domain lengths).
    pub wall_distance: f32,
    /// Acceleration by them per depth (1 / s^2).
    pub wall_stiffness: f32,
    /// Share of the walls' push while a part moves away from them, but for the slowest.
    pub rebound: f32,
    /// Distance of other matter below which a body has no impulse (domain lengths).
    pub clear_distance: f32,
    /// Stretch above which a free body has no impulse: it is torn, or consists of bodies that touched in the first frame. While walls
    /// push it, it may have twice the strain.
    pub most_stretch: f32,
    /// Squared error of a lattice's nodes in the last frame, relative to the square of what it moved them beside free fall, above which it moves
    /// nothing; infinite: it moves its body in any case.
    pub most_error: f32,
    /// Error of the nodes whose square is added to that (root of the mean square, domain lengths).
    pub small_error: f32,
    /// Steps per frame.
    pub steps: usize,
    /// Time between two frames (s).
    pub dt: f32,
    /// Gravity (domain lengths per second squared).
    pub gravity: [f32; 2],
}

impl Elasticity {
    /// The planes from which on walls push.
    fn pushing(&self, Walls { lower, upper }: &Walls) -> Walls {
        Walls {
            lower: lower.map(|wall| wall + self.wall_distance),
            upper: upper.map(|wall| wall - self.wall_distance),
        }
    }

    /// Steps per frame that a body needs whose narrowest element has this width (domain lengths) and whose nodes have these parts of its
    /// surface.
    fn least_steps(&self, narrowest: f32, inverse_mass: &[f32], surface: &[SurfacePart]) -> f32 {
        let [mu, lambda] = self.lame;
        let crossings = (lambda + 2.0 * mu).sqrt() * self.dt / narrowest;
        let mut pushed = vec![0.0; inverse_mass.len()];
        for SurfacePart { nodes, weights, particles } in surface {
            for (node, weight) in nodes.iter().zip(weights) {
                pushed[*node as usize] += weight.abs() * particles;
            }
        }
        // Of a node's velocity, if all parts of the surface around it are pushed.
        let share = pushed.iter().zip(inverse_mass).map(|(mass, inverse)| mass * inverse);
        let spring = 0.5 * self.wall_stiffness * share.fold(0.0, f32::max);
        (self.dt * (spring / STABLE).sqrt()).max(STEPS_PER_CROSSING * crossings)
    }
}

/// Where a ballistic step stops at walls (domain lengths).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Walls {
    /// Left and lower.
    pub lower: [f32; 2],
    /// Right and upper.
    pub upper: [f32; 2],
}

/// What elasticity and walls change within a frame, beside free fall.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Impulse {
    /// To add to a particle's velocity before the frame (domain lengths per second).
    pub velocity_change: [f32; 2],
    /// To add to its position after the ballistic step with that velocity (domain lengths).
    pub displacement: [f32; 2],
}

/// An index of a particle or a node, and its weight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Share {
    /// Row of the particle, or number of the node.
    pub index: u32,
    /// Its weight.
    pub weight: f32,
}

/// A quadrature point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Point {
    /// The element's nodes.
    pub nodes: [u32; 4],
    /// Gradient of each node's shape function (1 / domain lengths).
    pub gradients: [[f32; 2]; 4],
    /// Number of its particles.
    pub particles: f32,
    /// Width of the element, the mean of both axes, for viscosity (domain lengths).
    pub width: f32,
}

/// A part of a body at its surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfacePart {
    /// The nodes of its element.
    pub nodes: [u32; 4],
    /// Value of each node's shape function.
    pub weights: [f32; 4],
    /// Number of its particles.
    pub particles: f32,
}

/// The lattices of a stream's bodies of jelly.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Lattices {
    bodies: Vec<Lattice>,
    /// Number of the first node of each body among those of all, and their number.
    first_nodes: Vec<usize>,
    /// Number of each row's body, or [`Lattices::NO_BODY`], `[N]`; empty if there is no body.
    body_of: Vec<u32>,
}

/// The lattice of a body.
#[derive(Clone, Debug, PartialEq)]
pub struct Lattice {
    elasticity: Elasticity,
    /// Row of each of its particles, `[P]`.
    rows: Vec<u32>,
    /// The nodes of its element, and their shape functions there, `[P, 4]`.
    corners: Vec<[Share; 4]>,
    normal_equations: Band,
    /// 1 / mass of each node, `[n]` (1 / mass of a particle).
    inverse_mass: Vec<f32>,
    points: Vec<Point>,
    surface: Vec<SurfacePart>,
}

/// Scratch buffers of a body's frame.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    nodes: Vec<Node>,
    /// The nodes before the frame.
    start: Vec<Node>,
    residuals: Vec<Node>,
    impulses: Vec<Impulse>,
    /// Of each part of the surface.
    parts: Vec<Node>,
}

impl Lattices {
    /// Number of the body of a row in no body.
    pub const NO_BODY: u32 = u32::MAX;

    /// The lattices of particles at `position` (domain lengths) whose rest shape has the rows `rows` of `rest`; elements are as wide as
    /// `cell_width` spacings (domain lengths), or as a body that is narrower. Each body has as many steps as it needs; one that needs more
    /// than [`MOST_STEPS`] has no lattice.
    ///
    /// # Panics
    /// If the numbers of rows, materials and positions differ.
    pub fn new(
        (rest, rows): (&RestShape, Range<usize>),
        position: &[[f32; 2]],
        material: &[Material],
        spacing: f32,
        (cell_width, elasticity): (f32, Elasticity),
    ) -> Self {
        assert_eq!((position.len(), material.len()), (rows.len(), rows.len()));
        let lattice = |body: Vec<u32>| {
            let place = |&row: &u32| position[row as usize].map(f64::from);
            let places: Vec<_> = body.iter().map(place).collect();
            let spacing = f64::from(spacing);
            Lattice::new(body, &places, spacing, (f64::from(cell_width) * spacing, elasticity))
        };
        let bodies = cover::bodies((rest, rows), material, spacing);
        let bodies = bodies.into_iter().filter(|body| body.len() >= MIN_PARTICLES);
        let bodies: Vec<_> = bodies.filter_map(lattice).collect();
        let mut body_of = Vec::new();
        if !bodies.is_empty() {
            body_of.resize(position.len(), Self::NO_BODY);
        }
        for (number, Lattice { rows, .. }) in bodies.iter().enumerate() {
            rows.iter().for_each(|&row| body_of[row as usize] = number as u32);
        }
        let counts = bodies.iter().map(|body| body.inverse_mass.len());
        let ends = counts.scan(0, |end, count| {
            *end += count;
            Some(*end)
        });
        let first_nodes = std::iter::once(0).chain(ends).collect();
        Self { bodies, first_nodes, body_of }
    }

    /// The lattices for rows in another order: `order[i]` is the row that becomes row i.
    pub fn permuted(mut self, order: &[u32]) -> Self {
        if self.is_empty() {
            return self;
        }
        let mut place = vec![0; order.len()];
        for (row, &from) in order.iter().enumerate() {
            place[from as usize] = row as u32;
        }
        let rows = self.bodies.iter_mut().flat_map(|body| &mut body.rows);
        rows.for_each(|row| *row = place[*row as usize]);
        self.body_of = order.iter().map(|&row| self.body_of[row as usize]).collect();
        self
    }

    /// The lattice of each body.
    pub fn bodies(&self) -> &[Lattice] {
        &self.bodies
    }

    /// Number of each row's body, or [`Lattices::NO_BODY`], `[N]`; empty if there is no body.
    pub fn body_of(&self) -> &[u32] {
        &self.body_of
    }

    /// The nodes of a body among those of all: parts that do not overlap.
    pub fn nodes(&self, body: usize) -> Range<usize> {
        self.first_nodes[body]..self.first_nodes[body + 1]
    }

    /// What they expect of a stream's first frame: nothing.
    pub fn expected(&self) -> Expected {
        let nodes = self.first_nodes.last().copied().unwrap_or_default();
        Expected::nothing(nodes, self.bodies.len())
    }

    /// Whether there is no body.
    pub fn is_empty(&self) -> bool {
        self.bodies.is_empty()
    }

    /// The impulses of a body's particles, as pairs of row and impulse; none if another particle is close to the body, if it is torn, or if its
    /// nodes are not where they were expected. `motion` has positions and velocities by rows (domain lengths, domain lengths per second);
    /// `expected` the body's part of [`Expected`], of this frame, then of the coming one.
    pub fn impulses<'s>(
        &'s self,
        body: usize,
        walls: &Walls,
        motion: (&[[f32; 2]], &[[f32; 2]]),
        (expected, most_error): (&mut [[f32; 2]], &mut f32),
        scratch: &'s mut Scratch,
    ) -> impl Iterator<Item = (usize, Impulse)> + use<'s> {
        let lattice = &self.bodies[body];
        lattice.fit(motion, scratch);
        let error = lattice.squared_distance(&scratch.nodes, |node| expected[node]);
        let is_expected = error <= std::mem::replace(most_error, f32::INFINITY);
        let Scratch { nodes, parts, .. } = scratch;
        lattice.locate(nodes, parts);
        let bounds = bounds(parts);
        let reach = lattice.elasticity.clear_distance;
        let is_close = |(&of, &place): (&u32, &[f32; 2])| {
            of as usize != body
                && is_within(reach, &bounds, place)
                && parts.iter().any(|part| squared_distance(part.position, place) < reach * reach)
        };
        let walls = lattice.elasticity.pushing(walls);
        let [low, high] = bounds;
        let is_pushed =
            (0..2).any(|axis| low[axis] < walls.lower[axis] || high[axis] > walls.upper[axis]);
        let share = if is_pushed { PUSHED_STRAIN } else { 1.0 };
        let most_stretch = 1.0 + share * (lattice.elasticity.most_stretch - 1.0);
        let is_whole = |point| stress::stretch(point, nodes) <= most_stretch;
        let is_clear =
            lattice.points.iter().all(is_whole) && !self.body_of.iter().zip(motion.0).any(is_close);
        let moves = is_clear && lattice.integrate(&walls, scratch);
        if moves {
            *most_error = lattice.expect(scratch, expected);
        }
        (moves && is_expected).then(|| lattice.interpolate(scratch)).into_iter().flatten()
    }
}

impl Lattice {
    /// The lattice of a body of these rows with these positions; none if the body is too sparse, or needs too many steps.
    fn new(
        rows: Vec<u32>,
        places: &[[f64; 2]],
        spacing: f64,
        (width, mut elasticity): (f64, Elasticity),
    ) -> Option<Self> {
        let cover = Cover::new(places, spacing, width)?;
        let full = cover.width[0] * cover.width[1] / (spacing * spacing);
        let nodes = cover.used_nodes();
        let mut mass = vec![0.0; nodes.len()];
        let number = |node: usize| nodes.binary_search(&node).expect("of an element");
        let mut corners = Vec::with_capacity(rows.len());
        for &place in places {
            corners.push(cover.corners(place, cover.element(place)).map(|(node, weight, _)| {
                mass[number(node)] += weight;
                Share { index: number(node) as u32, weight: weight as f32 }
            }));
        }
        let inverse = |mass: f64| (1.0 / mass.max(LIGHTEST * full)) as f32;
        let inverse_mass: Vec<_> = mass.into_iter().map(inverse).collect();
        let surface_part = |part: &cover::Part| {
            let corners = cover.corners_of(part);
            SurfacePart {
                nodes: corners.map(|corner| number(corner.0) as u32),
                weights: corners.map(|corner| corner.1 as f32),
                particles: part.particles as f32,
            }
        };
        let part_width = f64::from(PART_WIDTH) * spacing;
        let surface: Vec<_> = cover.surface(places, part_width).iter().map(surface_part).collect();
        let narrowest = cover.width[0].min(cover.width[1]) as f32;
        let steps = elasticity.least_steps(narrowest, &inverse_mass, &surface);
        if steps > MOST_STEPS as f32 {
            return None;
        }
        elasticity.steps = elasticity.steps.max(steps.ceil() as usize);
        let point = |part: cover::Part| {
            let corners = cover.corners_of(&part);
            Point {
                nodes: corners.map(|corner| number(corner.0) as u32),
                gradients: corners.map(|corner| corner.2.map(|slope| slope as f32)),
                particles: part.particles as f32,
                width: (0.5 * (cover.width[0] + cover.width[1])) as f32,
            }
        };
        Some(Self {
            elasticity,
            rows,
            normal_equations: Band::new(nodes.len(), &corners),
            corners,
            inverse_mass,
            points: cover.quarters(places).into_iter().map(point).collect(),
            surface,
        })
    }

    /// Row of each of its particles, `[P]`.
    pub fn rows(&self) -> &[u32] {
        &self.rows
    }

    /// The nodes of each particle's element, and their shape functions there, `[P, 4]`.
    pub fn corners(&self) -> &[[Share; 4]] {
        &self.corners
    }

    /// The normal equations of the fit of the nodes.
    pub fn normal_equations(&self) -> &Band {
        &self.normal_equations
    }

    /// 1 / mass of each node, `[n]` (1 / mass of a particle).
    pub fn inverse_mass(&self) -> &[f32] {
        &self.inverse_mass
    }

    /// The quadrature points.
    pub fn points(&self) -> &[Point] {
        &self.points
    }

    /// The law, with as many steps as the body needs.
    pub fn elasticity(&self) -> &Elasticity {
        &self.elasticity
    }

    /// The parts of the surface.
    pub fn surface(&self) -> &[SurfacePart] {
        &self.surface
    }

    /// The positions and velocities of the nodes, fitted to those of the particles.
    fn fit(&self, motion: (&[[f32; 2]], &[[f32; 2]]), scratch: &mut Scratch) {
        let Scratch { nodes, residuals, .. } = scratch;
        // Means first, and then what the particles differ by: they are close, and rounding hardly matters.
        self.sums(nodes, |row, _| Node::of(motion, row));
        for (node, inverse_mass) in nodes.iter_mut().zip(&self.inverse_mass) {
            node.scale(*inverse_mass);
        }
        self.sums(residuals, |row, corners| {
            let mut residual = Node::of(motion, row);
            for Share { index, weight } in corners {
                residual.add(-weight, &nodes[*index as usize]);
            }
            residual
        });
        self.normal_equations.solve(residuals);
        for (node, residual) in nodes.iter_mut().zip(residuals) {
            node.add(1.0, residual);
        }
    }

    /// The positions and velocities of the parts of the surface.
    fn locate(&self, nodes: &[Node], parts: &mut Vec<Node>) {
        parts.clear();
        parts.extend(self.surface.iter().map(|part| part.state(nodes)));
    }

    /// Sums over the particles, weighted with their shape functions, at the nodes.
    fn sums(&self, nodes: &mut Vec<Node>, of: impl Fn(usize, &[Share; 4]) -> Node) {
        nodes.clear();
        nodes.resize(self.inverse_mass.len(), Node::default());
        for (&row, corners) in self.rows.iter().zip(&self.corners) {
            let own = of(row as usize, corners);
            for Share { index, weight } in corners {
                nodes[*index as usize].add(*weight, &own);
            }
        }
    }

    /// Sum over the nodes of mass x squared distance from places (a particle's mass x square of domain lengths).
    fn squared_distance(&self, nodes: &[Node], places: impl Fn(usize) -> [f32; 2]) -> f32 {
        let own = |(number, node): (usize, &Node)| squared_distance(node.position, places(number));
        let masses = self.inverse_mass.iter().map(|inverse| 1.0 / inverse);
        nodes.iter().enumerate().map(own).zip(masses).map(|(square, mass)| mass * square).sum()
    }

    /// Writes the positions of the nodes after the frame; returns how far from there they may come ([`Expected::most_errors`]).
    fn expect(&self, Scratch { nodes, start, .. }: &Scratch, positions: &mut [[f32; 2]]) -> f32 {
        let Elasticity { most_error, small_error, .. } = self.elasticity;
        if most_error == f32::INFINITY {
            return most_error;
        }
        let moved = self.squared_distance(nodes, |node| start[node].fallen(&self.elasticity));
        positions.iter_mut().zip(nodes).for_each(|(to, node)| *to = node.position);
        most_error * moved + self.rows.len() as f32 * small_error * small_error
    }

    /// Advances fitted nodes by a frame, with the planes from which on walls push, and computes their impulses; whether the steps stayed stable.
    fn integrate(&self, walls: &Walls, scratch: &mut Scratch) -> bool {
        let elasticity = &self.elasticity;
        let Elasticity { steps, dt, gravity, .. } = *elasticity;
        let Scratch { nodes, start, impulses, .. } = scratch;
        start.clone_from(nodes);
        let step = dt / steps as f32;
        let fall = gravity.map(|gravity| gravity * step);
        for _ in 0..steps {
            for point in &self.points {
                stress::add_forces(elasticity, point, nodes);
            }
            for part in &self.surface {
                surface::add_forces(elasticity, walls, fall, part, nodes);
            }
            for (node, inverse_mass) in nodes.iter_mut().zip(&self.inverse_mass) {
                node.advance(step, *inverse_mass, fall);
            }
        }
        impulses.clear();
        let pairs = start.iter().zip(&*nodes);
        impulses.extend(pairs.map(|(from, to)| Impulse::between(from, to, elasticity)));
        impulses.iter().all(Impulse::has_converged)
    }

    /// The impulses of its particles, as pairs of row and impulse, from those of its nodes.
    fn interpolate<'s>(
        &'s self,
        Scratch { impulses, .. }: &'s Scratch,
    ) -> impl Iterator<Item = (usize, Impulse)> + use<'s> {
        self.rows.iter().zip(&self.corners).map(move |(&row, corners)| {
            let mut sum = Impulse::default();
            for Share { index, weight } in corners {
                let Impulse { velocity_change, displacement } = impulses[*index as usize];
                add_scaled(&mut sum.velocity_change, *weight, velocity_change);
                add_scaled(&mut sum.displacement, *weight, displacement);
            }
            (row as usize, sum)
        })
    }
}

impl SurfacePart {
    /// Its position and velocity.
    #[inline(always)]
    fn state(&self, nodes: &[Node]) -> Node {
        let mut own = Node::default();
        for (&node, &weight) in self.nodes.iter().zip(&self.weights) {
            own.add(weight, &nodes[node as usize]);
        }
        own
    }
}

impl Impulse {
    /// Of a node, from its states before and after the frame.
    fn between(from: &Node, to: &Node, Elasticity { dt, gravity, .. }: &Elasticity) -> Self {
        let along = |axis: usize| {
            let fallen = gravity[axis] * dt;
            let change = to.velocity[axis] - from.velocity[axis] - fallen;
            let moved = to.position[axis] - from.position[axis];
            [change, moved - (from.velocity[axis] + change + 0.5 * fallen) * dt]
        };
        let [[change_x, displacement_x], [change_y, displacement_y]] = [along(0), along(1)];
        let velocity_change = [change_x, change_y];
        Self { velocity_change, displacement: [displacement_x, displacement_y] }
    }

    /// Whether it is one that a lattice can give; NaN is not.
    fn has_converged(&self) -> bool {
        self.velocity_change.iter().all(|change| change.abs() <= FASTEST)
    }
}

#[cfg(test)]
mod tests;
