//! What the kernels of a training are compiled for, and where tensors are in the memory of the device.
//!
//! | layer | rows | columns |
//! |---|---|---|
//! | `encoder.0`, `encoder.1` | F, E | E, C0 |
//! | `grid.*` | rows of the gathered nodes one behind the other | channels; of `up` for each child |
//! | `context` | F, C0 | H |
//! | core: from the input, then, of GRU and LSTM, from the last output | H | gates side by side |
//! | `mixer` | H | H |
//! | `decoder` | H | 4 |
//!
//! Widths are rounded up to 4; the bias is the row behind them.

use eddy_inference::checkpoint::{Description, grid::GridLayer, layout};

use crate::{
    device::count,
    error::Result,
    kernels::{
        AXES, PARTICLE_TRAINING_SOURCE, Program,
        particle::{products::WARP_ROWS, training::weights::Transposed},
    },
    particle::layout::{Constants, STENCIL_BYTES, STENCIL_ROWS, fitting, four, odd},
    training::{Builder, Matrix, Packing, Part},
};

/// Bytes of `struct PlacedStencil` of the kernels.
const PLACED_STENCIL_BYTES: usize = STENCIL_BYTES + 4 * AXES;

/// What the kernels of a training, which also predict, are compiled for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TrainingConstants {
    /// Those of the predictions.
    pub(super) network: Constants,
    /// Warps of a block that has particles.
    pub(super) warps: usize,
}

impl TrainingConstants {
    /// Of a described particle model.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`](crate::CudaError::Unsupported) for the frame model and for layers that are too wide.
    pub fn of(description: &Description) -> Result<Self> {
        let network = Constants::of(description)?;
        let bytes = |warps| {
            let sized = Self { network: network.clone(), warps };
            [
                sized.encode_bytes(),
                sized.decode_bytes(),
                sized.decode_gradient_bytes(),
                sized.encode_gradient_bytes(),
            ]
            .into_iter()
            .max()
            .unwrap_or_default()
        };
        let Some(warps) = fitting(&[4, 2, 1], bytes) else {
            return Err(network.too_wide(
                "at most about 250 hidden units, an encoder and a finest level of about 1400 to train on a GPU",
            ));
        };
        Ok(Self { network, warps })
    }

    /// Particles of a block.
    pub(super) fn tile(&self) -> usize {
        self.warps * WARP_ROWS
    }

    /// Level and padded width of the lists of features at nodes.
    pub(super) fn fields(&self) -> Vec<(usize, usize)> {
        let outputs = self.network.grid.iter().map(|layer| (layer.level, four(layer.channels[1])));
        self.network.lists[..1].iter().copied().chain(outputs).collect()
    }

    /// E rounded up.
    pub(super) fn encoder_columns(&self) -> usize {
        four(self.network.encoder)
    }

    /// Sums of all units that are kept.
    pub(super) fn slots(&self) -> usize {
        self.network.core.sums() * self.network.hidden_columns()
    }

    /// Columns of the decoder.
    pub(super) fn output_columns(&self) -> usize {
        four(2 * AXES)
    }

    /// Shared memory of a block of each kernel with particles (bytes).
    pub(super) fn encode_bytes(&self) -> usize {
        let widths = [self.network.features, self.network.encoder, self.network.channels[0]];
        4 * self.tile() * widths.map(|width| odd(four(width))).iter().sum::<usize>()
    }

    pub(super) fn decode_bytes(&self) -> usize {
        self.decode_gradient_bytes() + self.tile() * PLACED_STENCIL_BYTES
    }

    pub(super) fn decode_gradient_bytes(&self) -> usize {
        let hidden = self.network.hidden_columns();
        let longest = self.network.context_rows().max(hidden).max(self.slots());
        4 * self.tile() * (odd(longest) + 2 * odd(hidden))
    }

    pub(super) fn encode_gradient_bytes(&self) -> usize {
        self.encode_bytes() + self.tile() * (4 * 3 * STENCIL_ROWS + PLACED_STENCIL_BYTES)
    }
}

impl Program for TrainingConstants {
    fn source(&self) -> String {
        self.network.source() + &PARTICLE_TRAINING_SOURCE.concat()
    }

    fn definitions(&self) -> Vec<(&'static str, usize)> {
        let own = [("LEARN_WARPS", self.warps)];
        self.network.definitions().into_iter().chain(own).collect()
    }
}

/// The matrices of a network, in the order of the forward pass.
pub(super) struct Layout {
    /// `encoder.0`, `encoder.1`.
    pub(super) encoder: [Matrix; 2],
    /// `grid.*`.
    pub(super) grid: Vec<Matrix>,
    /// `context`.
    pub(super) context: Matrix,
    /// For each layer of the core: the gates from its input, and those from its last output, if it has them.
    pub(super) core: Vec<(Matrix, Option<Matrix>)>,
    /// `mixer`.
    pub(super) mixer: Matrix,
    /// `decoder`.
    pub(super) decoder: Matrix,
    /// All of them.
    pub(super) packing: Packing,
}

