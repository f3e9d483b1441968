//! Rules that correct predictions: physics that a network's errors break. The errors of a frame are small, but in
//! a rollout they add up.
//!
//! A rule works on a frame as it was observed, its ballistic step, the predicted frame, and what does not change in a
//! stream: materials, the shape at rest, the order of the particles, the domain. It knows nothing of what predicted. Its
//! constants stand in the checkpoint ([`checkpoint::Rules`](crate::checkpoint::Rules)); one that is absent is off. In order:
//!
//! 1. `area`: liquids keep their area.
//! 2. `shape`: jelly and rope keep their shape.
//! 3. `bodies`: which particles hang together, for the last two.
//! 4. `flight`: bodies that touch nothing keep their momentum and their spin.
//! 5. `rest`: bodies that touch a wall and hardly move come to rest.
//!
//! [`RuleSet::stages`] lists their steps; the particle model runs them behind its own, on all its threads.
//! [`Corrector`] runs them after any other predictor.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

mod area;
mod bodies;
mod corrector;
mod flight;
mod rest;
mod shape;

use std::ops::Range;

use super::{Ballistic, crew::Parts, particle_features::State};
use crate::{
    checkpoint::{self, Description},
    kernels::{nodes::Nodes, rest::Rest},
};
pub use corrector::Corrector;
use eddy_frames::{Domain, Material};

use area::Area;
use bodies::Bodies;
use flight::{CellSums, Flights};
use rest::Rests;
use shape::Shape;

/// Cells of an item of the steps for bodies.
const CELLS: usize = 64;

/// A step of a rule.
#[derive(Clone, Copy, Debug)]
pub(super) enum Stage {
    /// A step of [`area`].
    Area(area::Step),
    /// A step of [`shape`].
    Shape(shape::Step),
    /// Which bodies there are, which fly, and which touch a wall; one item.
    Bodies,
    /// A step of [`flight`].
    Flight(flight::Step),
    /// A step of [`rest`].
    Rest(rest::Step),
}

/// The rules of a checkpoint.
#[derive(Clone, Copy, Debug)]
pub(super) struct RuleSet {
    rules: checkpoint::Rules,
    /// Distance between particles at rest (domain lengths).
    spacing: f32,
}

/// A frame before its prediction; rows are in the order of the stream's memory.
pub(super) struct Observed<'a> {
    /// Of each row.
    pub(super) position: &'a [[f32; 2]],
    pub(super) velocity: &'a [[f32; 2]],
    /// The grid that these particles touch.
    pub(super) nodes: &'a Nodes,
    /// The ballistic step in the frame's domain.
    pub(super) ballistic: Ballistic,
    pub(super) domain: Domain,
    /// The shape at rest, by rows.
    pub(super) rest: &'a Rest,
    /// The particle of the frame in each row.
    pub(super) order: &'a [u32],
}

impl Observed<'_> {
    /// Where free fall takes a row's particle.
    #[inline(always)]
    fn free(&self, row: usize) -> State {
        self.ballistic.free(self.position[row], self.velocity[row])
    }
}

/// A predicted frame, its particles in the frame's order.
#[derive(Clone, Copy)]
pub(super) struct Predicted<'a> {
    pub(super) position: Parts<'a, [f32; 2]>,
    pub(super) velocity: Parts<'a, [f32; 2]>,
    pub(super) material: &'a [Material],
}

impl Predicted<'_> {
    /// Positions and velocities of all particles.
    ///
    /// # Safety
    /// While they live, no item writes any.
    #[inline(always)]
    unsafe fn all(&self) -> (&[[f32; 2]], &[[f32; 2]]) {
        let all = 0..self.position.len();
        // SAFETY: the caller's part.
        unsafe { (self.position.read(all.clone()), self.velocity.read(all)) }
    }

    /// Position and velocity of a particle, to write.
    ///
    /// # Safety
    /// While they live, no other item uses them.
    #[inline(always)]
    #[expect(clippy::mut_from_ref, reason = "as in `Parts::part`")]
    pub(super) unsafe fn one(&self, particle: usize) -> (&mut [f32; 2], &mut [f32; 2]) {
        let own = particle..particle + 1;
        // SAFETY: the caller's part.
        unsafe { (&mut self.position.part(own.clone())[0], &mut self.velocity.part(own)[0]) }
    }
}

/// Scratch buffers of the rules.
#[derive(Debug)]
pub(super) struct Scratch {
    area: Option<Area>,
    shape: shape::Scratch,
    bodies: Bodies,
    flights: Flights,
    rests: Rests,
    /// For each cell.
    sums: Vec<CellSums>,
    speeds: Vec<f64>,
}

