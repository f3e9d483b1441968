//! Linear layers over tensors.

use burn::tensor::{Device, Gradients, Tensor, TensorData};

use eddy_inference::checkpoint::plan::LinearLayer;

/// A linear layer, y = x W + b.
#[derive(Clone, Debug)]
pub(crate) struct Linear {
    /// W, `[in, out]`: the transpose of a checkpoint's.
    pub(crate) weight: Tensor<2>,
    /// b, `[out]`, or fewer where outputs share one.
    pub(crate) bias: Tensor<1>,
}

impl Linear {
    /// A layer with this matrix, `[in, out]`, and bias on `device`. With autodiff, gradients by both are recorded.
    pub(crate) fn new(
        layer: &LinearLayer,
        [weight, bias]: &[Vec<f32>; 2],
        device: &Device,
    ) -> Self {
        let weight = TensorData::new(weight.clone(), [layer.input, layer.output]);
        let bias = TensorData::new(bias.clone(), [bias.len()]);
        let (weight, bias) = (Tensor::from_data(weight, device), Tensor::from_data(bias, device));
        match device.is_autodiff() {
            true => Self { weight: weight.require_grad(), bias: bias.require_grad() },
            false => Self { weight, bias },
        }
    }

    /// `[R, in]` to `[R, out]`.
    pub(crate) fn forward(&self, input: Tensor<2>) -> Tensor<2> {
        let Self { weight, bias } = self.clone();
        input.matmul(weight) + bias.unsqueeze()
    }

    /// The gradients by matrix and bias; empty if the loss does not depend on them.
    pub(crate) fn gradients(&self, gradients: &mut Gradients) -> [Vec<f32>; 2] {
        [gradient(&self.weight, gradients), gradient(&self.bias, gradients)]
    }
}

fn gradient<const D: usize>(tensor: &Tensor<D>, gradients: &mut Gradients) -> Vec<f32> {
    tensor.grad_remove(gradients).map_or_else(Vec::new, |gradient| {
        gradient.into_data().try_to_vec().expect("weights and their gradients are f32")
    })
}
