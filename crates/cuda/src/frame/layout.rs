//! Where a frame model's tensors are in the memory of a device: one matrix a layer, padded, its bias as a row.
//!
//! | layer | rows | columns |
//! |---|---|---|
//! | `encoder.0` | inputs + bias | E rounded up |
//! | `encoder.1` | E + bias, rounded up | H + padding; makes the ones of the core's input |
//! | core | H + bias, rounded up; in the first layer 2 H + bias where mean and maximum are pooled | gates side by side, each padded |
//! | `mixer` | H + bias, rounded up | H + padding |
//! | `decoder` | H + bias, rounded up | 2 N, rounded up |

use std::{collections::BTreeMap, ops::Range};

use eddy_inference::checkpoint::{Core, Description, Weights, layout};

use crate::kernels::{Constants, round_up};

/// A tensor of a checkpoint, in the matrix of its layer.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Part {
    /// Names of weight and bias.
    names: [String; 2],
    /// Gates within it.
    gates: usize,
    /// Outputs of a gate.
    outputs: usize,
}

/// The matrix of a layer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Matrix {
    /// First number within the list of all weights.
    pub first: usize,
    /// Rows, padding included.
    pub rows: usize,
    /// Columns, padding included.
    pub columns: usize,
    /// The row of the bias.
    pub bias: usize,
    /// Columns of a part.
    pub width: usize,
    /// Number of the first tensor in the order of checkpoints' layers; weights and biases in turn.
    pub tensor: usize,
    parts: Vec<Part>,
    /// Columns of a gate.
    stride: usize,
}

impl Matrix {
    /// Numbers in it.
    pub fn size(&self) -> usize {
        self.rows * self.columns
    }

    /// Tensors of the checkpoint in it.
    pub fn tensors(&self) -> usize {
        2 * self.parts.len()
    }
}

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
    /// Numbers in all of them.
    pub size: usize,
    /// Tensors in all of them.
    pub tensors: usize,
    /// The weight that makes the ones of the core's input.
    ones: usize,
}

impl Layout {
    /// Of a described frame model.
    pub fn new(description: &Description, constants: &Constants) -> Self {
        let (mut first, mut tensor) = (0, 0);
        let mut matrix = |parts: Vec<Part>, inputs: usize, rows: usize, stride: usize| {
            let gates: usize = parts.iter().map(|part| part.gates).sum();
            let columns = gates * stride;
            let matrix = Matrix {
                first,
                rows,
                columns,
                bias: inputs,
                width: columns / parts.len(),
                tensor,
                parts,
                stride,
            };
            first = round_up(first + matrix.size(), 64);
            tensor += matrix.tensors();
            matrix
        };
        let one =
            |name: &str, outputs| vec![Part { names: layout::names(name), gates: 1, outputs }];
        let Constants { encoder, hidden, particles, .. } = *constants;
        let (inputs, wide) = (constants.inputs(), constants.hidden_columns());
        let points =
            matrix(one("encoder.0", encoder), inputs, inputs + 1, constants.encoder_columns());
        let pooled = matrix(one("encoder.1", hidden), encoder, constants.pooled_columns(), wide);
        let core = description.core;
        let layers = (0..description.sizes.layers).map(|layer| {
            let parts: Vec<Part> = layout::core_parts(core)
                .iter()
                .map(|&(part, gates)| Part {
                    names: layout::core_names(core, layer, part),
                    gates,
                    outputs: hidden,
                })
                .collect();
            let (inputs, rows) = match layer {
                0 => (constants.core_inputs(), constants.input_columns()),
                _ => (hidden, wide),
            };
            match core {
                Core::Gru | Core::Lstm => {
                    let [input, recurrent] =
                        [0, 1].map(|number: usize| vec![parts[number].clone()]);
                    (matrix(input, inputs, rows, wide), Some(matrix(recurrent, hidden, wide, wide)))
                }
                Core::Mlp | Core::MinGru | Core::MinLstm => {
                    (matrix(parts, inputs, rows, wide), None)
                }
            }
        });
        let layers = layers.collect();
        let mixer = matrix(one("mixer", hidden), hidden, wide, wide);
        let decoder =
            matrix(one("decoder", 2 * particles), hidden, wide, constants.output_columns());
        let ones = pooled.first + pooled.bias * pooled.columns + hidden;
        Self { points, pooled, core: layers, mixer, decoder, size: first, tensors: tensor, ones }
    }

