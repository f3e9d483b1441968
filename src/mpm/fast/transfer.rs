//! The one pass over the particles of a chunk: velocity comes from the grid, particles move, deform
//! and are stressed, and their momentum goes to the patch of the grid that is the chunk's own.
//!
//! Same equations as [`g2p`](super::super::g2p) and [`p2g`](super::super::p2g). All particles have
//! the same mass, so that weights are spread instead of masses, and momentum per mass.

use super::{
    super::{
        grid::GridShape,
        material::{DENSITY, Law, Moduli},
        solver::SolverSettings,
        water::{LOOSEST, MEMORY},
    },
    chunk::Chunk,
    field::Nodes,
    law,
    level::Work,
    pack::Pack,
    simd::{LANES, Lanes, Simd, Vectors},
};
use crate::frame::Material;

/// What is the same for all particles in a substep.
#[derive(Clone, Copy, Debug)]
pub(super) struct Step {
    /// Length of the substep (s).
    pub(super) dt: f32,
    /// Cell width (domain lengths).
    pub(super) dx: f32,
    /// Cells per domain length.
    pub(super) inverse_dx: f32,
    /// `-dt 4 / (dx^2 rho)`: from Kirchhoff stress to the affine part of the velocity.
    pub(super) impulse: f32,
    /// Particles to a cell in an undeformed body.
    pub(super) crowd: f32,
    /// What the particles are made of.
    pub(super) moduli: Moduli,
}

impl Step {
    /// What these settings come to.
    pub(super) fn of(settings: &SolverSettings) -> Self {
        let SolverSettings { grid: GridShape { dx, .. }, dt, .. } = *settings;
        let inverse_dx = 1.0 / dx;
        Self {
            dt,
            dx,
            inverse_dx,
            impulse: -dt * 4.0 * inverse_dx * inverse_dx / DENSITY,
            crowd: dx * dx / settings.volume(),
            moduli: Moduli::of(&settings.materials),
        }
    }

    /// The lowest node of the stencil at a position (domain lengths).
    pub(super) fn lowest(&self, position: [f32; 2]) -> [i32; 2] {
        position.map(|x| (x * self.inverse_dx - 0.5) as i32)
    }
}

/// Where sixteen particles are among the nodes.
struct Stencils<S: Simd> {
    /// Lowest node of each on x and y.
    base: [[i32; LANES]; 2],
    /// Distance from the lowest node on x and y (cells), in [0.5, 1.5).
    offset: [S::Lanes; 2],
    /// Weights of the three rows along x.
    weight: [S::Lanes; 3],
}

impl<S: Simd> Stencils<S> {
    /// The stencils at these places (cells), which [`Chunk::holds`].
    #[inline(always)]
    fn of(simd: S, cell: [S::Lanes; 2]) -> Self {
        let (half, one) = (simd.splat(0.5), simd.splat(1.0));
        // Cutting is the floor of what is not negative.
        let (x, base_x) = simd.truncate(cell[0] - half);
        let (y, base_y) = simd.truncate(cell[1] - half);
        let offset = [cell[0] - x, cell[1] - y];
        let x = offset[0];
        let (before, after) = (simd.splat(1.5) - x, x - half);
        let weight = [
            half * before * before,
            simd.splat(0.75) - (x - one) * (x - one),
            half * after * after,
        ];
        Self { base: [base_x, base_y], offset, weight }
    }
}

/// Weights of the four nodes of a row at a distance `y` from the first, as `c0 + y (c1 + y c2)`.
const WEIGHTS: [[f32; 4]; 3] =
    [[1.125, -0.25, 0.125, 0.0], [-1.5, 2.0, -0.5, 0.0], [0.5, -1.0, 0.5, 0.0]];

/// Numbers of the four nodes, for each of the two components.
const fn twice(row: [f32; 4]) -> [[f32; 2]; 4] {
    [[row[0]; 2], [row[1]; 2], [row[2]; 2], [row[3]; 2]]
}

const PAIR_WEIGHTS: [[[f32; 2]; 4]; 3] = [twice(WEIGHTS[0]), twice(WEIGHTS[1]), twice(WEIGHTS[2])];
/// Number of the node in its row.
const PAIR_PLACES: [[f32; 2]; 4] = twice([0.0, 1.0, 2.0, 3.0]);

