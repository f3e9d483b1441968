//! Rules that correct predictions: physical laws that a network's errors violate. The error of a frame is small, but in a
//! rollout errors accumulate.
//!
//! A rule's inputs are an observed frame, its ballistic step, the predicted frame, and what does not change in a stream:
//! materials, rest shape, order of the particles, domain. It does not depend on the predictor. Its constants are part of the
//! checkpoint; a rule without constants is off.
//!
//! A rule is a folder: `mod.rs` has its constants, which implement [`RuleOperation`], its steps on processors and its launches
//! on GPUs; `device.cu` its kernels (that of [`elastic`] is in `eddy-cuda`, beside the tables that it reads); tests compare both.
//! [`Rules`] and `rules!` list the rules in the order in which they run; command line, checkpoints, engine and GPUs follow.
//! [`bodies`]: what the rules for connected groups of particles share.
//!
//! The particle model runs the stages of the rules after its own, on all threads; [`Corrector`] runs them after any other
//! predictor. On GPUs the particle model runs the launches of [`Rules::launches`].
//!
//! Kernels have the parameters `(const Stream* streams, const float* constants, int rule, int step)`: a block's y is its stream,
//! `constants` point to the struct `NAMEConstants` that [`RuleOperation::device_constants`] makes up, `rule` is the rule's place in
//! the list. `device.cu` beside this file has what they share.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

mod area;
pub mod bodies;
mod corrector;
pub mod elastic;
mod flight;
mod rest;
mod shape;

use std::fmt;

use serde::{Deserialize, Serialize};

use super::ballistic::{Ballistic, Motion};
use crate::{
    checkpoint::Description,
    kernels::{lattice::Lattices, nodes::Nodes, rest_shape::RestShape},
};
use eddy_frames::{Domain, Material};
use eddy_threads::DisjointSlice;

pub use area::{AreaRule, MARGIN as AREA_MARGIN};
pub use corrector::Corrector;
pub use elastic::ElasticRule;
pub use flight::FlightRule;
pub use rest::RestRule;
pub use shape::ShapeRule;

use bodies::Bodies;

/// A rule, by its constants.
pub(crate) trait RuleOperation: Copy + fmt::Debug + Send + Sync + 'static {
    /// The constants in new particle models; none where they depend on the data.
    const STANDARD: Option<Self>;
    /// Whether it needs the bodies of the frame.
    const NEEDS_BODIES: bool = false;
    /// Its kernels, unless another file has them.
    const DEVICE: &'static str;
    /// Numbers of each particle that its kernels keep within a frame, in the list `scratch` of the rule.
    const DEVICE_NUMBERS: usize = 0;

    /// Buffers that are kept between frames.
    type Scratch: Default + fmt::Debug + Send + Sync;
    /// The rule in one frame.
    type InFrame<'a>: InFrame;

    /// Checks the constants for a network.
    ///
    /// # Errors
    /// The first constant that is out of range.
    fn check(&self, network: &Network) -> Result<(), WrongConstant>;

    /// Number of its steps.
    fn steps(&self) -> usize;

    /// Begins a frame.
    fn begin<'a>(
        &self,
        scratch: &'a mut Self::Scratch,
        observed: &Observed<'a>,
    ) -> Self::InFrame<'a>;

    /// The constants of its kernels by name, at most [`DEVICE_CONSTANTS`]: the fields of the `Constants` that they read.
    fn device_constants(&self, network: &Network) -> Vec<(&'static str, f32)>;

    /// The launches of a frame, in order.
    fn launches(&self, most: &Most) -> Vec<Launch>;
}

/// A rule in one frame. The items of a step may run at the same time, once each, but not beside those of another step.
pub(crate) trait InFrame: Sync {
    /// Number of items of a step.
    fn items(&self, step: usize, observed: &Observed<'_>) -> usize;

    /// Runs an item of a step.
    fn run(
        &self,
        step: usize,
        item: usize,
        observed: &Observed<'_>,
        bodies: &Bodies,
        predicted: &Predicted<'_>,
    );
}

/// What the constants of a rule refer to.
#[derive(Clone, Copy, Debug)]
pub struct Network {
    /// Distance between particles at rest (domain lengths).
    pub spacing: f32,
    /// Cell width of the grid's finest level (domain lengths).
    pub cell_width: f32,
    /// Time between two frames (s).
    pub dt: f32,
    /// Gravity (domain lengths per second squared).
    pub gravity: [f32; 2],
    /// Whether it is conditioned on the stiffness.
    pub is_conditioned: bool,
}

impl Network {
    /// The described network; a frame model has no rules.
    pub fn of(description: &Description) -> Self {
        let grid = description.grid.as_ref();
        Self {
            spacing: grid.map_or(0.0, |grid| grid.spacing),
            cell_width: grid.map_or(0.0, |grid| grid.cell_width),
            dt: description.dt,
            gravity: description.gravity,
            is_conditioned: description.stiffness,
        }
    }