/// The correction of one frame under way.
pub(super) struct Correction<'a> {
    rules: checkpoint::Rules,
    observed: Observed<'a>,
    predicted: Predicted<'a>,
    area: Parts<'a, Option<Area>>,
    shape: Option<Shape<'a>>,
    bodies: Parts<'a, Bodies>,
    flights: Parts<'a, Flights>,
    rests: Parts<'a, Rests>,
    sums: Parts<'a, CellSums>,
    speeds: Parts<'a, f64>,
}

impl RuleSet {
    /// The rules of the described network; none for a frame model.
    pub(super) fn new(description: &Description) -> Self {
        let spacing = description.surroundings.map_or(0.0, |surroundings| surroundings.spacing);
        Self { rules: description.rules, spacing }
    }

    /// The steps of the rules that are on, in order.
    pub(super) fn stages(&self) -> Vec<Stage> {
        let checkpoint::Rules { area, shape, flight, rest } = self.rules;
        let mut stages = Vec::new();
        if area.is_some() {
            stages.extend(area::STEPS.map(Stage::Area));
        }
        if let Some(rule) = shape {
            stages.extend(shape::steps(rule).map(Stage::Shape));
        }
        if flight.is_some() || rest.is_some() {
            stages.push(Stage::Bodies);
        }
        if flight.is_some() {
            stages.extend(flight::STEPS.map(Stage::Flight));
        }
        if rest.is_some() {
            stages.extend(rest::STEPS.map(Stage::Rest));
        }
        stages
    }

    pub(super) fn scratch(&self) -> Scratch {
        Scratch {
            area: self.rules.area.map(|rule| Area::new(rule, self.spacing)),
            shape: shape::Scratch::default(),
            bodies: Bodies::default(),
            flights: Flights::default(),
            rests: Rests::default(),
            sums: Vec::new(),
            speeds: Vec::new(),
        }
    }

    /// Begins the correction of a frame: its stages may run, in order.
    pub(super) fn begin<'a>(
        &self,
        scratch: &'a mut Scratch,
        observed: Observed<'a>,
        predicted: Predicted<'a>,
    ) -> Correction<'a> {
        let Scratch { area, shape, bodies, flights, rests, sums, speeds } = scratch;
        let checkpoint::Rules { shape: shape_rule, flight, rest, .. } = self.rules;
        let (particles, cells) = (observed.order.len(), observed.nodes.cells().len());
        if flight.is_some() || rest.is_some() {
            bodies.make_room(observed.nodes);
        }
        if flight.is_some() {
            flights.make_room(observed.nodes);
            // At most a cell for each particle, in any frame.
            sums.clear();
            sums.reserve(particles);
            sums.resize(cells, CellSums::default());
        }
        if rest.is_some() {
            rests.make_room(observed.nodes);
            speeds.clear();
            speeds.reserve(particles);
            speeds.resize(cells, 0.0);
        }
        let (at_rest, order) = (observed.rest, observed.order);
        Correction {
            rules: self.rules,
            area: Parts::new(std::slice::from_mut(area)),
            shape: shape_rule.map(|rule| shape.shape(rule, at_rest, order)),
            bodies: Parts::new(std::slice::from_mut(bodies)),
            flights: Parts::new(std::slice::from_mut(flights)),
            rests: Parts::new(std::slice::from_mut(rests)),
            sums: Parts::new(sums),
            speeds: Parts::new(speeds),
            observed,
            predicted,
        }
    }
}

