//! The networks on the flex device with gradients: burn records all operations of some frames as one, which the [`tape`](super::tape)
//! computes on plain lists. Tensor operations would pass over memory for each step of a sum.

use std::{
    ops::Range,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
};

use burn::{
    backend::{
        Autodiff, BackendTensor, DispatchKindConversion, DispatchTensor, Flex, TensorMetadata as _,
        autodiff::{
            checkpoint::{base::Checkpointer, strategy::NoCheckpointing},
            grads,
            ops::{Backward, Ops, OpsKind},
        },
        flex::FlexTensor,
    },
    tensor::{Device, Tensor, TensorData},
};

use super::{
    described::{Inputs, Model, Outputs},
    state::StaticInputs,
    tape::{Gradients, Pass, Tape},
};
use eddy_inference::checkpoint::plan::{EXPECTED, POSITION, VELOCITY};

type Recording = Autodiff<Flex>;

/// A network for passes that burn records.
#[derive(Clone, Debug)]
pub(crate) struct Recorded {
    weights: TapeWeights,
    /// A number with a gradient that nobody reads: burn records operations of which an input has one.
    anchor: Tensor<1>,
}

/// A network's weights in the order of the plan, and their gradients, which burn does not know.
#[derive(Clone, Debug)]
struct TapeWeights {
    values: Arc<Vec<Vec<f32>>>,
    /// Empty where there is none.
    gradients: Arc<Mutex<Vec<Vec<f32>>>>,
}

impl TapeWeights {
    fn gradients(&self) -> MutexGuard<'_, Vec<Vec<f32>>> {
        self.gradients.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl Recorded {
    /// With weights in the order of the plan.
    pub(crate) fn new(values: Arc<Vec<Vec<f32>>>, device: &Device) -> Self {
        let gradients = Arc::new(Mutex::new(vec![Vec::new(); values.len()]));
        let anchor = Tensor::zeros([1], device).require_grad();
        Self { weights: TapeWeights { values, gradients }, anchor }
    }

    /// The gradients by the weights since the last call, in their order; empty if nothing depends on them.
    pub(crate) fn gradients(&self) -> Vec<Vec<f32>> {
        self.weights.gradients().iter_mut().map(std::mem::take).collect()
    }

    /// All operations.
    pub(crate) fn run(&self, model: &Arc<Model>, inputs: Inputs) -> Outputs {
        let Inputs { frames, position, velocity, expected, states, fixed, masks } = inputs;
        let (plan, [rows, _]) = (&model.plan, position.dims());
        let [layers, columns] = states.dims();
        let exits: Vec<usize> = [plan.next()].into_iter().chain(plan.expected_next()).collect();
        let operation = Frames {
            model: Arc::clone(model),
            weights: self.weights.clone(),
            fixed,
            frames,
            masks: masks.into(),
            operations: 0..plan.operations.len(),
            entries: vec![POSITION, VELOCITY, EXPECTED],
            exits: exits.clone(),
        };
        let [position, velocity, expected, states] =
            [position, velocity, expected, states].map(input);
        let anchor = input(self.anchor.clone());
        let all = operation.apply([anchor, position, velocity, expected, states]);
        let mut first = 0;
        let mut part = |shape: [usize; 2]| {
            let begin = first;
            first += shape[0] * shape[1];
            all.clone().slice(begin..first).reshape(shape)
        };
        let next = part([rows, 4]);
        let expected = (exits.len() > 1).then(|| part([rows, 2]));
        Outputs { next, expected, states: part([layers, columns]) }
    }

    /// The core alone, from a zero state.
    pub(crate) fn core(&self, model: &Arc<Model>, encodings: Tensor<3>) -> Tensor<3> {
        let [frames, rows, width] = encodings.dims();
        let shape = model.state_shape(rows);
        let operation = Frames {
            model: Arc::clone(model),
            weights: self.weights.clone(),
            fixed: StaticInputs::new(&[], &[], 1, None, None),
            frames,
            masks: Arc::default(),
            operations: model.plan.core.clone(),
            entries: model.plan.core_inputs().to_vec(),
            exits: vec![model.plan.core_output()],
        };
        let states = Tensor::<2>::zeros(shape, &encodings.device());
        let encodings = encodings.reshape([frames * rows, width]);
        let all = operation.apply([input(self.anchor.clone()), input(encodings), input(states)]);
        let shape = [frames, rows, model.description.sizes.hidden];
        all.slice(0..shape.iter().product()).reshape(shape)
    }
}

/// A tensor for [`Frames::apply`].
fn input<const D: usize>(tensor: Tensor<D>) -> DispatchTensor {
    tensor.autodiff().into_dispatch()
}

/// A pass over some of a network's operations. It has no tensors: burn keeps it until gradients are computed.
#[derive(Clone, Debug)]
struct Frames {
    model: Arc<Model>,
    weights: TapeWeights,
    fixed: Arc<StaticInputs>,
    /// T.
    frames: usize,
    masks: Arc<[Vec<f32>]>,
    operations: Range<usize>,
    /// Lists that are given.
    entries: Vec<usize>,
    /// Lists that are wanted.
    exits: Vec<usize>,
}

impl Frames {
    fn pass(&self) -> Pass<'_> {
        let Self { model, weights, fixed, frames, masks, operations, .. } = self;
        let weights = &weights.values;
        Pass { model, weights, fixed, frames: *frames, masks, operations }
    }

