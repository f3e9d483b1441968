//! The rules of a checkpoint after the predictions of a device ([`Accelerator`](super::Accelerator)), on the processor: all
//! threads on one stream, or each thread on its own, with the same bits.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use pulp::{Arch, Simd, WithSimd};

use super::{
    Ballistic, HiddenState,
    order::{reorder, spatial_order},
    rules::{self, Correction, Observed, Predicted, RuleSet, Stage},
};
use crate::{
    checkpoint::{Description, GridOptions},
    kernels::{
        nodes::{Nodes, Window},
        rest_shape::RestShape,
    },
};
use eddy_frames::{Domain, Frame, FrameView};
use eddy_threads::{DisjointSlice, Task, ThreadPool};

/// Particles from which on all threads work on a single stream.
const WORTH_WAKING: usize = 500;

/// The rules of a checkpoint, ready to correct.
#[derive(Debug)]
pub(super) struct DeviceRules {
    arch: Arch,
    rules: RuleSet,
    stages: Vec<Stage>,
    ballistic: Ballistic,
    /// The domain in training.
    domain: Domain,
    /// Of the grid on which bodies are found (domain lengths).
    cell_width: f32,
}

/// Buffers for a frame.
#[derive(Debug)]
pub(super) struct Scratch {
    nodes: Nodes,
    /// Positions and velocities in the order of the hidden state.
    state: [Vec<[f32; 2]>; 2],
    rules: rules::Scratch,
}

/// An observed frame and its prediction.
pub(super) struct Observation<'a> {
    pub(super) hidden: &'a HiddenState,
    pub(super) frame: FrameView<'a>,
    pub(super) next: &'a mut Frame,
}

impl DeviceRules {
    /// The rules of the described network; a frame model has none.
    pub(super) fn new(description: &Description) -> Self {
        let rules = RuleSet::new(description);
        let cell_width = |grid: GridOptions| grid.cell_width;
        Self {
            arch: Arch::new(),
            stages: rules.stages(),
            rules,
            ballistic: Ballistic::new(description),
            domain: description.domain,
            cell_width: description.grid.map_or(0.0, cell_width),
        }
    }

    /// Whether there is no rule.
    pub(super) fn is_empty(&self) -> bool {
        self.stages.is_empty()
    }

    /// Number of steps of a correction.
    pub(super) fn stages(&self) -> usize {
        self.stages.len()
    }

    pub(super) fn scratch(&self) -> Scratch {
        Scratch { nodes: Nodes::default(), state: Default::default(), rules: self.rules.scratch() }
    }

    /// The order in which the rules process the particles of a stream that starts with `frame`, and the rest shape in it.
    pub(super) fn places(&self, frame: &Frame, rest: RestShape) -> (Vec<u32>, RestShape) {
        if self.is_empty() {
            return (Vec::new(), RestShape::default());
        }
        let order = spatial_order(frame, self.cell_width);
        let rest = rest.permuted(&order);
        (order, rest)
    }

    /// Corrects predictions; `scratch` has an element for each thread of the pool.
    pub(super) fn correct(
        &self,
        pool: &mut ThreadPool,
        scratch: &mut [Scratch],
        observations: &mut [Observation<'_>],
    ) {
        if self.is_empty() {
            return;
        }
        if let [Observation { hidden, frame, next }] = observations {
            let alone = hidden.particles() < WORTH_WAKING;
            let Scratch { nodes, state, rules } = &mut scratch[0];
            reorder(pool, alone, &hidden.order, frame.particles, state);
            let correction = self.begin((nodes, state, rules), hidden, frame, next);
            let stages = self.stages.iter().map(|&stage| correction.items(stage));
            pool.run(stages, alone, &|Task { stage, item, .. }| {
                self.arch.dispatch(Item(&correction, self.stages[stage], item));
            });
            return;
        }
        let count = observations.len();
        let (observations, scratch) =
            (DisjointSlice::new(observations), DisjointSlice::new(scratch));
        pool.run([count], false, &|Task { item, thread, .. }| {
            // SAFETY: each item runs once, and no two running items have the same thread number.
            let (observation, scratch) = unsafe {
                (
                    &mut observations.part(item..item + 1)[0],
                    &mut scratch.part(thread..thread + 1)[0],
                )
            };
            let Observation { hidden, frame, next } = observation;
            let Scratch { nodes, state, rules } = scratch;
            for list in &mut *state {
                list.resize(hidden.order.len(), [0.0; 2]);
            }
            let [position, velocity] = &mut *state;
            for ((&particle, x), v) in hidden.order.iter().zip(position).zip(velocity) {
                (*x, *v) = frame.particles.motion(particle as usize);
            }
            let correction = self.begin((nodes, state, rules), hidden, frame, next);
            for &stage in &self.stages {
                let items = 0..correction.items(stage);
                items.for_each(|item| self.arch.dispatch(Item(&correction, stage, item)));
            }
        });
    }

    /// The correction of a frame, whose stages are then to be run in order.
    fn begin<'a>(
        &self,
        (nodes, state, scratch): (&'a mut Nodes, &'a [Vec<[f32; 2]>; 2], &'a mut rules::Scratch),
        hidden: &'a HiddenState,
        frame: &FrameView<'_>,
        next: &'a mut Frame,
    ) -> Correction<'a> {
        let Domain { lower, upper } = frame.domain;
        let [position, velocity] = state;
        let window = Window { particles: 0..position.len(), lower, upper };
        nodes.rebuild(position, &[window], self.cell_width);
        let observed = Observed {
            position,
            velocity,
            nodes,
            ballistic: self.ballistic.for_domain(&self.domain, &frame.domain),
            domain: frame.domain,
            rest: &hidden.rest,
            order: &hidden.order,
        };
        let predicted = Predicted {
            position: DisjointSlice::new(&mut next.position),
            velocity: DisjointSlice::new(&mut next.velocity),
            material: &next.material,
        };
        self.rules.begin(scratch, observed, predicted)
    }
}

/// An item of a stage, run with the instructions of this processor.
struct Item<'a>(&'a Correction<'a>, Stage, usize);

impl WithSimd for Item<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) {
        let Self(correction, stage, item) = self;
        correction.run(stage, item);
    }
}