    /// The speed that gravity adds per frame (domain lengths per second).
    fn gain(&self) -> f32 {
        self.gravity[0].hypot(self.gravity[1]) * self.dt
    }
}

/// A constant that is out of range.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct WrongConstant {
    pub(crate) key: &'static str,
    pub(crate) found: String,
    pub(crate) expected: &'static str,
}

impl WrongConstant {
    /// `Ok` if `fits`.
    fn unless<T: fmt::Display>(
        fits: bool,
        key: &'static str,
        found: T,
        expected: &'static str,
    ) -> Result<(), Self> {
        if fits { Ok(()) } else { Err(Self { key, found: found.to_string(), expected }) }
    }

    /// Checks a number of sweeps.
    fn unless_sweeps(sweeps: usize) -> Result<(), Self> {
        Self::unless((1..=1000).contains(&sweeps), "sweeps", sweeps, "1 to 1000")
    }

    /// Checks a distance from walls (cells).
    fn unless_distance(distance: f32) -> Result<(), Self> {
        Self::unless((0.0..=64.0).contains(&distance), "wall_distance", distance, "0 to 64")
    }
}

/// Constants of a rule on a GPU, at most.
pub const DEVICE_CONSTANTS: usize = 16;

/// Sizes of the largest stream of a step on a GPU, which launches depend on.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Most {
    /// Particles.
    pub particles: usize,
    /// Nodes of the grid's finest level.
    pub nodes: usize,
    /// Cells of its map.
    pub cells: usize,
    /// Nodes of the grid of the rule [`AreaRule`].
    pub area_nodes: usize,
    /// Bodies of jelly with a lattice.
    pub lattices: usize,
}

/// A launch of a kernel for all streams.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Launch {
    /// The kernel's name.
    pub kernel: &'static str,
    /// Threads that a stream needs, at most; each goes on with further items.
    pub threads: usize,
    /// Threads of a block.
    pub block: usize,
    /// Dynamic shared memory of a block (bytes).
    pub shared: usize,
    /// The kernel's last argument.
    pub step: usize,
}

impl Launch {
    /// Blocks of 256 threads.
    const fn new(kernel: &'static str, threads: usize) -> Self {
        Self { kernel, threads, block: 256, shared: 0, step: 0 }
    }
}

/// The rules that correct predictions, in the order in which they run. An absent rule is off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Rules {
    /// Bodies of jelly that nothing else is close to move by their elasticity.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub elastic: Option<ElasticRule>,
    /// Liquids keep their area.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub area: Option<AreaRule>,
    /// Jelly and rope keep their shape.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub shape: Option<ShapeRule>,
    /// Bodies that touch nothing keep their momentum and angular momentum.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub flight: Option<FlightRule>,
    /// Bodies that touch a wall and hardly move come to rest.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub rest: Option<RestRule>,
}

