//! Devices beside the processor that run the substeps of many solvers at once: eddy's own code for them lies in crates that
//! use this one.

use super::{
    attractor::{self, Attractor},
    error::MpmError,
    grid::{LEAST_OPEN, WALL_CELLS},
    material::{
        JELLY_STIFFNESS, ROPE_STIFFNESS, SAND_STIFFNESS, SNOW_HARDENING, SNOW_HARDENING_EXPONENTS,
        SNOW_HARDENING_RANGE, SNOW_STRETCH,
    },
    sand,
    solver::Solver,
    tool::Motion,
    water,
};

/// What a solver runs until the next frame.
#[derive(Clone, Debug, PartialEq)]
pub struct Interval {
    /// Number of substeps.
    pub substeps: u32,
    /// Length of a substep (s).
    pub dt: f32,
    /// Acts meanwhile.
    pub attractor: Option<Attractor>,
    /// How each tool of the solver moves meanwhile.
    pub motions: Vec<Motion>,
}

/// A device that runs the substeps of many solvers side by side, with the forces, walls and laws of [`Solver::advance`].
///
/// The same particles give the same bits in every run, whatever other solvers run beside; they differ from those of the
/// processor by the rounding of sums.
pub trait Accelerator: Send {
    /// Whether these solvers fit into its memory together.
    ///
    /// # Errors
    /// [`MpmError::Device`].
    fn has_room(&self, solvers: &[&Solver]) -> Result<bool, MpmError>;

    /// Takes settings and particles of these solvers in place of all that it has.
    ///
    /// # Errors
    /// [`MpmError::Device`]: a call of the device failed, or its memory does not suffice.
    fn load(&mut self, solvers: &[&Solver]) -> Result<(), MpmError>;

    /// Runs an interval of each solver, in their order. The outcomes are those of [`Solver::run`]: whether the substeps were short
    /// enough is checked from the particles that it ends with ([`Simulation::finish_interval`](super::Simulation::finish_interval)).
    ///
    /// # Errors
    /// [`MpmError::Device`]: the device has failed. [`MpmError::Cancelled`]: the caller, asked at least every 64 substeps, did not want
    /// any further.
    fn run(
        &mut self,
        intervals: &[Interval],
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Vec<Result<(), usize>>, MpmError>;

    /// Copies the particles to the solvers, in the order of [`Accelerator::load`], as they are after the last run.
    fn fetch(&mut self, solvers: &mut [&mut Solver]);
}

/// The numbers of the laws, the walls and the attractor, by the names that the devices' programs have for them.
pub const CONSTANTS: [(&str, f32); 18] = [
    ("WALL_CELLS", WALL_CELLS as f32),
    ("LEAST_OPEN", LEAST_OPEN),
    ("LEAST_LIQUID", water::LEAST_LIQUID),
    ("MAX_AREA", water::MAX_AREA),
    ("RELAXATION_TIME", water::RELAXATION_TIME),
    ("JELLY_STIFFNESS", JELLY_STIFFNESS),
    ("ROPE_STIFFNESS", ROPE_STIFFNESS),
    ("SNOW_HARDENING", SNOW_HARDENING),
    ("SNOW_LEAST_EXPONENT", SNOW_HARDENING_EXPONENTS[0]),
    ("SNOW_MOST_EXPONENT", SNOW_HARDENING_EXPONENTS[1]),
    ("SNOW_SOFTEST", SNOW_HARDENING_RANGE[0]),
    ("SNOW_HARDEST", SNOW_HARDENING_RANGE[1]),
    ("SNOW_LOWEST", SNOW_STRETCH[0]),
    ("SNOW_HIGHEST", SNOW_STRETCH[1]),
    ("SAND_STIFFNESS", SAND_STIFFNESS),
    ("SAND_LEAST", sand::STRETCH[0]),
    ("SAND_MOST", sand::STRETCH[1]),
    ("CORE", attractor::CORE),
];
