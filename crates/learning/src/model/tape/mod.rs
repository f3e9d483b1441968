//! The operations of a network on plain lists, with their gradients: what training on processors computes. The operations are those of
//! [`ops`](eddy_inference::ops); here they get their lists, in the order of the plan.
//!
//! 1. `particles`: operations on particles, up to their encodings, and the step to the next frame.
//! 2. `nodes`: those on nodes.
//! 3. `core`: linear layers and cells.

mod core;
mod nodes;
mod particles;

use std::ops::Range;

use super::{described::Model, grid_context::GridContext, state::StaticInputs};
use eddy_inference::{
    checkpoint::plan::{Kind, Operation, POSITION},
    ops::cell::recurrent,
};

use self::{
    core::{CellOperation, LinearOperation},
    nodes::{Convolve, ToNodes, ToParticles},
    particles::{Advance, Expect, FeaturesOfFrames, FeaturesOfParticles, Max, MeanOfLinear},
};

/// Some frames of some windows, and the weights that compute them.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pass<'a> {
    pub(crate) model: &'a Model,
    /// In the order of the plan, matrices as `[in, out]`.
    pub(crate) weights: &'a [Vec<f32>],
    pub(crate) fixed: &'a StaticInputs,
    /// T.
    pub(crate) frames: usize,
    /// Factors of dropout of each layer of the core, `[T R, H]`; none without dropout.
    pub(crate) masks: &'a [Vec<f32>],
    /// Those of the plan's operations that are computed.
    pub(crate) operations: &'a Range<usize>,
}

/// What a pass computes and keeps for the gradients.
#[derive(Debug)]
pub(crate) struct Tape {
    /// The plan's lists of all frames, `[T .., width]`.
    pub(crate) lists: Vec<Vec<f32>>,
    /// The states of the core before the first frame, `[L R, S H]`.
    before: Vec<f32>,
    /// Those after the last frame.
    pub(crate) after: Vec<f32>,
    /// The nodes around the particles of all frames, of a particle model.
    grid: Option<GridContext>,
    /// What operations keep beside their lists.
    kept: Vec<Kept>,
}

/// What an operation keeps for its gradient beside its lists.
#[derive(Debug)]
enum Kept {
    /// Numbers that it knows the meaning of.
    Numbers(Vec<f32>),
    /// States of a cell whose sums depend on the last output.
    States(recurrent::States),
}

impl Kept {
    const NOTHING: Self = Self::Numbers(Vec::new());

    fn numbers(&self) -> &[f32] {
        match self {
            Self::Numbers(numbers) | Self::States(recurrent::States { states: numbers, .. }) => {
                numbers
            }
        }
    }
}

/// Gradients on their way back.
#[derive(Debug)]
pub(crate) struct Gradients<'a> {
    /// By each list; empty where there is none yet.
    pub(crate) lists: Vec<Vec<f32>>,
    /// By the states after the last frame, which those by the states before the first one replace.
    pub(crate) states: Vec<f32>,
    /// By the weights; added to.
    pub(crate) weights: &'a mut [Vec<f32>],
}

/// An operation with all but what it reads.
trait Operate {
    /// Its list, and what the gradient needs beside it. What it reads are its lists, followed by the weights of its layer, if it has
    /// one, and by the last state, if it has one.
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept);

    /// The gradient by each thing that it reads. Those that are not wanted may be empty.
    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>>;
}

/// What the gradients of an operation are computed from.
struct Backward<'a> {
    /// As in [`Operate::forward`].
    read: &'a [&'a [f32]],
    /// What it wrote.
    written: &'a [f32],
    kept: &'a Kept,
    /// The gradient by what it wrote.
    gradient: &'a [f32],
    /// Whether the gradient by each thing that it reads is wanted.
    wanted: &'a [bool],
}

/// As many things as an operation reads.
fn exactly<T: Copy, const N: usize>(read: &[T]) -> [T; N] {
    read.try_into().unwrap_or_else(|_| unreachable!("found {} lists, expected {N}", read.len()))
}

