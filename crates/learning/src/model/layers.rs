//! The linear layers both networks are made of: weights in, weights out, weights changed by an optimizer.

use std::collections::BTreeMap;

use burn::tensor::{Device, Gradients, Tensor, TensorData, activation::relu};

use super::{core::RecurrentLayer, fused, grid::GridLayers, training};
use eddy_inference::checkpoint::{Description, Weights, layout};

/// y = x W + b.
#[derive(Clone, Debug)]
pub(crate) struct Linear {
    /// W, `[in, out]`.
    pub(crate) weight: Tensor<2>,
    /// b, `[out]`.
    pub(crate) bias: Tensor<1>,
}

impl Linear {
    /// `[.., in]` to `[.., out]`.
    pub(crate) fn forward<const D: usize>(&self, input: Tensor<D>) -> Tensor<D> {
        // As one matrix: the gradient of a product with a stack of matrices would be a stack.
        let mut shape = input.dims();
        let [width, outputs] = self.weight.dims();
        let rows = shape.iter().product::<usize>() / width;
        let input = input.reshape([rows, width]);
        let Self { weight, bias } = self.clone();
        let output = if fused::runs_on(&weight.device()) {
            training::linear(false, input, weight, bias)
        } else {
            input.matmul(weight) + bias.unsqueeze()
        };
        shape[D - 1] = outputs;
        output.reshape(shape)
    }

    /// The same with a ReLU behind it, `[R, in]` to `[R, out]`.
    pub(crate) fn rectified(&self, input: Tensor<2>) -> Tensor<2> {
        let Self { weight, bias } = self.clone();
        if fused::runs_on(&weight.device()) {
            training::linear(true, input, weight, bias)
        } else {
            relu(input.matmul(weight) + bias.unsqueeze())
        }
    }

    /// Changes both tensors of a network's layer number `index` as [`Layers::update`] does.
    pub(crate) fn update(
        &mut self,
        index: usize,
        gradients: &mut Gradients,
        change: &mut impl FnMut(usize, &mut [f32], &[f32]),
    ) {
        update(&mut self.weight, gradients, |values, by| change(2 * index, values, by));
        update(&mut self.bias, gradients, |values, by| change(2 * index + 1, values, by));
    }

    /// The same for inputs that are side by side, `[R, I]` and `[R, J]`.
    pub(crate) fn beside(&self, left: Tensor<2>, right: Tensor<2>) -> Tensor<2> {
        let Self { weight, bias } = self.clone();
        if fused::runs_on(&weight.device()) {
            return training::beside([left, right], weight, bias);
        }
        self.rectified(Tensor::cat(vec![left, right], 1))
    }
}

/// All learned numbers of a network.
#[derive(Clone, Debug)]
pub(crate) struct Layers {
    /// `encoder.0`, `encoder.1`.
    pub(crate) encoder: [Linear; 2],
    /// `grid.*` and `context`; only the particle model has them.
    pub(crate) grid: Option<GridLayers>,
    /// The core's layers, in order.
    pub(crate) core: Vec<RecurrentLayer>,
    /// `mixer`.
    pub(crate) mixer: Linear,
    /// `decoder`.
    pub(crate) decoder: Linear,
}

impl Layers {
    /// Puts the layers together from tensors that fit the description, on `device`. With autodiff,
    /// gradients by all of them are recorded.
    pub(crate) fn new(
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
        device: &Device,
    ) -> Self {
        let linear = |names: [String; 2]| linear(&names, tensors, device);
        Self {
            encoder: ["encoder.0", "encoder.1"].map(|layer| linear(layout::names(layer))),
            grid: description.grid.as_ref().map(|grid| GridLayers {
                grid: layout::grid_layers(grid).map(|(layer, ..)| linear(layout::names(layer))),
                context: linear(layout::names("context")),
            }),
            core: (0..description.sizes.layers)
                .map(|layer| {
                    RecurrentLayer::new(description, |part| {
                        linear(layout::core_names(description.core, layer, part))
                    })
                })
                .collect(),
            mixer: linear(layout::names("mixer")),
            decoder: linear(layout::names("decoder")),
        }
    }

    /// The weights by name, as checkpoints hold them.
    pub(crate) fn tensors(&self, description: &Description) -> BTreeMap<String, Weights> {
        let named = layout::linear_layers(description).into_iter().zip(self.linears());
        named
            .flat_map(|(layer, linear)| {
                let weight = numbers(linear.weight.clone().transpose()); // [out, in]
                [(layer.weight, weight), (layer.bias, numbers(linear.bias.clone()))]
            })
            .collect()
    }