impl Layout {
    pub(super) fn new(constants: &TrainingConstants) -> Self {
        let mut builder = Builder::default();
        let mut matrix = |parts: Vec<Part>, inputs: Vec<usize>, inner: usize| {
            let stride = four(parts[0].outputs);
            builder.matrix(parts, inputs, inner, inner + 1, stride)
        };
        let part = |names, gates, outputs| Part { names, gates, outputs, shares_bias: false };
        let one = |name: &str, outputs| vec![part(layout::names(name), 1, outputs)];
        let Constants { encoder, hidden, core, layers, .. } = constants.network;
        let channels = &constants.network.channels;
        let rows = |inputs: usize| (0..inputs).collect::<Vec<_>>();
        let features = constants.network.feature_columns();
        let encoder_layers = [
            matrix(one("encoder.0", encoder), rows(constants.network.features), features),
            matrix(one("encoder.1", channels[0]), rows(encoder), four(encoder)),
        ];
        let grid = constants.network.grid.iter();
        let grid = grid
            .map(|GridLayer { name, stencil, channels: [group, outputs], .. }| {
                let (places, children, inner) =
                    (stencil.places(), stencil.children(), four(*group));
                let row = |input: usize| input / group * inner + input % group;
                let part = Part {
                    names: layout::names(name),
                    gates: children,
                    outputs: *outputs,
                    shares_bias: children > 1,
                };
                matrix(vec![part], (0..places * group).map(row).collect(), places * inner)
            })
            .collect();
        // The gathered numbers begin behind the padded features.
        let gathered = (0..channels[0]).map(|channel| features + channel);
        let inputs = (0..constants.network.features).chain(gathered).collect();
        let context = matrix(one("context", hidden), inputs, constants.network.context_rows());
        let units = constants.network.hidden_columns();
        let core_layers = (0..layers)
            .map(|layer| {
                let named = |name: &str, gates| part(core.tensors(layer, name), gates, hidden);
                let input = core.input_parts().iter().map(|&(name, gates)| named(name, gates));
                let mut matrix = |parts| matrix(parts, rows(hidden), units);
                let input = matrix(input.collect());
                let recurrent = core.recurrent_part();
                (input, recurrent.map(|name| matrix(vec![named(name, core.gates())])))
            })
            .collect();
        let mixer = matrix(one("mixer", hidden), rows(hidden), units);
        let decoder = matrix(one("decoder", 2 * AXES), rows(hidden), units);
        let packing = builder.finish();
        Self { encoder: encoder_layers, grid, context, core: core_layers, mixer, decoder, packing }
    }

    /// Where every matrix is that is to be transposed.
    pub(super) fn transposed(&self) -> Vec<Transposed> {
        let matrix = |matrix: &Matrix| Transposed {
            first: count(matrix.first),
            inner: count(matrix.bias),
            columns: count(matrix.columns),
        };
        self.packing.matrices().iter().map(matrix).collect()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use eddy_inference::checkpoint::{
        Architecture, Core, GridOptions, Sizes, initial_weights, plan::Plan,
    };

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]
        #[test]
        fn packed_weights_are_unpacked_as_they_were(
            core in prop::sample::select(Core::ALL.to_vec()),
            layers in 1..4usize,
            encoder in 1..20usize,
            hidden in 1..20usize,
            channels in prop::collection::vec(1..10usize, GridOptions::LEVELS),
        ) {
            let sizes = Sizes { encoder, hidden, layers, particles: None };
            let mut description = Description::untrained(Architecture::Particle, core, sizes);
            description.grid.as_mut().unwrap().channels = channels;
            let constants = TrainingConstants::of(&description).unwrap();
            let Layout { packing, .. } = Layout::new(&constants);
            let weights = initial_weights(&description, 7);
            let packed = packing.pack(&weights);
            prop_assert_eq!(packing.unpack(&packed), weights.clone());
            let ordered = packing.unpack_ordered(&packed);
            prop_assert_eq!(packing.pack_ordered(ordered.iter().map(Vec::as_slice)), packed);
            for (layer, pair) in Plan::new(&description).layers.iter().zip(ordered.chunks(2)) {
                let (weight, bias) = (&weights[&layer.weight].values, &weights[&layer.bias].values);
                prop_assert_eq!(&pair[1], bias);
                let transposed: Vec<f32> = (0..layer.input)
                    .flat_map(|i| (0..layer.output).map(move |o| weight[o * layer.input + i]))
                    .collect();
                prop_assert_eq!(&pair[0], &transposed, "matrices are [in, out]");
            }
        }
    }
}
