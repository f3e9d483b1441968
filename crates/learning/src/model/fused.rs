//! Operations whose values and gradients are computed by loops over plain lists instead of a sequence of tensor operations,
//! each of which would pass over memory.
//!
//! They run where gradients are recorded on the flex device. On other devices, and without gradients, equivalent tensor
//! operations run; tests compare the two.

use burn::{
    backend::{
        Autodiff, BackendTensor, DispatchKindConversion, DispatchTensor, Flex, TensorMetadata as _,
        autodiff::{
            checkpoint::{base::Checkpointer, strategy::NoCheckpointing},
            grads::Gradients,
            ops::{Backward, Ops, OpsKind},
        },
        flex::FlexTensor,
    },
    tensor::{Device, Tensor, TensorData},
};

/// An operation on N inputs with its gradients.
pub(crate) trait Operation<const N: usize>:
    Clone + std::fmt::Debug + Send + 'static
{
    /// Intermediate results kept for the gradients, beside inputs and values.
    type Kept: Clone + std::fmt::Debug + Send + 'static;

    /// The values.
    fn forward(&self, inputs: [&[f32]; N]) -> (Vec<f32>, Self::Kept);

    /// The gradients by the inputs, of their lengths; those that are not `wanted` are arbitrary.
    fn backward(
        &self,
        inputs: [&[f32]; N],
        values: &[f32],
        kept: Self::Kept,
        gradient: &[f32],
        wanted: [bool; N],
    ) -> [Vec<f32>; N];
}

/// Whether fused operations run on this device.
pub(crate) fn runs_on(device: &Device) -> bool {
    device.is_autodiff() && *device == Device::flex()
}

/// The operation's values with the given shape, on a device for which [`runs_on`] is true.
pub(crate) fn apply<const N: usize, const D: usize, O: Operation<N>>(
    operation: O,
    inputs: [DispatchTensor; N],
    shape: [usize; D],
) -> Tensor<D> {
    let inputs = inputs.map(|tensor| {
        match <DispatchTensor as DispatchKindConversion<Recorded>>::try_into_backend(tensor) {
            Ok(BackendTensor::Float(tensor)) => tensor,
            other => {
                unreachable!("expected a float tensor on the flex device with autodiff: {other:?}")
            }
        }
    });
    let nodes = inputs.each_ref().map(|tensor| tensor.node());
    let inputs = inputs.map(|tensor| tensor.into_primitive().to_contiguous());
    let (values, kept) = operation.forward(inputs.each_ref().map(numbers));
    let values = FlexTensor::from_data(TensorData::new(values, shape));
    let preparation = Step(operation).prepare::<NoCheckpointing>(nodes).compute_bound().stateful();
    let output = match preparation {
        OpsKind::Tracked(preparation) => {
            let state = Kept { inputs, values: values.clone(), kept };
            preparation.finish(state, values)
        }
        OpsKind::UnTracked(preparation) => preparation.finish(values),
    };
    let output = BackendTensor::<Recorded>::Float(output);
    Tensor::from_dispatch(DispatchTensor::from_backend(output))
}

/// Converts a tensor to an input.
pub(crate) fn input<const D: usize>(tensor: Tensor<D>) -> DispatchTensor {
    tensor.autodiff().into_dispatch()
}

type Recorded = Autodiff<Flex>;

fn numbers(tensor: &FlexTensor) -> &[f32] {
    tensor.as_slice().expect("made contiguous; networks compute in f32")
}

#[derive(Debug)]
struct Step<O>(O);

#[derive(Clone, Debug)]
struct Kept<const N: usize, K> {
    inputs: [FlexTensor; N],
    values: FlexTensor,
    kept: K,
}

impl<const N: usize, O: Operation<N>> Backward<Flex, N> for Step<O> {
    type State = Kept<N, O::Kept>;

    fn backward(
        self,
        ops: Ops<Self::State, N>,
        gradients: &mut Gradients,
        _checkpointer: &mut Checkpointer,
    ) {
        let Kept { inputs, values, kept } = ops.state;
        let gradient = gradients.consume::<Flex>(&ops.node).to_contiguous();
        let wanted = ops.parents.each_ref().map(Option::is_some);
        let slices = inputs.each_ref().map(numbers);
        let by = self.0.backward(slices, numbers(&values), kept, numbers(&gradient), wanted);
        for ((parent, by), input) in ops.parents.into_iter().zip(by).zip(&inputs) {
            if let Some(parent) = parent {
                let by = FlexTensor::from_data(TensorData::new(by, input.shape()));
                gradients.register::<Flex>(parent.id, by);
            }
        }
    }
}