macro_rules! rules {
    ($($(#[$doc:meta])* $field:ident: $name:ident($constants:ty);)*) => {
        /// One of the rules.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        #[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
        pub enum Rule {
            $($(#[$doc])* $name,)*
        }

        impl Rule {
            /// All rules, in the order in which they run.
            pub const ALL: [Self; [$(stringify!($name)),*].len()] = [$(Self::$name),*];

            /// Its key in `model.toml` and name on the command line.
            pub fn name(self) -> &'static str {
                match self { $(Self::$name => stringify!($field),)* }
            }
        }

        impl Rules {
            /// The rules of new particle models, but for those whose constants depend on the data.
            pub const STANDARD: Self =
                Self { $($field: <$constants as RuleOperation>::STANDARD,)* };

            /// Whether a rule is on.
            pub fn has(&self, rule: Rule) -> bool {
                match rule { $(Rule::$name => self.$field.is_some(),)* }
            }

            /// Switches a rule off.
            pub fn remove(&mut self, rule: Rule) {
                match rule { $(Rule::$name => self.$field = None,)* }
            }

            /// Checks the constants.
            pub(crate) fn check(&self, network: &Network) -> Result<(), (Rule, WrongConstant)> {
                $(if let Some(rule) = &self.$field {
                    rule.check(network).map_err(|wrong| (Rule::$name, wrong))?;
                })*
                Ok(())
            }

            /// The steps of the rules that are on, in order; the bodies are found before the first rule that needs them.
            pub(crate) fn stages(&self) -> Vec<Stage> {
                let (mut stages, mut bodies) = (Vec::new(), vec![Stage::Bodies]);
                $(if let Some(rule) = &self.$field {
                    if <$constants as RuleOperation>::NEEDS_BODIES {
                        stages.append(&mut bodies);
                    }
                    stages.extend((0..rule.steps()).map(|step| Stage::Rule(Rule::$name, step)));
                })*
                stages
            }

            /// Begins the correction of a frame, whose stages are then to be run in order.
            pub(crate) fn begin<'a>(
                &self,
                scratch: &'a mut Scratch,
                observed: Observed<'a>,
                predicted: Predicted<'a>,
            ) -> Correction<'a> {
                if self.need_bodies() {
                    scratch.bodies.reserve(observed.nodes);
                }
                Correction {
                    $($field: self.$field.map(|rule| rule.begin(&mut scratch.$field, &observed)),)*
                    bodies: DisjointSlice::new(std::slice::from_mut(&mut scratch.bodies)),
                    observed,
                    predicted,
                }
            }

            /// Whether a rule that is on needs the bodies of a frame.
            pub fn need_bodies(&self) -> bool {
                false $(|| self.$field.is_some() && <$constants as RuleOperation>::NEEDS_BODIES)*
            }

            /// The kernels of all rules, also of those that are off, each behind the struct of its constants.
            pub fn device_text(&self, network: &Network) -> String {
                let mut text = [include_str!("device.cu"), bodies::DEVICE].concat();
                $(if let Some(rule) = self.$field.or(<$constants as RuleOperation>::STANDARD) {
                    let names: Vec<_> =
                        rule.device_constants(network).iter().map(|(name, _)| *name).collect();
                    text += &constants_struct(stringify!($name), &names);
                    text += <$constants as RuleOperation>::DEVICE;
                })*
                text
            }

            /// The constants of the kernels of each rule in [`Rule::ALL`]; zeros where it is off.
            pub fn device_constants(
                &self,
                network: &Network,
            ) -> [[f32; DEVICE_CONSTANTS]; Rule::ALL.len()] {
                let padded = |constants: Vec<(&str, f32)>| {
                    let mut all = [0.0; DEVICE_CONSTANTS];
                    for (to, (_, constant)) in all.iter_mut().zip(constants) {
                        *to = constant;
                    }
                    all
                };
                let off = [0.0; DEVICE_CONSTANTS];
                [$(self.$field.map_or(off, |rule| padded(rule.device_constants(network))),)*]
            }

            /// Numbers of each particle that the kernels of each rule in [`Rule::ALL`] keep within a frame.
            pub fn device_numbers(&self) -> [usize; Rule::ALL.len()] {
                [$(self.$field.map_or(0, |_| <$constants as RuleOperation>::DEVICE_NUMBERS),)*]
            }

            /// The launches of a frame in order, with the rule's place in [`Rule::ALL`].
            pub fn launches(&self, most: &Most) -> Vec<(usize, Launch)> {
                let (mut launches, mut bodies) = (Vec::new(), bodies::launches(most));
                $(if let Some(rule) = &self.$field {
                    let number = Rule::$name as usize;
                    if <$constants as RuleOperation>::NEEDS_BODIES {
                        launches.extend(bodies.drain(..).map(|launch| (number, launch)));
                    }
                    launches.extend(rule.launches(most).into_iter().map(|launch| (number, launch)));
                })*
                launches
            }
        }

        /// Buffers of the rules.
        #[derive(Debug, Default)]
        pub(crate) struct Scratch {
            bodies: Bodies,
            $($field: <$constants as RuleOperation>::Scratch,)*
        }

        /// The correction of one frame in progress.
        pub(crate) struct Correction<'a> {
            observed: Observed<'a>,
            predicted: Predicted<'a>,
            bodies: DisjointSlice<'a, Bodies>,
            $($field: Option<<$constants as RuleOperation>::InFrame<'a>>,)*
        }

        impl Correction<'_> {
            /// Number of items of a stage.
            pub(crate) fn items(&self, stage: Stage) -> usize {
                match stage {
                    Stage::Bodies => 1,
                    $(Stage::Rule(Rule::$name, step) => {
                        self.$field.as_ref().map_or(0, |rule| rule.items(step, &self.observed))
                    })*
                }
            }

            /// Runs an item of a stage. The items of one stage may run at the same time, once each, but not beside those of
            /// another stage.
            #[inline(always)]
            pub(crate) fn run(&self, stage: Stage, item: usize) {
                let Self { observed, predicted, .. } = self;
                match stage {
                    Stage::Bodies => self.find_bodies(),
                    $(Stage::Rule(Rule::$name, step) => {
                        let Some(rule) = &self.$field else { return };
                        rule.run(step, item, observed, self.bodies(), predicted);
                    })*
                }
            }
        }
    };
}