    /// Every matrix, in the order of the forward pass.
    pub fn matrices(&self) -> impl Iterator<Item = &Matrix> {
        let core =
            self.core.iter().flat_map(|(input, recurrent)| std::iter::once(input).chain(recurrent));
        [&self.points, &self.pooled].into_iter().chain(core).chain([&self.mixer, &self.decoder])
    }

    /// Calls `each` with the place of every number of every tensor, by the tensor's name, in the order of checkpoints
    /// (`[out, in]`).
    fn places(&self, mut each: impl FnMut(&str, Vec<usize>, &mut dyn Iterator<Item = usize>)) {
        for matrix in self.matrices() {
            for (number, part) in matrix.parts.iter().enumerate() {
                let at = |row: usize, output: usize| {
                    let (gate, column) = (output / part.outputs, output % part.outputs);
                    matrix.first
                        + row * matrix.columns
                        + number * matrix.width
                        + gate * matrix.stride
                        + column
                };
                let outputs = part.gates * part.outputs;
                let [weight, bias] = &part.names;
                let shape = vec![outputs, matrix.bias];
                each(
                    weight,
                    shape,
                    &mut (0..outputs).flat_map(|o| (0..matrix.bias).map(move |i| at(i, o))),
                );
                each(bias, vec![outputs], &mut (0..outputs).map(|o| at(matrix.bias, o)));
            }
        }
    }

    /// All weights as the device has them, from the tensors of a checkpoint.
    pub fn pack(&self, tensors: &BTreeMap<String, Weights>) -> Vec<f32> {
        let mut all = vec![0f32; self.size];
        self.places(|name, _, places| {
            if let Some(weights) = tensors.get(name) {
                places.zip(&weights.values).for_each(|(place, &value)| all[place] = value);
            }
        });
        all[self.ones] = 1.0;
        all
    }

    /// What belongs to each number of the weights (moments, averages), from tensors in the order of checkpoints'
    /// layers, matrices as `[in, out]`. Where a list is empty, there are zeros.
    pub fn pack_ordered<'a>(&self, tensors: impl IntoIterator<Item = &'a [f32]>) -> Vec<f32> {
        let mut all = vec![0f32; self.size];
        let mut tensors = tensors.into_iter();
        self.rows(|rows| {
            let mut values = tensors.next().unwrap_or_default();
            for row in rows {
                for run in row {
                    let (now, later) = values.split_at(run.len().min(values.len()));
                    all[run.start..run.start + now.len()].copy_from_slice(now);
                    values = later;
                }
            }
        });
        all
    }

    /// The inverse of [`Self::pack_ordered`].
    pub fn unpack_ordered(&self, all: &[f32]) -> Vec<Vec<f32>> {
        let mut tensors = Vec::with_capacity(self.tensors);
        self.rows(|rows| {
            let runs = rows.into_iter().flatten();
            tensors.push(runs.flat_map(|run| all[run].iter().copied()).collect());
        });
        tensors
    }

    /// Calls `each` with the places of every tensor in the order of checkpoints' layers: for each row, the runs of
    /// numbers of its gates.
    fn rows(&self, mut each: impl FnMut(Vec<Vec<Range<usize>>>)) {
        for matrix in self.matrices() {
            for (number, part) in matrix.parts.iter().enumerate() {
                let row = |row: usize| {
                    let first = matrix.first + row * matrix.columns + number * matrix.width;
                    let run = |gate: usize| {
                        let first = first + gate * matrix.stride;
                        first..first + part.outputs
                    };
                    (0..part.gates).map(run).collect()
                };
                each((0..matrix.bias).map(row).collect());
                each(vec![row(matrix.bias)]);
            }
        }
    }

    /// The tensors of a checkpoint from all weights, the inverse of [`Self::pack`].
    pub fn unpack(&self, all: &[f32]) -> BTreeMap<String, Weights> {
        let mut tensors = BTreeMap::new();
        self.places(|name, shape, places| {
            let values = places.map(|place| all[place]).collect();
            tensors.insert(name.to_owned(), Weights { shape, values });
        });
        tensors
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use eddy_inference::checkpoint::{
        Architecture, MaterialInput, Pooling, Sizes, initial_weights, layout::linear_layers,
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
            prop_assert_eq!(layout.unpack(&packed), weights.clone());
            let numbers: usize = weights.values().map(|weights| weights.values.len()).sum();
            let ordered = layout.unpack_ordered(&packed);
            let again = layout.pack_ordered(ordered.iter().map(Vec::as_slice));
            let mut without_ones = packed.clone();
            without_ones[layout.ones] = 0.0;
            prop_assert_eq!(again, without_ones);
            for (layer, pair) in linear_layers(&description).iter().zip(ordered.chunks(2)) {
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
