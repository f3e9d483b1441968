//! The linear layers both networks are made of: initial weights, weights in, weights out.

use std::collections::BTreeMap;

use burn::{
    module::{Module, Param},
    nn::Linear,
    tensor::{Device, Tensor, TensorData},
};
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::core::RecurrentLayer;
use crate::checkpoint::{Architecture, Description, Weights, layout};

/// All learned numbers of a network.
#[derive(Module, Debug)]
pub(crate) struct Layers {
    /// `encoder.0`, `encoder.1`.
    pub(crate) encoder: Vec<Linear>,
    /// `core.l`, in order.
    pub(crate) core: Vec<RecurrentLayer>,
    /// `mixer`.
    pub(crate) mixer: Linear,
    /// `decoder`.
    pub(crate) decoder: Linear,
}

impl Layers {
    /// Puts the layers together from tensors that fit the description, on `device`.
    pub(crate) fn new(
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
        device: &Device,
    ) -> Self {
        let linear = |name: &str| linear(name, tensors, device);
        Self {
            encoder: vec![linear("encoder.0"), linear("encoder.1")],
            core: (0..description.sizes.layers)
                .map(|layer| {
                    RecurrentLayer::new(description.core, |part| {
                        linear(&format!("core.{layer}.{part}"))
                    })
                })
                .collect(),
            mixer: linear("mixer"),
            decoder: linear("decoder"),
        }
    }

    /// The weights by name, as checkpoints hold them.
    pub(crate) fn tensors(&self) -> BTreeMap<String, Weights> {
        let mut named: Vec<(String, &Linear)> = Vec::new();
        named.extend(self.encoder.iter().enumerate().map(|(i, l)| (format!("encoder.{i}"), l)));
        for (i, layer) in self.core.iter().enumerate() {
            named.extend(layer.parts().map(|(part, l)| (format!("core.{i}.{part}"), l)));
        }
        named.push(("mixer".to_owned(), &self.mixer));
        named.push(("decoder".to_owned(), &self.decoder));
        named
            .into_iter()
            .flat_map(|(name, linear)| {
                let weight = numbers(linear.weight.val().transpose()); // [out, in]
                let bias = linear.bias.as_ref().map(|bias| numbers(bias.val()));
                let bias = bias.map(|bias| (format!("{name}.bias"), bias));
                [Some((format!("{name}.weight"), weight)), bias].into_iter().flatten()
            })
            .collect()
    }
}

/// The numbers of a tensor, whatever device they are on.
fn numbers<const D: usize>(tensor: Tensor<D>) -> Weights {
    let shape = tensor.dims().to_vec();
    let values = tensor.inner().into_data().iter::<f32>().collect();
    Weights { shape, values }
}

/// One linear layer: burn keeps its matrix as `[in, out]`.
fn linear(name: &str, tensors: &BTreeMap<String, Weights>, device: &Device) -> Linear {
    let data = |part: &str| {
        let weights = &tensors[&format!("{name}.{part}")];
        TensorData::new(weights.values.clone(), weights.shape.clone())
    };
    let weight = Tensor::<2>::from_data(data("weight"), device).transpose();
    // A copy in burn's own order, so that products need not walk it sideways.
    let weight = Tensor::from_data(weight.into_data(), device);
    let bias = Tensor::<1>::from_data(data("bias"), device);
    Linear { weight: Param::from_tensor(weight), bias: Some(Param::from_tensor(bias)) }
}

/// Initial weights: uniform in +-sqrt(gain / in), biases zero but for gates, which start open
/// (sigmoid(1) = .73 of the candidate enters at each frame); the decoder is zero, so that an untrained
/// network adds nothing to the step it sits on. The gain is 1 for the frame model, as in PyTorch's
/// linear layers, and 3 for the narrow particle model, which keeps the variance of its inputs.
pub(crate) fn initial(description: &Description, seed: u64) -> BTreeMap<String, Weights> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let gain = match description.architecture {
        Architecture::Frame => 1.0f32,
        Architecture::Particle => 3.0,
    };
    let mut tensors = BTreeMap::new();
    for (name, input, output) in layout::linear_layers(description) {
        let bound = if name == "decoder" { 0.0 } else { (gain / input as f32).sqrt() };
        let opens = name.ends_with(".gate") || name.ends_with(".input_gate");
        let weight = (0..output * input).map(|_| bound * (2.0 * random.random::<f32>() - 1.0));
        let weight = Weights { shape: vec![output, input], values: weight.collect() };
        let bias = vec![if opens { 1.0 } else { 0.0 }; output];
        tensors.insert(format!("{name}.weight"), weight);
        tensors.insert(format!("{name}.bias"), Weights { shape: vec![output], values: bias });
    }
    tensors
}