rules! {
    /// Bodies of jelly that nothing else is close to move by their elasticity.
    elastic: Elastic(ElasticRule);
    /// Liquids keep their area.
    area: Area(AreaRule);
    /// Jelly and rope keep their shape.
    shape: Shape(ShapeRule);
    /// Bodies that touch nothing keep momentum and spin.
    flight: Flight(FlightRule);
    /// Bodies that touch a wall and hardly move come to rest.
    rest: Rest(RestRule);
}

/// The struct that the kernels of a rule read their constants from.
fn constants_struct(rule: &str, names: &[&str]) -> String {
    assert!(names.len() <= DEVICE_CONSTANTS, "{} constants of the rule {rule}", names.len());
    match names {
        [] => String::new(),
        names => format!("struct {rule}Constants {{ float {}; }};\n", names.join(", ")),
    }
}

impl fmt::Display for Rule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Rules {
    /// Whether every rule is off.
    pub fn is_empty(&self) -> bool {
        Rule::ALL.into_iter().all(|rule| !self.has(rule))
    }

    /// Switches rules off. Returns those that were on, in the order in which they run.
    pub fn disable(&mut self, rules: &[Rule]) -> Vec<Rule> {
        let mut disabled = Rule::ALL.to_vec();
        disabled.retain(|rule| rules.contains(rule) && self.has(*rule));
        disabled.iter().for_each(|rule| self.remove(*rule));
        disabled
    }

    /// Names and values that the kernels are compiled for.
    pub fn definitions() -> Vec<(&'static str, usize)> {
        vec![
            ("RULES", Rule::ALL.len()),
            ("AREA_MARGIN", AREA_MARGIN),
            ("BODY_NUMBERS", bodies::DEVICE_NUMBERS),
            ("ELASTIC_THREADS", elastic::THREADS),
        ]
    }
}

/// A step of the correction of a frame.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Stage {
    /// Finds the bodies; one item.
    Bodies,
    /// A step of a rule.
    Rule(Rule, usize),
}

/// A frame before its prediction; rows are in the order of the hidden state.
pub(crate) struct Observed<'a> {
    pub(crate) position: &'a [[f32; 2]],
    pub(crate) velocity: &'a [[f32; 2]],
    /// The grid of these particles.
    pub(crate) nodes: &'a Nodes,
    /// The ballistic step in the frame's domain.
    pub(crate) ballistic: Ballistic,
    pub(crate) domain: Domain,
    /// Distance between particles at rest (domain lengths).
    pub(crate) spacing: f32,
    /// The rest shape, by rows.
    pub(crate) rest: &'a RestShape,
    /// The lattices of bodies of jelly, by rows, and what they expect in this frame, then of the coming one.
    pub(crate) lattices: &'a Lattices,
    pub(crate) expected: elastic::ExpectedNodes<'a>,
    /// The frame's particle in each row.
    pub(crate) order: &'a [u32],
}

/// A predicted frame, its particles in the frame's order.
#[derive(Clone, Copy)]
pub(crate) struct Predicted<'a> {
    pub(crate) position: DisjointSlice<'a, [f32; 2]>,
    pub(crate) velocity: DisjointSlice<'a, [f32; 2]>,
    pub(crate) material: &'a [Material],
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
    pub(crate) unsafe fn one(&self, particle: usize) -> (&mut [f32; 2], &mut [f32; 2]) {
        let own = particle..particle + 1;
        // SAFETY: guaranteed by the caller.
        unsafe { (&mut self.position.part(own.clone())[0], &mut self.velocity.part(own)[0]) }
    }
}

impl Correction<'_> {
    fn find_bodies(&self) {
        let Observed { position, velocity, nodes, .. } = &self.observed;
        // SAFETY: this stage has one item.
        let bodies = unsafe { &mut self.bodies.part(0..1)[0] };
        bodies.find(nodes, position, velocity);
    }

    #[inline(always)]
    fn bodies(&self) -> &Bodies {
        // SAFETY: only the stage that finds them writes them, and it does not call this.
        unsafe { &self.bodies.read(0..1)[0] }
    }
}
