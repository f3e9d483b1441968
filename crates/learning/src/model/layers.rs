//! All layers of a network: weights in, weights out, weights changed by an optimizer.

use std::collections::BTreeMap;

use burn::tensor::{Device, Gradients, Tensor};

use super::{
    core::RecurrentLayer,
    dropout::Dropout,
    grid::GridLayers,
    linear::{Linear, exchange, gradient, weights},
    state::LayerState,
};
use eddy_inference::checkpoint::{Description, Weights, grid::grid_layers, layout};

/// All layers of a network.
#[derive(Clone, Debug)]
pub(crate) struct Layers {
    /// `encoder.0`, `encoder.1`.
    pub(crate) encoder: [Linear; 2],
    /// `grid.*` and `context`, in particle models only.
    pub(crate) grid: Option<GridLayers>,
    /// The core's layers, in order.
    pub(crate) core: Vec<RecurrentLayer>,
    /// `mixer`.
    pub(crate) mixer: Linear,
    /// `decoder`.
    pub(crate) decoder: Linear,
}

impl Layers {
    /// The layers with tensors that match the description, on `device`. With autodiff, gradients by all of them are recorded.
    pub(crate) fn new(
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
        device: &Device,
    ) -> Self {
        let linear = |names: [String; 2]| Linear::from_weights(&names, tensors, device);
        Self {
            encoder: ["encoder.0", "encoder.1"].map(|layer| linear(layout::names(layer))),
            grid: description.grid.as_ref().map(|grid| {
                let plan = grid_layers(grid);
                let grid = plan.iter().map(|layer| linear(layout::names(&layer.name))).collect();
                GridLayers { plan, grid, context: linear(layout::names("context")) }
            }),
            core: (0..description.sizes.layers)
                .map(|layer| {
                    RecurrentLayer::new(description, |part| {
                        linear(description.core.tensors(layer, part))
                    })
                })
                .collect(),
            mixer: linear(layout::names("mixer")),
            decoder: linear(layout::names("decoder")),
        }
    }

    /// The core over T frames: `[T, R, I]` to `[T, R, H]`, and the states after the last frame.
    pub(crate) fn observe_core(
        &self,
        mut signal: Tensor<3>,
        carried: &[LayerState],
        dropout: &mut Dropout,
    ) -> (Tensor<3>, Vec<LayerState>) {
        let mut states = Vec::with_capacity(self.core.len());
        for (number, layer) in self.core.iter().enumerate() {
            let (output, state) = layer.observe(signal, carried.get(number).cloned());
            states.push(state);
            signal = dropout.apply(output);
        }
        (signal, states)
    }

    /// The core over one frame: `[R, I]` to `[R, H]`, and the new states.
    pub(crate) fn step_core(
        &self,
        mut signal: Tensor<2>,
        carried: &[LayerState],
        dropout: &mut Dropout,
    ) -> (Tensor<2>, Vec<LayerState>) {
        let mut states = Vec::with_capacity(self.core.len());
        for (number, layer) in self.core.iter().enumerate() {
            let state = layer.step(signal, carried.get(number).cloned());
            signal = dropout.apply(state.hidden.clone());
            states.push(state);
        }
        (signal, states)
    }

    /// The weights by name, as in checkpoints.
    pub(crate) fn tensors(&self, description: &Description) -> BTreeMap<String, Weights> {
        let named = layout::linear_layers(description).into_iter().zip(self.linears());
        named
            .flat_map(|(layer, linear)| {
                let weight = weights(linear.weight.clone().transpose()); // [out, in]
                [(layer.weight, weight), (layer.bias, weights(linear.bias.clone()))]
            })
            .collect()
    }

    /// Number of tensors.
    pub(crate) fn count(&self) -> usize {
        2 * self.linears().len()
    }

    /// All linear layers, in the order of [`layout::linear_layers`].
    pub(crate) fn linears(&self) -> Vec<&Linear> {
        let grid = self
            .grid
            .iter()
            .flat_map(|GridLayers { grid, context, .. }| grid.iter().chain([context]));
        let core = self.core.iter().flat_map(RecurrentLayer::parts);
        let ends = [&self.mixer, &self.decoder];
        self.encoder.iter().chain(grid).chain(core).chain(ends).collect()
    }

    fn linears_mut(&mut self) -> Vec<&mut Linear> {
        let grid = self.grid.iter_mut();
        let grid =
            grid.flat_map(|GridLayers { grid, context, .. }| grid.iter_mut().chain([context]));
        let core = self.core.iter_mut().flat_map(RecurrentLayer::parts_mut);
        let ends = [&mut self.mixer, &mut self.decoder];
        self.encoder.iter_mut().chain(grid).chain(core).chain(ends).collect()
    }

    /// Calls `change` with number, values and gradient of each tensor, weight (`[in, out]`) before bias, in the order of
    /// [`Layers::linears`]. A tensor that the loss does not depend on has no gradient and is left unchanged.
    pub(crate) fn update(
        &mut self,
        gradients: &mut Gradients,
        mut change: impl FnMut(usize, &mut [f32], &[f32]),
    ) {
        for (index, linear) in self.linears_mut().into_iter().enumerate() {
            linear.update(index, gradients, &mut change);
        }
    }

    /// A copy with separate gradients.
    pub(crate) fn detached(&self) -> Self {
        let mut layers = self.clone();
        for Linear { weight, bias } in layers.linears_mut() {
            *weight = Tensor::from_inner(weight.clone().inner()).require_grad();
            *bias = Tensor::from_inner(bias.clone().inner()).require_grad();
        }
        layers
    }

    /// The gradient by each tensor, in the order of [`Layers::update`]; empty if there is none.
    pub(crate) fn gradients(&self, gradients: &mut Gradients) -> Vec<Vec<f32>> {
        let mut all = Vec::new();
        for Linear { weight, bias } in self.linears() {
            all.push(gradient(weight, gradients));
            all.push(gradient(bias, gradients));
        }
        all
    }

    /// Calls `change` with number and values of each tensor, in the order of [`Layers::update`].
    pub(crate) fn exchange(&mut self, mut change: impl FnMut(usize, &mut [f32])) {
        for (index, linear) in self.linears_mut().into_iter().enumerate() {
            exchange(&mut linear.weight, |values| change(2 * index, values));
            exchange(&mut linear.bias, |values| change(2 * index + 1, values));
        }
    }
}