/// Weights of a row, in vectors.
struct Weights<S: Simd> {
    pairs: [S::Pairs; 3],
    ones: [S::Ones; 3],
    places: S::Pairs,
}

impl<S: Simd> Weights<S> {
    #[inline(always)]
    fn new(simd: S) -> Self {
        let [a, b, c] = &PAIR_WEIGHTS;
        let [d, e, f] = &WEIGHTS;
        Self {
            pairs: [simd.load_pairs(a), simd.load_pairs(b), simd.load_pairs(c)],
            ones: [simd.load_ones(d), simd.load_ones(e), simd.load_ones(f)],
            places: simd.load_pairs(&PAIR_PLACES),
        }
    }

    /// The weights at a distance `y` from the first node, for both components.
    #[inline(always)]
    fn pairs(&self, y: S::Pairs) -> S::Pairs {
        self.pairs[0] + y * (self.pairs[1] + y * self.pairs[2])
    }

    /// The weights at a distance `y` from the first node.
    #[inline(always)]
    fn ones(&self, y: S::Ones) -> S::Ones {
        self.ones[0] + y * (self.ones[1] + y * self.ones[2])
    }
}

/// One pack between vectors and single particles. Kept from pack to pack, so that nothing is cleared.
#[repr(align(64))]
struct Scratch {
    /// Node of each particle that its stencil begins with.
    node: [i32; LANES],
    /// Distance from it along y (cells).
    offset: Lanes,
    /// Weights of the three rows.
    weight: [Lanes; 3],
    /// Weights times the distance along x (cells).
    moment: [Lanes; 3],
    /// Mass around each particle, in masses of a particle.
    mass: Lanes,
    /// Three vectors of each particle.
    vectors: [Vectors; 3],
}

impl Scratch {
    const EMPTY: Self = Self {
        node: [0; LANES],
        offset: [0.0; LANES],
        weight: [[0.0; LANES]; 3],
        moment: [[0.0; LANES]; 3],
        mass: [0.0; LANES],
        vectors: [[[0.0; 2]; LANES]; 3],
    };
}

/// The pass over the particles of a chunk. Without `GATHER` they stay where they are and only give
/// their momentum; without `SCATTER` they only move.
pub(super) struct Pass<'a, const GATHER: bool, const SCATTER: bool> {
    pub(super) chunk: &'a mut Chunk,
    /// The chunk's packs.
    pub(super) packs: &'a mut [Pack],
    pub(super) field: Nodes<'a>,
    pub(super) step: &'a Step,
}

impl<const GATHER: bool, const SCATTER: bool> Work for Pass<'_, GATHER, SCATTER> {
    type Output = ();

    #[inline(always)]
    fn run<S: Simd>(self, simd: S) {
        let Self { chunk, packs, field, step } = self;
        let weights = Weights::new(simd);
        if SCATTER {
            chunk.clear();
        }
        let mut held = Held::nothing(simd);
        let mut scratch = Scratch::EMPTY;
        let mut left = chunk.particles().len();
        for pack in packs {
            let lanes = left.min(LANES);
            left -= lanes;
            if GATHER {
                gather(simd, &weights, pack, field, step, &mut scratch);
            }
            let inverse_dx = simd.splat(step.inverse_dx);
            let [x, y] = &pack.position;
            let cell = [simd.load(x) * inverse_dx, simd.load(y) * inverse_dx];
            let (inside, near) = chunk.holds(simd, cell);
            if !inside {
                chunk.lost = true;
                return;
            }
            if !near {
                chunk.drifted = true;
            }
            if SCATTER {
                let stress = law::advance(simd, pack, &step.moduli, step.dt);
                let stencils = Stencils::of(simd, cell);
                spread(simd, pack, &stress, &stencils, chunk, step, &mut scratch);
                scatter(simd, &weights, &scratch, lanes, chunk, &mut held);
            }
        }
        if SCATTER {
            held.give(simd, chunk);
        }
    }
}