impl Correction<'_> {
    /// How many items a stage has.
    pub(super) fn items(&self, stage: Stage) -> usize {
        let cells = self.observed.nodes.cells().len().div_ceil(CELLS);
        match stage {
            Stage::Area(area::Step::Shift) => {
                self.predicted.position.len().div_ceil(area::PARTICLES)
            }
            Stage::Shape(_) => self.shape.as_ref().map_or(0, Shape::items),
            Stage::Flight(flight::Step::Sum | flight::Step::Correct) => cells,
            Stage::Rest(rest::Step::Weigh | rest::Step::Correct) => cells,
            Stage::Area(area::Step::Solve) | Stage::Bodies => 1,
            Stage::Flight(flight::Step::Join) | Stage::Rest(rest::Step::Judge) => 1,
        }
    }

    /// An item of a stage. Items of one stage may run at the same time, once each, and not beside any of another one.
    #[inline(always)]
    pub(super) fn run(&self, stage: Stage, item: usize) {
        match stage {
            Stage::Area(step) => self.area(step, item),
            Stage::Shape(step) => {
                let Some(shape) = &self.shape else { return };
                let Predicted { position, velocity, .. } = &self.predicted;
                shape.run(step, item, position, velocity, &self.observed.ballistic);
            }
            Stage::Bodies => self.find_bodies(),
            Stage::Flight(step) => self.flight(step, item),
            Stage::Rest(step) => self.rest(step, item),
        }
    }

    #[inline(always)]
    fn area(&self, step: area::Step, item: usize) {
        let Observed { domain, ballistic, .. } = &self.observed;
        let Predicted { position, velocity, material } = &self.predicted;
        match step {
            // SAFETY: this step has one item, which only reads the predictions.
            area::Step::Solve => unsafe {
                if let [Some(area)] = self.area.part(0..1) {
                    area.find(position.read(0..position.len()), material, domain, ballistic);
                }
            },
            area::Step::Shift => {
                let begin = item * area::PARTICLES;
                let own = begin..(begin + area::PARTICLES).min(position.len());
                // SAFETY: this step only reads the pressure, and these particles are those of this item alone.
                let (area, position, velocity) = unsafe {
                    (self.area.read(0..1), position.part(own.clone()), velocity.part(own.clone()))
                };
                if let [Some(area)] = area {
                    area.give_way(position, velocity, &material[own], ballistic);
                }
            }
        }
    }

    fn find_bodies(&self) {
        let Observed { position, velocity, nodes, ballistic, .. } = &self.observed;
        let checkpoint::Rules { flight, rest, .. } = self.rules;
        // SAFETY: this stage has one item.
        let (bodies, flights, rests) = unsafe {
            (&mut self.bodies.part(0..1)[0], &mut self.flights.part(0..1)[0], self.rests.part(0..1))
        };
        bodies.find(nodes, position, velocity);
        if let Some(rule) = flight {
            flights.begin(rule, bodies, ballistic, nodes.width());
        }
        if let Some(rule) = rest {
            rests[0].begin(rule, bodies, ballistic, nodes.width());
        }
    }

    /// The cells of an item.
    #[inline(always)]
    fn cells(&self, item: usize) -> Range<usize> {
        item * CELLS..((item + 1) * CELLS).min(self.observed.nodes.cells().len())
    }

    #[inline(always)]
    fn flight(&self, step: flight::Step, item: usize) {
        let (observed, predicted) = (&self.observed, &self.predicted);
        let (cells, own) = (observed.nodes.cells(), self.cells(item));
        // SAFETY: only the stage before writes them.
        let bodies = unsafe { &self.bodies.read(0..1)[0] };
        match step {
            // SAFETY: this step only reads the flights, and these cells are those of this item alone.
            flight::Step::Sum => unsafe {
                let sums = self.sums.part(own.clone());
                self.flights.read(0..1)[0].sum(bodies, observed, predicted, &cells[own], sums);
            },
            // SAFETY: this step has one item.
            flight::Step::Join => unsafe {
                let sums = self.sums.read(0..cells.len());
                self.flights.part(0..1)[0].join(bodies, cells, sums);
            },
            // SAFETY: as for the sums.
            flight::Step::Correct => unsafe {
                self.flights.read(0..1)[0].correct(bodies, observed, predicted, &cells[own]);
            },
        }
    }

    #[inline(always)]
    fn rest(&self, step: rest::Step, item: usize) {
        let (observed, predicted) = (&self.observed, &self.predicted);
        let (cells, own) = (observed.nodes.cells(), self.cells(item));
        let Some(rule) = self.rules.rest else { return };
        // SAFETY: only an earlier stage writes them.
        let bodies = unsafe { &self.bodies.read(0..1)[0] };
        match step {
            // SAFETY: this step only reads the bodies, and these cells are those of this item alone.
            rest::Step::Weigh => unsafe {
                let speeds = self.speeds.part(own.clone());
                self.rests.read(0..1)[0].weigh(bodies, observed, predicted, &cells[own], speeds);
            },
            // SAFETY: this step has one item.
            rest::Step::Judge => unsafe {
                let speeds = self.speeds.read(0..cells.len());
                self.rests.part(0..1)[0].judge(rule, bodies, &observed.ballistic, cells, speeds);
            },
            // SAFETY: as for the speeds.
            rest::Step::Correct => unsafe {
                self.rests.read(0..1)[0].correct(bodies, observed, predicted, &cells[own]);
            },
        }
    }
}
