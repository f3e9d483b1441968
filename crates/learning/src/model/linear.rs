//! Linear layers, and their weights as lists.

use std::collections::BTreeMap;

use burn::tensor::{Device, Gradients, Tensor, TensorData, activation::relu};

use super::{fused, fused_layers};
use eddy_inference::checkpoint::Weights;

/// y = x W + b.
#[derive(Clone, Debug)]
pub(crate) struct Linear {
    /// W, `[in, out]`.
    pub(crate) weight: Tensor<2>,
    /// b, `[out]`.
    pub(crate) bias: Tensor<1>,
}

impl Linear {
    /// The layer with the named tensors, on `device`. With autodiff, gradients by both are recorded.
    pub(crate) fn from_weights(
        [weight, bias]: &[String; 2],
        tensors: &BTreeMap<String, Weights>,
        device: &Device,
    ) -> Self {
        let data = |name: &String| {
            let weights = &tensors[name];
            TensorData::new(weights.values.clone(), weights.shape.clone())
        };
        let plain = Tensor::<2>::from_data(data(weight), device).transpose();
        // Copied to the new order, which makes the products' access contiguous.
        let weight = Tensor::from_data(plain.into_data(), device);
        let bias = Tensor::from_data(data(bias), device);
        if device.is_autodiff() {
            Self { weight: weight.require_grad(), bias: bias.require_grad() }
        } else {
            Self { weight, bias }
        }
    }

    /// `[.., in]` to `[.., out]`.
    pub(crate) fn forward<const D: usize>(&self, input: Tensor<D>) -> Tensor<D> {
        // As one matrix: the gradient of a batched product would be batched too.
        let mut shape = input.dims();
        let [width, outputs] = self.weight.dims();
        let rows = shape.iter().product::<usize>() / width;
        let input = input.reshape([rows, width]);
        let Self { weight, bias } = self.clone();
        let output = if fused::runs_on(&weight.device()) {
            fused_layers::linear(false, input, weight, bias)
        } else {
            input.matmul(weight) + bias.unsqueeze()
        };
        shape[D - 1] = outputs;
        output.reshape(shape)
    }

    /// As [`Linear::forward`], with ReLU: `[R, in]` to `[R, out]`.
    pub(crate) fn rectified(&self, input: Tensor<2>) -> Tensor<2> {
        let Self { weight, bias } = self.clone();
        if fused::runs_on(&weight.device()) {
            fused_layers::linear(true, input, weight, bias)
        } else {
            relu(input.matmul(weight) + bias.unsqueeze())
        }
    }

    /// Calls `change` with number, values and gradient of each tensor: 2 `index` for the weight, 2 `index` + 1 for the bias. A
    /// tensor without a gradient is left unchanged.
    pub(crate) fn update(
        &mut self,
        index: usize,
        gradients: &mut Gradients,
        change: &mut impl FnMut(usize, &mut [f32], &[f32]),
    ) {
        update(&mut self.weight, gradients, |values, by| change(2 * index, values, by));
        update(&mut self.bias, gradients, |values, by| change(2 * index + 1, values, by));
    }

    /// As [`Linear::rectified`], for two concatenated inputs, `[R, I]` and `[R, J]`.
    pub(crate) fn concatenated(&self, left: Tensor<2>, right: Tensor<2>) -> Tensor<2> {
        let Self { weight, bias } = self.clone();
        if fused::runs_on(&weight.device()) {
            return fused_layers::concatenated([left, right], weight, bias);
        }
        self.rectified(Tensor::cat(vec![left, right], 1))
    }
}

pub(crate) fn gradient<const D: usize>(tensor: &Tensor<D>, gradients: &mut Gradients) -> Vec<f32> {
    tensor.grad_remove(gradients).map_or_else(Vec::new, |gradient| {
        gradient.into_data().try_to_vec().expect("weights and their gradients are f32")
    })
}

/// Changes the values of a tensor that has a gradient.
fn update<const D: usize>(
    tensor: &mut Tensor<D>,
    gradients: &mut Gradients,
    change: impl FnOnce(&mut [f32], &[f32]),
) {
    let Some(gradient) = tensor.grad_remove(gradients) else { return };
    let gradient = gradient.into_data();
    let numbers = "weights and their gradients are f32";
    exchange(tensor, |values| change(values, gradient.as_slice().expect(numbers)));
}

/// Changes the values of a tensor, without a copy if it is not shared.
pub(crate) fn exchange<const D: usize>(tensor: &mut Tensor<D>, change: impl FnOnce(&mut [f32])) {
    let device = tensor.device();
    let empty = Tensor::empty([0; D], &device);
    let mut values = std::mem::replace(tensor, empty).inner().into_data();
    change(values.as_mut_slice().expect("weights are f32"));
    *tensor = Tensor::from_data(values, &device).require_grad();
}

/// The values of a tensor on any device.
pub(crate) fn weights<const D: usize>(tensor: Tensor<D>) -> Weights {
    let shape = tensor.dims().to_vec();
    let values = tensor.inner().into_data().iter::<f32>().collect();
    Weights { shape, values }
}
