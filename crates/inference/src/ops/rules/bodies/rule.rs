//! The steps of a rule for bodies: sums over the particles of each cell, one correction per body from the sums of its
//! cells, and its application to the body's particles.

use std::{fmt::Debug, ops::Range};

use super::{
    super::{Ballistic, InFrame, Motion, Observed, Predicted, RuleOperation},
    Bodies,
};
use eddy_threads::DisjointSlice;

/// Cells per item.
const CELLS: usize = 64;

/// Sums over cells; an item is a block of cells.
const SUM: usize = 0;
/// The bodies' corrections; one item.
const JOIN: usize = 1;
/// Corrects particles; an item is a block of cells.
const CORRECT: usize = 2;
/// Number of steps.
pub(crate) const STEPS: usize = 3;

/// The motion of a body's particle.
pub(crate) struct Particle {
    pub(crate) observed: Motion,
    /// After one frame of free fall.
    pub(crate) free: Motion,
    pub(crate) predicted: Motion,
}

impl Particle {
    /// The particle in a row, and its index in the frame.
    ///
    /// # Safety
    /// No item writes its prediction at the same time.
    #[inline(always)]
    unsafe fn new(observed: &Observed<'_>, predicted: &Predicted<'_>, row: u32) -> (Self, usize) {
        let (x, v) = (observed.position[row as usize], observed.velocity[row as usize]);
        let index = observed.order[row as usize] as usize;
        // SAFETY: guaranteed by the caller.
        let predicted = unsafe { predicted.read(index) };
        (Self { observed: (x, v), free: observed.ballistic.free(x, v), predicted }, index)
    }
}

/// A rule for bodies.
pub(crate) trait BodyRule: RuleOperation {
    /// Sums over the particles of a cell.
    type CellSums: Copy + Debug + Default + Send + Sync;
    /// Sums over the cells of a body.
    type BodySums: Copy + Debug + Default + Send + Sync;
    /// The correction of a body.
    type Correction: Copy + Debug + Send + Sync;

    /// Distance from walls (cells).
    fn wall_distance(&self) -> f32;
    /// Whether the rule applies to bodies that keep that distance, or to the others.
    const CLEAR_OF_WALLS: bool;

    fn add_particle(sums: &mut Self::CellSums, particle: &Particle);
    fn add_cell(sums: &mut Self::BodySums, cell: &Self::CellSums);
    /// The correction of a body; none if it remains as predicted.
    fn correction(&self, sums: &Self::BodySums, walls: &Ballistic) -> Option<Self::Correction>;
    /// The corrected motion of a particle.
    fn correct(correction: &Self::Correction, particle: &Particle, walls: &Ballistic) -> Motion;
}

/// Scratch buffers of a rule.
#[derive(Debug)]
pub(crate) struct Scratch<R: BodyRule> {
    bodies: Vec<Body<R>>,
    cells: Vec<R::CellSums>,
}

impl<R: BodyRule> Default for Scratch<R> {
    fn default() -> Self {
        Self { bodies: Vec::new(), cells: Vec::new() }
    }
}

#[derive(Clone, Copy, Debug)]
struct Body<R: BodyRule> {
    sums: R::BodySums,
    correction: Option<R::Correction>,
}

/// A rule in one frame.
pub(crate) struct BodyCorrection<'a, R: BodyRule> {
    rule: R,
    bodies: DisjointSlice<'a, Vec<Body<R>>>,
    cells: DisjointSlice<'a, R::CellSums>,
}

impl<'a, R: BodyRule> BodyCorrection<'a, R> {
    /// Reserves as much as the grid can grow without allocating.
    pub(crate) fn new(rule: R, scratch: &'a mut Scratch<R>, observed: &Observed<'_>) -> Self {
        let Scratch { bodies, cells } = scratch;
        bodies.clear();
        bodies.reserve(Bodies::capacity(observed.nodes));
        cells.clear();
        // At most one cell per particle.
        cells.reserve(observed.order.len());
        cells.resize(observed.nodes.cells().len(), R::CellSums::default());
        Self {
            rule,
            bodies: DisjointSlice::new(std::slice::from_mut(bodies)),
            cells: DisjointSlice::new(cells),
        }
    }

    /// Whether the rule applies to a body.
    fn applies(&self, body: usize, found: &Bodies, observed: &Observed<'_>) -> bool {
        let distance = self.rule.wall_distance() * observed.nodes.width();
        found.is_clear_of(body, &observed.ballistic, distance) == R::CLEAR_OF_WALLS
    }
}

impl<R: BodyRule> InFrame for BodyCorrection<'_, R> {
    fn items(&self, step: usize, observed: &Observed<'_>) -> usize {
        if step == JOIN { 1 } else { observed.nodes.cells().len().div_ceil(CELLS) }
    }

    #[inline(always)]
    fn run(
        &self,
        step: usize,
        item: usize,
        observed: &Observed<'_>,
        found: &Bodies,
        predicted: &Predicted<'_>,
    ) {
        let own = item * CELLS..((item + 1) * CELLS).min(observed.nodes.cells().len());
        match step {
            SUM => self.sum(own, found, observed, predicted),
            JOIN => self.join(found, observed),
            CORRECT => self.correct(own, found, observed, predicted),
            _ => unreachable!("there are {STEPS} steps"),
        }
    }
}

impl<R: BodyRule> BodyCorrection<'_, R> {
    #[inline(always)]
    fn sum(
        &self,
        own: Range<usize>,
        found: &Bodies,
        observed: &Observed<'_>,
        predicted: &Predicted<'_>,
    ) {
        // SAFETY: only this item uses these cells.
        let sums = unsafe { self.cells.part(own.clone()) };
        for (cell, sums) in observed.nodes.cells()[own].iter().zip(sums) {
            *sums = R::CellSums::default();
            if !self.applies(found.of(cell), found, observed) {
                continue;
            }
            for &row in &observed.nodes.order()[cell.slots()] {
                // SAFETY: this step only reads the predictions.
                let (particle, _) = unsafe { Particle::new(observed, predicted, row) };
                R::add_particle(sums, &particle);
            }
        }
    }

    fn join(&self, found: &Bodies, observed: &Observed<'_>) {
        let cells = observed.nodes.cells();
        // SAFETY: this step has one item.
        let (bodies, sums) =
            unsafe { (&mut self.bodies.part(0..1)[0], self.cells.read(0..cells.len())) };
        bodies.resize(found.len(), Body { sums: R::BodySums::default(), correction: None });
        for (cell, sums) in cells.iter().zip(sums) {
            R::add_cell(&mut bodies[found.of(cell)].sums, sums);
        }
        for (number, body) in bodies.iter_mut().enumerate() {
            if self.applies(number, found, observed) {
                body.correction = self.rule.correction(&body.sums, &observed.ballistic);
            }
        }
    }

    #[inline(always)]
    fn correct(
        &self,
        own: Range<usize>,
        found: &Bodies,
        observed: &Observed<'_>,
        predicted: &Predicted<'_>,
    ) {
        // SAFETY: this step only reads the bodies.
        let bodies = unsafe { &self.bodies.read(0..1)[0] };
        for cell in &observed.nodes.cells()[own] {
            let Some(correction) = &bodies[found.of(cell)].correction else { continue };
            for &row in &observed.nodes.order()[cell.slots()] {
                // SAFETY: a particle is in one cell, which only this item uses.
                unsafe {
                    let (particle, index) = Particle::new(observed, predicted, row);
                    let (position, velocity) = predicted.one(index);
                    (*position, *velocity) = R::correct(correction, &particle, &observed.ballistic);
                }
            }
        }
    }
}
