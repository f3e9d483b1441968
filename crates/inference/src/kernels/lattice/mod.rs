//! Jelly as an elastic continuum on coarse lattices, one for each body: the impulse that its own stress, walls, and other bodies give it
//! within a frame.
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
//! 2. Nodes (`fit`): their positions and velocities are the least-squares fit to those of the particles. What the lattice cannot resolve is
//!    orthogonal to it, moves freely, and does not disturb the steps of the nodes from frame to frame.
//! 3. Points (`stress`): a quarter of an element each, where the mean of its particles is, with their mass and area. From the deformation
//!    gradient and its rate there follow the stress (first Piola-Kirchhoff; a viscosity damps the waves that are as short as elements, as the
//!    grid of the material-point method does), and its forces on the nodes.
//! 4. Surfaces (`surface`), in parts that are as wide as a cell of that grid, whatever the width of elements is. Beyond the plane of contact
//!    with a wall, a part is pushed back by a spring, less while it moves away, without friction. In the ground truth, bodies that are closer
//!    than the splines of the grid are wide move with common velocities: here, a viscosity between the parts of different bodies exchanges
//!    momentum, and a weak spring keeps them apart.
//! 5. What the steps change at the nodes is interpolated at the particles ([`Impulse`]). A lattice that diverges gives none.

mod cover;
mod fit;
mod stress;
mod surface;

use std::ops::Range;

use eddy_frames::Material;

use super::rest_shape::RestShape;
use cover::Cover;
pub use fit::Band;
use surface::Surfaces;

/// Particles of a body at least: smaller ones have no lattice.
const MIN_PARTICLES: usize = 16;
/// Width of the parts of a surface: about that of a cell of the ground truth's grid, which is two spacings wide (spacings).
pub const PART_WIDTH: f32 = 1.75;
/// Steps at least in the time that a pressure wave takes to cross the narrowest element. Fewer are unstable; more are accurate.
const STEPS_PER_CROSSING: f32 = 1.5;
/// Share of a velocity that walls and contact take away in a step, at most: 2 is unstable, and elasticity adds to it.
const STABLE: f32 = 1.5;
/// Share of the contact distance by which bodies that push each other mostly overlap.
const OVERLAP: f32 = 0.35;
/// Steps per frame at most.
pub const MOST_STEPS: usize = 256;
/// Mass of a node at least, as a share of that of a full element.
const LIGHTEST: f64 = 0.1;
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
    /// Between bodies.
    pub contact: Contact,
    /// Steps per frame.
    pub steps: usize,
    /// Time between two frames (s).
    pub dt: f32,
    /// Gravity (domain lengths per second squared).
    pub gravity: [f32; 2],
}

impl Elasticity {
    /// Steps per frame that a body needs whose narrowest element has this width (domain lengths) and whose nodes, from `first` on, have
    /// these parts of its surface.
    fn least_steps(
        &self,
        narrowest: f32,
        first: u32,
        inverse_mass: &[f32],
        surface: &[SurfacePart],
    ) -> f32 {
        let [mu, lambda] = self.lame;
        let crossings = (lambda + 2.0 * mu).sqrt() * self.dt / narrowest;
        let mut pushed = vec![0.0; inverse_mass.len()];
        for SurfacePart { nodes, weights, particles } in surface {
            for (node, weight) in nodes.iter().zip(weights) {
                pushed[(node - first) as usize] += weight.abs() * particles;
            }
        }
        // Of a node's velocity, if all parts of the surface around it are pushed.
        let share = pushed.iter().zip(inverse_mass).map(|(mass, inverse)| mass * inverse);
        let share = share.fold(0.0, f32::max);
        let spring = 0.5 * self.wall_stiffness * share;
        let exchange = OVERLAP * self.contact.viscosity * share;
        // The step h with h^2 spring + h exchange = STABLE.
        let root = (exchange * exchange + 4.0 * spring * STABLE).sqrt();
        let of_surface = self.dt * (exchange + root) / (2.0 * STABLE);
        of_surface.max(STEPS_PER_CROSSING * crossings)
    }
}

/// What parts of the surfaces of different bodies do to each other.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Contact {
    /// Below this distance (domain lengths), from where on both of the following grow linearly.
    pub distance: f32,
    /// Acceleration that keeps them apart, per depth (1 / s^2).
    pub stiffness: f32,
    /// Rate at which they exchange momentum where they touch (1 / s).
    pub viscosity: f32,
}

/// Where a ballistic step stops at walls (domain lengths).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Walls {
    /// Left and lower.
    pub lower: [f32; 2],
    /// Right and upper.
    pub upper: [f32; 2],
}