impl Pass<'_> {
    /// Computes the operations from the lists that are given, by number, and from the states of the core before the first frame.
    pub(crate) fn forward(
        &self,
        given: impl IntoIterator<Item = (usize, Vec<f32>)>,
        states: Vec<f32>,
    ) -> Tape {
        let mut lists = vec![Vec::new(); self.model.plan.lists.len()];
        given.into_iter().for_each(|(list, numbers)| lists[list] = numbers);
        let position = lists[POSITION].as_chunks().0;
        let grid = self.model.grid(position, self.fixed, self.frames);
        let mut tape = Tape { lists, before: states, after: Vec::new(), grid, kept: Vec::new() };
        for operation in self.operations() {
            let operate = self.operate(operation, tape.grid.as_ref(), &[]);
            let (list, kept) = operate.forward(&self.read(operation, &tape));
            if let Some(state) = self.state(operation, &tape.before) {
                tape.after.extend_from_slice(&kept.numbers()[kept.numbers().len() - state.len()..]);
            }
            drop(operate);
            tape.lists[operation.writes] = list;
            tape.kept.push(kept);
        }
        tape
    }

    /// Adds the gradients through all that [`Pass::forward`] computed to `by`, which has those by what is used elsewhere. Of the given
    /// lists, it computes those that are `wanted`.
    pub(crate) fn backward(&self, tape: &Tape, wanted: &[usize], by: &mut Gradients<'_>) {
        // What depends on weights or on a wanted list needs a gradient.
        let mut needed = vec![false; tape.lists.len()];
        wanted.iter().for_each(|&list| needed[list] = true);
        for one @ Operation { kind, reads, writes } in self.operations() {
            let has_own = kind.layer().is_some() || self.state(one, &tape.before).is_some();
            needed[*writes] = has_own || reads.iter().any(|&list| needed[list]);
        }
        for (operation, kept) in self.operations().iter().zip(&tape.kept).rev() {
            let Operation { kind, reads, writes } = operation;
            let gradient = std::mem::take(&mut by.lists[*writes]);
            let after = self.state(operation, &by.states).unwrap_or_default();
            if !needed[*writes] || gradient.is_empty() && after.is_empty() {
                continue;
            }
            let read = self.read(operation, tape);
            let mut wanted: Vec<_> = reads.iter().map(|&list| needed[list]).collect();
            wanted.resize(read.len(), true);
            let operate = self.operate(operation, tape.grid.as_ref(), after);
            let written = &tape.lists[*writes];
            let (read, gradient, wanted) = (&read, &gradient, &wanted);
            let own = operate.backward(&Backward { read, written, kept, gradient, wanted });
            drop(operate);
            assert_eq!(own.len(), read.len(), "a gradient for each thing that is read");
            let mut own = own.into_iter();
            for (&list, own) in reads.iter().zip(own.by_ref()) {
                add(&mut by.lists[list], own);
            }
            for (tensor, own) in kind.layer().into_iter().flat_map(tensors).zip(own.by_ref()) {
                add(&mut by.weights[tensor], own);
            }
            if let (Kind::Cell { number, .. }, Some(own)) = (kind, own.next()) {
                let first = number * own.len();
                by.states[first..first + own.len()].copy_from_slice(&own);
            }
        }
    }

    fn operations(&self) -> &[Operation] {
        &self.model.plan.operations[self.operations.clone()]
    }

    /// What an operation reads.
    fn read<'t>(&'t self, operation: &Operation, tape: &'t Tape) -> Vec<&'t [f32]> {
        let lists = operation.reads.iter().map(|&list| tape.lists[list].as_slice());
        let layer = operation.kind.layer().into_iter().flat_map(tensors);
        let weights = layer.map(|tensor| self.weights[tensor].as_slice());
        lists.chain(weights).chain(self.state(operation, &tape.before)).collect()
    }

    /// The part of a cell's layer in the states of the core.
    fn state<'t>(&self, operation: &Operation, states: &'t [f32]) -> Option<&'t [f32]> {
        let Kind::Cell { number, .. } = operation.kind else { return None };
        let length = states.len() / self.model.description.sizes.layers;
        Some(&states[number * length..(number + 1) * length])
    }

    /// An operation; of a cell, with the gradient by the state `after` the last frame, if there is one.
    fn operate<'t>(
        &'t self,
        operation: &'t Operation,
        grid: Option<&'t GridContext>,
        after: &'t [f32],
    ) -> Box<dyn Operate + 't> {
        let Self { model, fixed, .. } = *self;
        let grid = || grid.expect("networks with operations on nodes have a grid");
        let particles = fixed.particles();
        match operation.kind {
            Kind::Expect => Box::new(Expect(&model.ballistic)),
            Kind::ParticleFeatures => {
                Box::new(FeaturesOfParticles { features: &model.features, fixed })
            }
            Kind::FrameFeatures => {
                Box::new(FeaturesOfFrames { features: &model.frame_features, fixed })
            }
            Kind::Linear { activation, .. } => {
                let width = model.plan.lists[operation.reads[0]].width;
                Box::new(LinearOperation { activation, width })
            }
            Kind::MeanOfLinear { activation, .. } => {
                Box::new(MeanOfLinear { activation, particles })
            }
            Kind::Max => {
                let width = model.plan.lists[operation.writes].width;
                Box::new(Max { particles, width })
            }
            Kind::ToNodes => Box::new(ToNodes(grid())),
            Kind::ToParticles => Box::new(ToParticles(&grid().nodes)),
            Kind::Convolution { grid: ref layer, .. } => {
                Box::new(Convolve { nodes: &grid().nodes, layer })
            }
            Kind::Cell { number, .. } => {
                let mask = self.masks.get(number).map(Vec::as_slice);
                let width = model.description.sizes.hidden;
                Box::new(CellOperation { cell: model.cell, width, mask, after })
            }
            Kind::Advance => Box::new(Advance(model)),
        }
    }
}

/// The numbers of a layer's weights.
fn tensors(layer: usize) -> [usize; 2] {
    [2 * layer, 2 * layer + 1]
}

/// Adds to a gradient, which is empty where there was none.
fn add(sum: &mut Vec<f32>, more: Vec<f32>) {
    if sum.is_empty() {
        *sum = more;
    } else if !more.is_empty() {
        assert_eq!(sum.len(), more.len(), "gradients by the same list");
        sum.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
    }
}
