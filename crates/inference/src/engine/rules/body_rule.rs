//! The steps of a rule for bodies: sums over the particles of each cell, one correction per body from the sums of its
//! cells, and its application to the body's particles.

use std::{fmt::Debug, ops::Range};

use super::{
    super::{Ballistic, particle_features::Motion},
    Observed, Predicted,
    bodies::Bodies,
};
use crate::kernels::nodes::Nodes;
use eddy_threads::DisjointSlice;

/// Cells per item.
const CELLS: usize = 64;

/// A step of the rule.
#[derive(Clone, Copy, Debug)]
pub(in super::super) enum Step {
    /// Sums over cells; an item is a block of cells.
    Sum,
    /// The bodies' corrections; one item.
    Join,
    /// Corrects particles; an item is a block of cells.
    Correct,
}

/// The steps, in order.
pub(super) const STEPS: [Step; 3] = [Step::Sum, Step::Join, Step::Correct];

impl Step {
    /// Number of items.
    pub(super) fn items(self, nodes: &Nodes) -> usize {
        match self {
            Self::Sum | Self::Correct => nodes.cells().len().div_ceil(CELLS),
            Self::Join => 1,
        }
    }
}

/// The motion of a body's particle.
pub(super) struct Particle {
    pub(super) observed: Motion,
    /// After one frame of free fall.
    pub(super) free: Motion,
    pub(super) predicted: Motion,
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
pub(super) trait BodyRule: Copy + Debug {
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
pub(super) struct Scratch<R: BodyRule> {
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
    /// Whether the rule applies to it.
    applies: bool,
    sums: R::BodySums,
    correction: Option<R::Correction>,
}

/// A rule in one frame.
pub(super) struct BodyCorrection<'a, R: BodyRule> {
    rule: R,
    bodies: DisjointSlice<'a, Vec<Body<R>>>,
    cells: DisjointSlice<'a, R::CellSums>,
}

impl<'a, R: BodyRule> BodyCorrection<'a, R> {
    /// Reserves as much as the grid can grow without allocating.
    pub(super) fn new(
        rule: R,
        scratch: &'a mut Scratch<R>,
        nodes: &Nodes,
        particles: usize,
    ) -> Self {
        let Scratch { bodies, cells } = scratch;
        bodies.clear();
        bodies.reserve(Bodies::capacity(nodes));
        cells.clear();
        // At most one cell per particle.
        cells.reserve(particles);
        cells.resize(nodes.cells().len(), R::CellSums::default());
        Self {
            rule,
            bodies: DisjointSlice::new(std::slice::from_mut(bodies)),
            cells: DisjointSlice::new(cells),
        }
    }

    /// Selects the bodies that the rule applies to; `width` is the width of a cell (domain lengths). One item calls this
    /// before the first step.
    pub(super) fn select(&self, found: &Bodies, walls: &Ballistic, width: f32) {
        let body = |clear| Body {
            applies: clear == R::CLEAR_OF_WALLS,
            sums: R::BodySums::default(),
            correction: None,
        };
        let clear = found.clear_of(walls, self.rule.wall_distance() * width);
        // SAFETY: no other item is running.
        let bodies = unsafe { &mut self.bodies.part(0..1)[0] };
        bodies.clear();
        bodies.extend(clear.map(body));
    }

    /// Runs an item of a step.
    #[inline(always)]
    pub(super) fn run(
        &self,
        step: Step,
        item: usize,
        found: &Bodies,
        observed: &Observed<'_>,
        predicted: &Predicted<'_>,
    ) {
        let own = item * CELLS..((item + 1) * CELLS).min(observed.nodes.cells().len());
        match step {
            Step::Sum => self.sum(own, found, observed, predicted),
            Step::Join => self.join(found, observed),
            Step::Correct => self.correct(own, found, observed, predicted),
        }
    }

    #[inline(always)]
    fn sum(
        &self,
        own: Range<usize>,
        found: &Bodies,
        observed: &Observed<'_>,
        predicted: &Predicted<'_>,
    ) {
        // SAFETY: this step only reads the bodies, and only this item uses these cells.
        let (bodies, sums) = unsafe { (&self.bodies.read(0..1)[0], self.cells.part(own.clone())) };
        for (cell, sums) in observed.nodes.cells()[own].iter().zip(sums) {
            *sums = R::CellSums::default();
            if !bodies[found.of(cell)].applies {
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
        for (cell, sums) in cells.iter().zip(sums) {
            R::add_cell(&mut bodies[found.of(cell)].sums, sums);
        }
        for body in bodies.iter_mut().filter(|body| body.applies) {
            body.correction = self.rule.correction(&body.sums, &observed.ballistic);
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