/// Grid to particles: velocities and their gradients come back, positions move.
#[inline(always)]
fn gather<S: Simd>(
    simd: S,
    weights: &Weights<S>,
    pack: &mut Pack,
    field: Nodes<'_>,
    step: &Step,
    scratch: &mut Scratch,
) {
    let inverse_dx = simd.splat(step.inverse_dx);
    let position = [simd.load(&pack.position[0]), simd.load(&pack.position[1])];
    let stencils = Stencils::of(simd, [position[0] * inverse_dx, position[1] * inverse_dx]);
    for l in 0..LANES {
        scratch.node[l] = stencils.base[0][l] * field.stride as i32 + stencils.base[1][l];
    }
    for i in 0..3 {
        let distance = simd.splat(i as f32) - stencils.offset[0];
        simd.store(stencils.weight[i], &mut scratch.weight[i]);
        simd.store(stencils.weight[i] * distance, &mut scratch.moment[i]);
    }
    simd.store(stencils.offset[1], &mut scratch.offset);
    if step.moduli.law == Law::Water {
        recall(simd, weights, pack, field, step, scratch);
    }
    let Scratch { node, offset, weight, moment, vectors, .. } = scratch;
    // The lanes behind the last particle hold copies of another one, which move with it.
    for l in 0..LANES {
        let [a, b, c] = field.velocities(node[l] as usize);
        let (a, b, c) = (simd.load_pairs(a), simd.load_pairs(b), simd.load_pairs(c));
        let straight = simd.splat_pairs(weight[0][l]) * a
            + simd.splat_pairs(weight[1][l]) * b
            + simd.splat_pairs(weight[2][l]) * c;
        let slanted = simd.splat_pairs(moment[0][l]) * a
            + simd.splat_pairs(moment[1][l]) * b
            + simd.splat_pairs(moment[2][l]) * c;
        let y = simd.splat_pairs(offset[l]);
        let along = weights.pairs(y);
        let moment_along = along * (weights.places - y);
        // The velocity, and its moments along y and x (cells).
        let sums = simd.sums([straight * along, straight * moment_along, slanted * along]);
        vectors[0][l] = sums[0];
        vectors[1][l] = sums[1];
        vectors[2][l] = sums[2];
    }
    let velocity = simd.load_vectors(&vectors[0]);
    let along_y = simd.load_vectors(&vectors[1]);
    let along_x = simd.load_vectors(&vectors[2]);
    let (dt, scale) = (simd.splat(step.dt), simd.splat(4.0 * step.inverse_dx));
    for axis in 0..2 {
        simd.store(velocity[axis], &mut pack.velocity[axis]);
        simd.store(scale * along_x[axis], &mut pack.affine[2 * axis]);
        simd.store(scale * along_y[axis], &mut pack.affine[2 * axis + 1]);
        simd.store(position[axis] + dt * velocity[axis], &mut pack.position[axis]);
    }
}

/// Draws the area that water remembers to what the mass of the nodes says, as
/// [`water::recalled`](super::super::water).
#[inline(always)]
fn recall<S: Simd>(
    simd: S,
    weights: &Weights<S>,
    pack: &mut Pack,
    field: Nodes<'_>,
    step: &Step,
    scratch: &mut Scratch,
) {
    let liquid = simd.splat(f32::from(Material::Liquid as u8));
    let wet = simd.equal(simd.load(&pack.material), liquid);
    if simd.count(wet) == 0 {
        return;
    }
    let Scratch { node, offset, weight, mass, .. } = scratch;
    for l in 0..LANES {
        let [a, b, c] = field.masses(node[l] as usize);
        let (a, b, c) = (simd.load_ones(a), simd.load_ones(b), simd.load_ones(c));
        let straight = simd.splat_ones(weight[0][l]) * a
            + simd.splat_ones(weight[1][l]) * b
            + simd.splat_ones(weight[2][l]) * c;
        mass[l] = simd.sum_ones(straight * weights.ones(simd.splat_ones(offset[l])));
    }
    let loosest = simd.splat(LOOSEST);
    let side = simd.load(&pack.deformation[0]);
    let area = side * simd.load(&pack.deformation[3]);
    let room = simd.splat(step.crowd) / simd.load(mass);
    let room = simd.select(simd.less(loosest, room), loosest, room);
    let area = area + (room - area) * simd.splat((step.dt / MEMORY).min(1.0));
    let side = simd.sqrt(area);
    for k in [0, 3] {
        let kept = simd.load(&pack.deformation[k]);
        simd.store(simd.select(wet, side, kept), &mut pack.deformation[k]);
    }
}

