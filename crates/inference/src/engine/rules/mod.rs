//! Rules that correct predictions: physical laws that a network's errors violate. The error of a frame is small, but in a
//! rollout errors accumulate.
//!
//! A rule's inputs are an observed frame, its ballistic step, the predicted frame, and what does not change in a stream:
//! materials, rest shape, order of the particles, domain. It does not depend on the predictor. Its constants are part of the
//! checkpoint ([`checkpoint::Rules`](crate::checkpoint::Rules)); a rule without constants is off. In order:
//!
//! 1. `elastic`: bodies of jelly that nothing else is close to move by their elasticity.
//! 2. `area`: liquids keep their area.
//! 3. `shape`: jelly and rope keep their shape.
//! 4. `bodies`: connected groups of particles; `body_rule`: the steps that the last two rules share.
//! 5. `flight`: bodies that touch nothing keep their momentum and angular momentum.
//! 6. `rest`: bodies that touch a wall and hardly move come to rest.
//!
//! [`RuleSet::stages`] lists their steps. The particle model runs them after its own stages, on all threads;
//! [`Corrector`] runs them after any other predictor.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

mod area;
mod bodies;
mod body_rule;
mod corrector;
mod elastic;
mod flight;
mod rest;
mod shape;

use super::{Ballistic, particle_features::Motion};
use crate::{
    checkpoint::{self, Description, FlightRule, RestRule},
    kernels::{
        lattice::{Expected, Lattices},
        nodes::Nodes,
        rest_shape::RestShape,
    },
};
pub use corrector::Corrector;
use eddy_frames::{Domain, Material};
use eddy_threads::DisjointSlice;
pub use elastic::lattices;

use area::Pressure;
use bodies::Bodies;
use body_rule::BodyCorrection;
use elastic::Elastic;
use shape::Shape;

/// A step of a rule.
#[derive(Clone, Copy, Debug)]
pub(super) enum Stage {
    /// The rule [`elastic`]; an item is a body.
    Elastic,
    /// A step of [`area`].
    Area(area::Step),
    /// A step of [`shape`].
    Shape(shape::Step),
    /// Finds the bodies, and those that each rule applies to; one item.
    Bodies,
    /// A step of [`flight`].
    Flight(body_rule::Step),
    /// A step of [`rest`].
    Rest(body_rule::Step),
}

/// The rules of a checkpoint.
#[derive(Clone, Copy, Debug)]
pub(super) struct RuleSet {
    rules: checkpoint::Rules,
    /// Distance between particles at rest (domain lengths).
    spacing: f32,
}

/// A frame before its prediction; rows are in the order of the hidden state.
pub(super) struct Observed<'a> {
    pub(super) position: &'a [[f32; 2]],
    pub(super) velocity: &'a [[f32; 2]],
    /// The grid of these particles.
    pub(super) nodes: &'a Nodes,
    /// The ballistic step in the frame's domain.
    pub(super) ballistic: Ballistic,
    pub(super) domain: Domain,
    /// The rest shape, by rows.
    pub(super) rest: &'a RestShape,
    /// The lattices of bodies of jelly, by rows.
    pub(super) lattices: &'a Lattices,
    /// The frame's particle in each row.
    pub(super) order: &'a [u32],
}

/// A predicted frame, its particles in the frame's order.
#[derive(Clone, Copy)]
pub(super) struct Predicted<'a> {
    pub(super) position: DisjointSlice<'a, [f32; 2]>,
    pub(super) velocity: DisjointSlice<'a, [f32; 2]>,
    pub(super) material: &'a [Material],
}

impl Predicted<'_> {
    /// The motion of a particle.
    ///
    /// # Safety
    /// No item writes it at the same time.
    #[inline(always)]
    unsafe fn read(&self, particle: usize) -> Motion {
        let own = particle..particle + 1;
        // SAFETY: guaranteed by the caller.
        unsafe { (self.position.read(own.clone())[0], self.velocity.read(own)[0]) }
    }

    /// Position and velocity of a particle, to write.
    ///
    /// # Safety
    /// No other item uses them at the same time.
    #[inline(always)]
    #[expect(clippy::mut_from_ref, reason = "as in `DisjointSlice::part`")]
    pub(super) unsafe fn one(&self, particle: usize) -> (&mut [f32; 2], &mut [f32; 2]) {
        let own = particle..particle + 1;
        // SAFETY: guaranteed by the caller.
        unsafe { (&mut self.position.part(own.clone())[0], &mut self.velocity.part(own)[0]) }
    }
}

/// Scratch buffers of the rules.
#[derive(Debug)]
pub(super) struct Scratch {
    elastic: elastic::Scratch,
    pressure: Option<Pressure>,
    shape: shape::Scratch,
    bodies: Bodies,
    flight: body_rule::Scratch<FlightRule>,
    rest: body_rule::Scratch<RestRule>,
}

/// The correction of one frame in progress.
pub(super) struct Correction<'a> {
    observed: Observed<'a>,
    predicted: Predicted<'a>,
    elastic: Elastic<'a>,
    pressure: DisjointSlice<'a, Option<Pressure>>,
    shape: Option<Shape<'a>>,
    bodies: DisjointSlice<'a, Bodies>,
    flight: Option<BodyCorrection<'a, FlightRule>>,
    rest: Option<BodyCorrection<'a, RestRule>>,
}

impl RuleSet {
    /// The rules of the described network; none for a frame model.
    pub(super) fn new(description: &Description) -> Self {
        let spacing = description.grid.as_ref().map_or(0.0, |grid| grid.spacing);
        Self { rules: description.rules, spacing }
    }