    /// The lists that are wanted and the states after the last frame, one behind another. The inputs are the anchor, the lists that are
    /// given, and the states before the first frame.
    fn apply<const N: usize>(self, inputs: [DispatchTensor; N]) -> Tensor<1> {
        let inputs = inputs.map(|tensor| {
            match <DispatchTensor as DispatchKindConversion<Recording>>::try_into_backend(tensor) {
                Ok(BackendTensor::Float(tensor)) => tensor,
                other => {
                    unreachable!("expected floats on the flex device with autodiff: {other:?}")
                }
            }
        });
        let nodes = inputs.each_ref().map(|tensor| tensor.node());
        let inputs = inputs.map(|tensor| tensor.into_primitive().to_contiguous());
        let lists = inputs.each_ref().map(numbers);
        let [_, given @ .., states] = lists.as_slice() else {
            unreachable!("the anchor and the states are inputs")
        };
        let given = self.entries.iter().copied().zip(given.iter().map(|list| list.to_vec()));
        let tape = self.pass().forward(given, states.to_vec());
        let lists = self.exits.iter().map(|&list| tape.lists[list].as_slice());
        let values: Vec<f32> = lists.chain([tape.after.as_slice()]).flatten().copied().collect();
        let shape = [values.len()];
        let values = FlexTensor::from_data(TensorData::new(values, shape));
        let shapes = inputs.each_ref().map(|tensor| tensor.shape().to_vec());
        let preparation = self.prepare::<NoCheckpointing>(nodes).compute_bound().stateful();
        let output = match preparation {
            OpsKind::Tracked(preparation) => preparation.finish((Arc::new(tape), shapes), values),
            OpsKind::UnTracked(preparation) => preparation.finish(values),
        };
        let output = BackendTensor::<Recording>::Float(output);
        Tensor::from_dispatch(DispatchTensor::from_backend(output))
    }
}

/// The numbers of a tensor.
fn numbers(tensor: &FlexTensor) -> &[f32] {
    tensor.as_slice().expect("made contiguous; networks compute in f32")
}

impl<const N: usize> Backward<Flex, N> for Frames {
    /// What the forward pass kept, and the shapes of the inputs.
    type State = (Arc<Tape>, [Vec<usize>; N]);

    fn backward(
        self,
        ops: Ops<Self::State, N>,
        gradients: &mut grads::Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let (tape, shapes) = ops.state;
        let gradient = gradients.consume::<Flex>(&ops.node).to_contiguous();
        let mut gradient = numbers(&gradient);
        let mut lists = vec![Vec::new(); tape.lists.len()];
        for &list in &self.exits {
            let (own, rest) = gradient.split_at(tape.lists[list].len());
            lists[list] = own.to_vec();
            gradient = rest;
        }
        let given = self.entries.iter().zip(&ops.parents[1..]);
        let wanted: Vec<_> =
            given.filter(|(_, parent)| parent.is_some()).map(|(&list, _)| list).collect();
        let mut weights = self.weights.gradients();
        let mut by = Gradients { lists, states: gradient.to_vec(), weights: &mut weights };
        self.pass().backward(&tape, &wanted, &mut by);
        let Gradients { mut lists, states, .. } = by;
        let given = self.entries.iter().map(|&list| std::mem::take(&mut lists[list]));
        let anchor = vec![0.0];
        let all = [anchor].into_iter().chain(given).chain([states]);
        for ((parent, mut by), shape) in ops.parents.iter().zip(all).zip(shapes) {
            if let Some(parent) = parent {
                by.resize(shape.iter().product(), 0.0); // no gradient where nothing depends on a list
                let by = FlexTensor::from_data(TensorData::new(by, shape));
                gradients.register::<Flex>(parent.id, by);
            }
        }
    }
}
