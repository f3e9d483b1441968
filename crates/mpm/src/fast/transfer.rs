//! The one pass over the particles of a chunk: velocity comes from the grid, particles move, deform
//! and are stressed, and their momentum goes to the patch of the grid that is the chunk's own.
//!
//! All particles have the same mass, so that weights are spread instead of masses, and momentum per
//! mass.

use super::{
    super::{
        grid::GridShape,
        material::{DENSITY, Moduli},
        solver::SolverSettings,
    },
    chunk::Chunk,
    field::Nodes,
    gather::gather,
    law,
    level::Work,
    pack::Pack,
    scatter::{Held, scatter, spread},
    simd::{LANES, Lanes, Simd, Vectors},
    stencil::{Stencils, Weights},
};

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

/// One pack between vectors and single particles. Kept from pack to pack, so that nothing is cleared.
#[repr(align(64))]
pub(super) struct Scratch {
    /// Node of each particle that its stencil begins with.
    pub(super) node: [i32; LANES],
    /// Distance from it along y (cells).
    pub(super) offset: Lanes,
    /// Weights of the three rows.
    pub(super) weight: [Lanes; 3],
    /// Weights times the distance along x (cells).
    pub(super) moment: [Lanes; 3],
    /// Mass around each particle, in masses of a particle.
    pub(super) mass: Lanes,
    /// Three vectors of each particle.
    pub(super) vectors: [Vectors; 3],
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