    /// The steps of the rules that are on, in order.
    pub(super) fn stages(&self) -> Vec<Stage> {
        let checkpoint::Rules { elastic, area, shape, flight, rest } = self.rules;
        let mut stages = Vec::new();
        if elastic.is_some() {
            stages.push(Stage::Elastic);
        }
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
            stages.extend(body_rule::STEPS.map(Stage::Flight));
        }
        if rest.is_some() {
            stages.extend(body_rule::STEPS.map(Stage::Rest));
        }
        stages
    }

    pub(super) fn scratch(&self) -> Scratch {
        Scratch {
            elastic: elastic::Scratch::default(),
            pressure: self.rules.area.map(|rule| Pressure::new(rule, self.spacing)),
            shape: shape::Scratch::default(),
            bodies: Bodies::default(),
            flight: body_rule::Scratch::default(),
            rest: body_rule::Scratch::default(),
        }
    }

    /// Begins the correction of a frame, whose stages are then to be run in order. `expected` is what the lattices of this stream expect in
    /// `observed`, then of the coming frame.
    pub(super) fn begin<'a>(
        &self,
        scratch: &'a mut Scratch,
        observed: Observed<'a>,
        expected: &'a mut Expected,
        predicted: Predicted<'a>,
    ) -> Correction<'a> {
        let Scratch { elastic, pressure, shape, bodies, flight, rest } = scratch;
        let rules = self.rules;
        let (nodes, particles) = (observed.nodes, observed.order.len());
        if rules.flight.is_some() || rules.rest.is_some() {
            bodies.reserve(nodes);
        }
        let (at_rest, order) = (observed.rest, observed.order);
        Correction {
            elastic: Elastic::new(observed.lattices, expected, elastic),
            pressure: DisjointSlice::new(std::slice::from_mut(pressure)),
            shape: rules.shape.map(|rule| shape.shape(rule, at_rest, order)),
            bodies: DisjointSlice::new(std::slice::from_mut(bodies)),
            flight: rules.flight.map(|rule| BodyCorrection::new(rule, flight, nodes, particles)),
            rest: rules.rest.map(|rule| BodyCorrection::new(rule, rest, nodes, particles)),
            observed,
            predicted,
        }
    }
}

impl Correction<'_> {
    /// Number of items of a stage.
    pub(super) fn items(&self, stage: Stage) -> usize {
        match stage {
            Stage::Elastic => self.elastic.items(),
            Stage::Area(area::Step::Shift) => {
                self.predicted.position.len().div_ceil(area::PARTICLES)
            }
            Stage::Shape(_) => self.shape.as_ref().map_or(0, Shape::items),
            Stage::Area(area::Step::Solve) | Stage::Bodies => 1,
            Stage::Flight(step) | Stage::Rest(step) => step.items(self.observed.nodes),
        }
    }

    /// Runs an item of a stage. The items of one stage may run at the same time, once each, but not beside those of another
    /// stage.
    #[inline(always)]
    pub(super) fn run(&self, stage: Stage, item: usize) {
        let Self { observed, predicted, elastic, shape, flight, rest, .. } = self;
        match stage {
            Stage::Elastic => elastic.run(item, observed, predicted),
            Stage::Area(step) => self.area(step, item),
            Stage::Shape(step) => {
                let Some(shape) = shape else { return };
                let Predicted { position, velocity, .. } = predicted;
                shape.run(step, item, position, velocity, &observed.ballistic);
            }
            Stage::Bodies => self.find_bodies(),
            Stage::Flight(step) => {
                let Some(flight) = flight else { return };
                flight.run(step, item, self.bodies(), observed, predicted);
            }
            Stage::Rest(step) => {
                let Some(rest) = rest else { return };
                rest.run(step, item, self.bodies(), observed, predicted);
            }
        }
    }

    #[inline(always)]
    fn area(&self, step: area::Step, item: usize) {
        let Observed { domain, ballistic, .. } = &self.observed;
        let Predicted { position, velocity, material } = &self.predicted;
        match step {
            // SAFETY: this step has one item, which only reads the predictions.
            area::Step::Solve => unsafe {
                if let [Some(pressure)] = self.pressure.part(0..1) {
                    pressure.solve(position.read(0..position.len()), material, domain, ballistic);
                }
            },
            area::Step::Shift => {
                let begin = item * area::PARTICLES;
                let own = begin..(begin + area::PARTICLES).min(position.len());
                // SAFETY: this step only reads the pressure, and only this item uses these particles.
                let (pressure, position, velocity) = unsafe {
                    (
                        self.pressure.read(0..1),
                        position.part(own.clone()),
                        velocity.part(own.clone()),
                    )
                };
                if let [Some(pressure)] = pressure {
                    pressure.apply(position, velocity, &material[own], ballistic);
                }
            }
        }
    }

    fn find_bodies(&self) {
        let Observed { position, velocity, nodes, ballistic, .. } = &self.observed;
        // SAFETY: this stage has one item.
        let bodies = unsafe { &mut self.bodies.part(0..1)[0] };
        bodies.find(nodes, position, velocity);
        if let Some(flight) = &self.flight {
            flight.select(bodies, ballistic, nodes.width());
        }
        if let Some(rest) = &self.rest {
            rest.select(bodies, ballistic, nodes.width());
        }
    }

    #[inline(always)]
    fn bodies(&self) -> &Bodies {
        // SAFETY: only the stage that finds them writes them, and it does not call this.
        unsafe { &self.bodies.read(0..1)[0] }
    }
}
