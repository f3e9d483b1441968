//! Where a frame model's tensors are in the memory of a device: one matrix a layer, padded, its bias as a row.
//!
//! | layer | rows | columns |
//! |---|---|---|
//! | `encoder.0` | inputs + bias | E rounded up |
//! | `encoder.1` | E + bias, rounded up | H + padding; makes the ones of the core's input |
//! | core | H + bias, rounded up; in the first layer 2 H + bias where mean and maximum are pooled | gates side by side, each padded |
//! | `mixer` | H + bias, rounded up | H + padding |
//! | `decoder` | H + bias, rounded up | 2 N, rounded up |

use std::collections::BTreeMap;

use eddy_inference::checkpoint::{Description, Weights, layout};

use crate::{
    kernels::Constants,
    training::{Builder, Matrix, Packing, Part},
};

/// The matrices of a network, in the order of the forward pass.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Layout {
    /// `encoder.0`.
    pub points: Matrix,
    /// `encoder.1`.
    pub pooled: Matrix,
    /// For each layer of the core: the gates from its input, and those from its last output, if it has them.
    pub core: Vec<(Matrix, Option<Matrix>)>,
    /// `mixer`.
    pub mixer: Matrix,
    /// `decoder`.
    pub decoder: Matrix,
    /// All of them.
    pub packing: Packing,
    /// The weight that makes the ones of the core's input.
    ones: usize,
}

impl Layout {
    /// Of a described frame model.
    pub fn new(description: &Description, constants: &Constants) -> Self {
        let mut builder = Builder::default();
        let mut matrix = |parts: Vec<Part>, inputs: usize, rows: usize, stride: usize| {
            builder.matrix(parts, (0..inputs).collect(), inputs, rows, stride)
        };
        let part = |names, gates, outputs| Part { names, gates, outputs, shares_bias: false };
        let one = |name: &str, outputs| vec![part(layout::names(name), 1, outputs)];
        let Constants { encoder, hidden, particles, .. } = *constants;
        let (inputs, wide) = (constants.inputs(), constants.hidden_columns());
        let points =
            matrix(one("encoder.0", encoder), inputs, inputs + 1, constants.encoder_columns());
        let pooled = matrix(one("encoder.1", hidden), encoder, constants.pooled_columns(), wide);
        let core = description.core;
        let layers = (0..description.sizes.layers).map(|layer| {
            let named = |name: &str, gates| part(core.tensors(layer, name), gates, hidden);
            let parts = core.input_parts().iter().map(|&(name, gates)| named(name, gates));
            let (inputs, rows) = match layer {
                0 => (constants.core_inputs(), constants.input_columns()),
                _ => (hidden, wide),
            };
            let input = matrix(parts.collect(), inputs, rows, wide);
            let recurrent = core.recurrent_part();
            let recurrent = recurrent.map(|name| vec![named(name, core.gates())]);
            (input, recurrent.map(|parts| matrix(parts, hidden, wide, wide)))
        });
        let layers = layers.collect();
        let mixer = matrix(one("mixer", hidden), hidden, wide, wide);
        let decoder =
            matrix(one("decoder", 2 * particles), hidden, wide, constants.output_columns());
        let ones = pooled.first + pooled.bias * pooled.columns + hidden;
        let packing = builder.finish();
        Self { points, pooled, core: layers, mixer, decoder, packing, ones }
    }

    /// All weights as the device has them, from the tensors of a checkpoint.
    pub fn pack(&self, tensors: &BTreeMap<String, Weights>) -> Vec<f32> {
        let mut all = self.packing.pack(tensors);
        all[self.ones] = 1.0;
        all
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use eddy_inference::checkpoint::{
        Architecture, Core, MaterialInput, Pooling, Sizes, initial_weights, plan::Plan,
    };

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn packed_weights_are_unpacked_as_they_were(
            core in prop::sample::select(Core::ALL.to_vec()),
            layers in 1..4usize,
            encoder in 1..20usize,
            hidden in 1..20usize,
            particles in 1..10usize,
            scalar: bool,
            pooling in prop::sample::select(vec![Pooling::Mean, Pooling::Max, Pooling::MeanMax]),
        ) {
            let sizes = Sizes { encoder, hidden, layers, particles: Some(particles) };
            let mut description = Description::untrained(Architecture::Frame, core, sizes);
            if scalar {
                description.frame.material = MaterialInput::Scalar;
            }
            description.frame.pooling = pooling;
            let constants = Constants::of(&description).unwrap();
            let layout = Layout::new(&description, &constants);
            let weights = initial_weights(&description, 7);
            let packed = layout.pack(&weights);
            prop_assert_eq!(layout.packing.unpack(&packed), weights.clone());
            let numbers: usize = weights.values().map(|weights| weights.values.len()).sum();
            let ordered = layout.packing.unpack_ordered(&packed);
            let again = layout.packing.pack_ordered(ordered.iter().map(Vec::as_slice));
            let mut without_ones = packed.clone();
            without_ones[layout.ones] = 0.0;
            prop_assert_eq!(again, without_ones);
            for (layer, pair) in Plan::new(&description).layers.iter().zip(ordered.chunks(2)) {
                let (weight, bias) = (&weights[&layer.weight].values, &weights[&layer.bias].values);
                prop_assert_eq!(&pair[1], bias);
                let (first, last) = (weight[0], weight[weight.len() - 1]);
                prop_assert_eq!((pair[0][0], pair[0][weight.len() - 1]), (first, last));
                let second = if layer.output > 1 { weight[layer.input] } else { weight[layer.input.min(2) - 1] };
                if weight.len() > 1 {
                    prop_assert_eq!(pair[0][1], second, "matrices are [in, out]");
                }
            }
            let used = packed.iter().filter(|&&number| number != 0.0).count();
            prop_assert!(used <= numbers + 1, "padding is zero: {} of {}", used, numbers);
        }
    }
}