    /// Every linear layer, from input to output: the order of [`layout::linear_layers`].
    pub(crate) fn linears(&self) -> Vec<&Linear> {
        let grid =
            self.grid.iter().flat_map(|GridLayers { grid, context }| grid.iter().chain([context]));
        let core = self.core.iter().flat_map(RecurrentLayer::parts);
        let ends = [&self.mixer, &self.decoder];
        self.encoder.iter().chain(grid).chain(core).chain(ends).collect()
    }

    fn linears_mut(&mut self) -> Vec<&mut Linear> {
        let grid = self.grid.iter_mut();
        let grid = grid.flat_map(|GridLayers { grid, context }| grid.iter_mut().chain([context]));
        let core = self.core.iter_mut().flat_map(RecurrentLayer::parts_mut);
        let ends = [&mut self.mixer, &mut self.decoder];
        self.encoder.iter_mut().chain(grid).chain(core).chain(ends).collect()
    }

    /// Changes every tensor, matrix (`[in, out]`) before bias in the order of [`Layers::linears`]:
    /// `change` gets the tensor's number in that order, its values and its gradient. A tensor that the
    /// loss does not depend on has no gradient and is left as it is.
    pub(crate) fn update(
        &mut self,
        gradients: &mut Gradients,
        mut change: impl FnMut(usize, &mut [f32], &[f32]),
    ) {
        for (index, linear) in self.linears_mut().into_iter().enumerate() {
            linear.update(index, gradients, &mut change);
        }
    }

    /// The same values, with gradients of their own.
    pub(crate) fn apart(&self) -> Self {
        let mut layers = self.clone();
        for Linear { weight, bias } in layers.linears_mut() {
            *weight = Tensor::from_inner(weight.clone().inner()).require_grad();
            *bias = Tensor::from_inner(bias.clone().inner()).require_grad();
        }
        layers
    }

    /// The gradient by every tensor, in the order of [`Layers::update`]; empty where there is none.
    pub(crate) fn gradients(&self, gradients: &mut Gradients) -> Vec<Vec<f32>> {
        let mut all = Vec::new();
        for Linear { weight, bias } in self.linears() {
            all.push(gradient(weight, gradients));
            all.push(gradient(bias, gradients));
        }
        all
    }

    /// Looks at every tensor in the order of [`Layers::update`], and may put other values in its place.
    pub(crate) fn exchange(&mut self, mut change: impl FnMut(usize, &mut [f32])) {
        for (index, linear) in self.linears_mut().into_iter().enumerate() {
            exchange(&mut linear.weight, |values| change(2 * index, values));
            exchange(&mut linear.bias, |values| change(2 * index + 1, values));
        }
    }
}

fn gradient<const D: usize>(tensor: &Tensor<D>, gradients: &mut Gradients) -> Vec<f32> {
    tensor.grad_remove(gradients).map_or_else(Vec::new, |gradient| {
        gradient.into_data().try_to_vec().expect("weights and their gradients are f32")
    })
}

/// Changes a tensor that has a gradient.
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

/// Puts other values in a tensor's place, without a copy where nobody else holds it.
fn exchange<const D: usize>(tensor: &mut Tensor<D>, change: impl FnOnce(&mut [f32])) {
    let device = tensor.device();
    let empty = Tensor::empty([0; D], &device);
    let mut values = std::mem::replace(tensor, empty).inner().into_data();
    change(values.as_mut_slice().expect("weights are f32"));
    *tensor = Tensor::from_data(values, &device).require_grad();
}

/// The numbers of a tensor, whatever device they are on.
fn numbers<const D: usize>(tensor: Tensor<D>) -> Weights {
    let shape = tensor.dims().to_vec();
    let values = tensor.inner().into_data().iter::<f32>().collect();
    Weights { shape, values }
}

/// One linear layer from the tensors of these names.
fn linear(
    [weight, bias]: &[String; 2],
    tensors: &BTreeMap<String, Weights>,
    device: &Device,
) -> Linear {
    let data = |name: &String| {
        let weights = &tensors[name];
        TensorData::new(weights.values.clone(), weights.shape.clone())
    };
    let plain = Tensor::<2>::from_data(data(weight), device).transpose();
    // A copy in the new order, so that products need not walk it sideways.
    let weight = Tensor::from_data(plain.into_data(), device);
    let bias = Tensor::from_data(data(bias), device);
    if device.is_autodiff() {
        Linear { weight: weight.require_grad(), bias: bias.require_grad() }
    } else {
        Linear { weight, bias }
    }
}