/// What elasticity, walls and contact change within a frame, beside free fall.
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
pub struct Lattice {
    elasticity: Elasticity,
    /// Row of each particle of a body, `[P]`.
    rows: Vec<u32>,
    /// The nodes of its element, and their shape functions there, `[P, 4]`.
    corners: Vec<[Share; 4]>,
    /// Of each body.
    normal_equations: Vec<Band>,
    /// 1 / mass of each node, `[n]` (1 / mass of a particle).
    inverse_mass: Vec<f32>,
    points: Vec<Point>,
    surfaces: Surfaces,
}

/// Scratch buffers of a frame.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    nodes: Vec<Node>,
    /// The nodes before the frame.
    start: Vec<Node>,
    residuals: Vec<Node>,
    impulses: Vec<Impulse>,
    /// Of each part of a surface.
    parts: Vec<Node>,
}

/// A node within a frame.
#[derive(Clone, Copy, Debug, Default)]
struct Node {
    /// Domain lengths.
    position: [f32; 2],
    /// Domain lengths per second.
    velocity: [f32; 2],
    /// In units of a particle's mass (domain lengths per second squared).
    force: [f32; 2],
}

impl Lattice {
    /// The lattices of particles at `position` (domain lengths) whose rest shape has the rows `rows` of `rest`; elements are as wide as
    /// `cell_width` spacings (domain lengths), or as a body that is narrower. Steps are as short as all bodies need them; one that needs more
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
        let mut lattice = Self { elasticity, ..Self::default() };
        for body in cover::bodies((rest, rows), material, spacing) {
            if body.len() >= MIN_PARTICLES {
                let place = |&row: &u32| position[row as usize].map(f64::from);
                let places: Vec<_> = body.iter().map(place).collect();
                let spacing = f64::from(spacing);
                lattice.add(&body, &places, spacing, f64::from(cell_width) * spacing);
            }
        }
        lattice
    }

    /// The lattices for rows in another order: `order[i]` is the row that becomes row i.
    pub fn permuted(mut self, order: &[u32]) -> Self {
        let mut place = vec![0; order.len()];
        for (row, &from) in order.iter().enumerate() {
            place[from as usize] = row as u32;
        }
        self.rows.iter_mut().for_each(|row| *row = place[*row as usize]);
        self
    }

    /// Row of each particle of a body, `[P]`.
    pub fn rows(&self) -> &[u32] {
        &self.rows
    }

    /// The nodes of each such particle's element, and their shape functions there, `[P, 4]`.
    pub fn corners(&self) -> &[[Share; 4]] {
        &self.corners
    }

    /// The normal equations of the fit of each body's nodes.
    pub fn normal_equations(&self) -> &[Band] {
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

    /// The law, with as many steps as the body needs that needs most.
    pub fn elasticity(&self) -> &Elasticity {
        &self.elasticity
    }

    /// The parts of surfaces, by bodies.
    pub fn surface(&self) -> &[SurfacePart] {
        &self.surfaces.parts
    }

    /// The parts of each body.
    pub fn surfaces(&self) -> &[Range<u32>] {
        &self.surfaces.bodies
    }

    /// Whether there is no body.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Adds a body of these rows with these positions.
    fn add(&mut self, body: &[u32], places: &[[f64; 2]], spacing: f64, width: f64) {
        let Some(cover) = Cover::new(places, spacing, width) else { return };
        let full = cover.width[0] * cover.width[1] / (spacing * spacing);
        let nodes = cover.used_nodes();
        let begin = self.inverse_mass.len() as u32;
        let mut mass = vec![0.0; nodes.len()];
        let number = |node: usize| nodes.binary_search(&node).expect("of an element");
        let mut shares = Vec::with_capacity(body.len());
        for &place in places {
            shares.push(cover.corners(place, cover.element(place)).map(|(node, weight, _)| {
                mass[number(node)] += weight;
                Share { index: begin + number(node) as u32, weight: weight as f32 }
            }));
        }
        let inverse = |mass: f64| (1.0 / mass.max(LIGHTEST * full)) as f32;
        let inverse_mass: Vec<_> = mass.into_iter().map(inverse).collect();
        let surface_part = |part: &cover::Part| {
            let corners = cover.corners_of(part);
            SurfacePart {
                nodes: corners.map(|corner| begin + number(corner.0) as u32),
                weights: corners.map(|corner| corner.1 as f32),
                particles: part.particles as f32,
            }
        };
        let width = f64::from(PART_WIDTH) * spacing;
        let surface: Vec<_> = cover.surface(places, width).iter().map(surface_part).collect();
        let narrowest = cover.width[0].min(cover.width[1]) as f32;
        let steps = self.elasticity.least_steps(narrowest, begin, &inverse_mass, &surface);
        if steps > MOST_STEPS as f32 {
            return;
        }
        self.elasticity.steps = self.elasticity.steps.max(steps.ceil() as usize);

        self.normal_equations.push(Band::new(begin, nodes.len(), &shares));
        self.rows.extend(body);
        self.corners.extend(shares);
        self.inverse_mass.extend(inverse_mass);
        for part in cover.quarters(places) {
            let corners = cover.corners_of(&part);
            self.points.push(Point {
                nodes: corners.map(|corner| begin + number(corner.0) as u32),
                gradients: corners.map(|corner| corner.2.map(|slope| slope as f32)),
                particles: part.particles as f32,
                width: (0.5 * (cover.width[0] + cover.width[1])) as f32,
            });
        }
        let first = self.surfaces.parts.len() as u32;
        self.surfaces.parts.extend(surface);
        self.surfaces.bodies.push(first..self.surfaces.parts.len() as u32);
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
        for band in &self.normal_equations {
            band.solve(&mut residuals[band.nodes()]);
        }
        for (node, residual) in nodes.iter_mut().zip(residuals) {
            node.add(1.0, residual);
        }
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

    /// The impulses of a frame's particles, as pairs of row and impulse; no others get one. Positions and velocities are by rows
    /// (domain lengths, domain lengths per second).
    pub fn impulses<'s>(
        &'s self,
        &Walls { lower, upper }: &Walls,
        motion: (&[[f32; 2]], &[[f32; 2]]),
        scratch: &'s mut Scratch,
    ) -> impl Iterator<Item = (usize, Impulse)> + use<'s> {
        let elasticity = &self.elasticity;
        let walls = Walls {
            lower: lower.map(|wall| wall + elasticity.wall_distance),
            upper: upper.map(|wall| wall - elasticity.wall_distance),
        };
        let Elasticity { steps, dt, gravity, .. } = *elasticity;
        self.fit(motion, scratch);
        let Scratch { nodes, start, impulses, parts, .. } = scratch;
        start.clone_from(nodes);
        let step = dt / steps as f32;
        let fall = gravity.map(|gravity| gravity * step);
        for _ in 0..steps {
            for point in &self.points {
                stress::add_forces(elasticity, point, nodes);
            }
            self.surfaces.add_forces(elasticity, &walls, fall, parts, nodes);
            for (node, inverse_mass) in nodes.iter_mut().zip(&self.inverse_mass) {
                node.advance(step, *inverse_mass, fall);
            }
        }
        impulses.clear();
        let pairs = start.iter().zip(&*nodes);
        impulses.extend(pairs.map(|(from, to)| Impulse::between(from, to, elasticity)));
        for band in &self.normal_equations {
            let body = &mut impulses[band.nodes()];
            if !body.iter().all(Impulse::has_converged) {
                body.fill(Impulse::default());
            }
        }
        let impulses = &*impulses;
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

/// Adds a multiple of a vector.
#[inline(always)]
fn add_scaled(sum: &mut [f32; 2], factor: f32, other: [f32; 2]) {
    for (sum, other) in sum.iter_mut().zip(other) {
        *sum += factor * other;
    }
}

impl Node {
    /// Position and velocity of a particle.
    #[inline(always)]
    fn of((position, velocity): (&[[f32; 2]], &[[f32; 2]]), row: usize) -> Self {
        Self { position: position[row], velocity: velocity[row], force: [0.0; 2] }
    }

    /// Adds a multiple of another node's position and velocity.
    #[inline(always)]
    fn add(&mut self, factor: f32, other: &Self) {
        add_scaled(&mut self.position, factor, other.position);
        add_scaled(&mut self.velocity, factor, other.velocity);
    }

    #[inline(always)]
    fn scale(&mut self, factor: f32) {
        self.position = self.position.map(|x| factor * x);
        self.velocity = self.velocity.map(|v| factor * v);
    }

    /// A step of symplectic Euler, after which no force acts.
    #[inline(always)]
    fn advance(&mut self, step: f32, inverse_mass: f32, fall: [f32; 2]) {
        add_scaled(&mut self.velocity, step * inverse_mass, self.force);
        add_scaled(&mut self.velocity, 1.0, fall);
        add_scaled(&mut self.position, step, self.velocity);
        self.force = [0.0; 2];
    }
}

#[cfg(test)]
mod tests;