/// What each particle gives to the nodes around it: `w (lowest + i along_x + j along_y)` at (i, j)
/// cells from the lowest one, momentum per mass (domain lengths per s).
#[inline(always)]
fn spread<S: Simd>(
    simd: S,
    pack: &Pack,
    stress: &law::Stress<S>,
    stencils: &Stencils<S>,
    chunk: &Chunk,
    step: &Step,
    scratch: &mut Scratch,
) {
    let (impulse, dx) = (simd.splat(step.impulse), simd.splat(step.dx));
    let affine = |k: usize, stress: S::Lanes| (impulse * stress + simd.load(&pack.affine[k])) * dx;
    let along_x = [affine(0, stress[0]), affine(2, stress[1])];
    let along_y = [affine(1, stress[1]), affine(3, stress[2])];
    let [fx, fy] = stencils.offset;
    let lowest =
        |axis: usize| simd.load(&pack.velocity[axis]) - along_x[axis] * fx - along_y[axis] * fy;
    simd.store_vectors([lowest(0), lowest(1)], &mut scratch.vectors[0]);
    simd.store_vectors(along_x, &mut scratch.vectors[1]);
    simd.store_vectors(along_y, &mut scratch.vectors[2]);
    for i in 0..3 {
        simd.store(stencils.weight[i], &mut scratch.weight[i]);
    }
    simd.store(fy, &mut scratch.offset);
    for l in 0..LANES {
        let [x, y] = [stencils.base[0][l] - chunk.origin[0], stencils.base[1][l] - chunk.origin[1]];
        scratch.node[l] = x * chunk.stride as i32 + y;
    }
}

/// Particles to grid.
#[inline(always)]
fn scatter<S: Simd>(
    simd: S,
    weights: &Weights<S>,
    scratch: &Scratch,
    lanes: usize,
    chunk: &mut Chunk,
    held: &mut Held<S>,
) {
    let Scratch { node, offset, weight, vectors: [lowest, along_x, along_y], .. } = scratch;
    for l in 0..lanes {
        let at = node[l] as usize;
        if at != held.at {
            held.give(simd, chunk);
            *held = Held::nothing(simd);
            held.at = at;
        }
        let along = weights.pairs(simd.splat_pairs(offset[l]));
        let mass = weights.ones(simd.splat_ones(offset[l]));
        let across = weights.places * simd.repeat(&along_y[l]);
        let mut momentum = along * (simd.repeat(&lowest[l]) + across);
        let next = along * simd.repeat(&along_x[l]);
        for (i, weight) in weight.iter().enumerate() {
            held.momentum[i] = held.momentum[i] + simd.splat_pairs(weight[l]) * momentum;
            held.mass[i] = held.mass[i] + simd.splat_ones(weight[l]) * mass;
            momentum = momentum + next;
        }
    }
}

/// What the particles of one cell have given so far: it goes to memory when the cell changes.
struct Held<S: Simd> {
    /// The lowest node, counted in the patch; none at first.
    at: usize,
    momentum: [S::Pairs; 3],
    mass: [S::Ones; 3],
}

impl<S: Simd> Held<S> {
    #[inline(always)]
    fn nothing(simd: S) -> Self {
        let (momentum, mass) = ([simd.splat_pairs(0.0); 3], [simd.splat_ones(0.0); 3]);
        Self { at: usize::MAX, momentum, mass }
    }

    #[inline(always)]
    fn give(&self, simd: S, chunk: &mut Chunk) {
        if self.at == usize::MAX {
            return;
        }
        for i in 0..3 {
            let (momentum, mass) = chunk.nodes(self.at, i);
            simd.store_pairs(simd.load_pairs(momentum) + self.momentum[i], momentum);
            simd.store_ones(simd.load_ones(mass) + self.mass[i], mass);
        }
    }
}
