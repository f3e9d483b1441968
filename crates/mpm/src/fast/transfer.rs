//! The pass over the particles of a chunk: gathers velocities, advances particles, updates their stress and scatters their
//! momentum to the chunk's patch of the grid.
//!
//! All particles have the same mass, so masses and momenta are in units of it.

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
    scatter::{CellSum, prepare, scatter},
    simd::{LANES, Lanes, Simd, Vectors},
    stencil::{Stencils, Weights},
};

/// Parameters of a substep.
#[derive(Clone, Copy, Debug)]
pub(super) struct Step {
    /// Length of the substep (s).
    pub(super) dt: f32,
    /// Cell width (domain lengths).
    pub(super) dx: f32,
    /// Cells per domain length.
    pub(super) inverse_dx: f32,
    /// `-dt 4 / (dx^2 rho)`: converts Kirchhoff stress to the affine part of the velocity.
    pub(super) impulse: f32,
    /// Particles per cell in an undeformed body.
    pub(super) particles_per_cell: f32,
    /// Material parameters.
    pub(super) moduli: Moduli,
}

impl Step {
    /// The parameters for these settings.
    pub(super) fn of(settings: &SolverSettings) -> Self {
        let SolverSettings { grid: GridShape { dx, .. }, dt, .. } = *settings;
        let inverse_dx = 1.0 / dx;
        Self {
            dt,
            dx,
            inverse_dx,
            impulse: -dt * 4.0 * inverse_dx * inverse_dx / DENSITY,
            particles_per_cell: dx * dx / settings.volume(),
            moduli: Moduli::of(&settings.materials),
        }
    }

    /// The lowest node of the stencil at a position (domain lengths).
    pub(super) fn lowest(&self, position: [f32; 2]) -> [i32; 2] {
        position.map(|x| (x * self.inverse_dx - 0.5) as i32)
    }
}

/// Scratch buffer of a pack, between vectors over particles and vectors over nodes. Reused without clearing.
#[repr(align(64))]
pub(super) struct Scratch {
    /// Index of each stencil's lowest node.
    pub(super) node: [i32; LANES],
    /// Distance from the lowest node along y (cells).
    pub(super) offset: Lanes,
    /// Weights of the three rows.
    pub(super) weight: [Lanes; 3],
    /// Weights times the distance along x (cells).
    pub(super) moment: [Lanes; 3],
    /// Grid mass at each particle, in units of a particle's mass.
    pub(super) mass: Lanes,
    /// Three vectors per particle.
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

/// The pass over the particles of a chunk. Without `GATHER` particles only scatter their momentum; without `SCATTER` they
/// only gather and move.
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
        let mut sum = CellSum::zero(simd);
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
                prepare(simd, pack, &stress, &stencils, chunk, step, &mut scratch);
                scatter(simd, &weights, &scratch, lanes, chunk, &mut sum);
            }
        }
        if SCATTER {
            sum.flush(simd, chunk);
        }
    }
}
