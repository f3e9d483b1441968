//! Where a network's tensors are in the memory of a device: one matrix a layer, padded, its bias as a row.

use std::{collections::BTreeMap, ops::Range};

use eddy_inference::checkpoint::{Weights, layout};

use crate::kernels::round_up;

/// A tensor of a checkpoint, in the matrix of its layer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Part {
    /// Names of weight and bias.
    pub(crate) names: [String; 2],
    /// Gates within it, side by side.
    pub(crate) gates: usize,
    /// Outputs of a gate.
    pub(crate) outputs: usize,
    /// Whether all gates have the same bias, which is where the first one's would be.
    pub(crate) shares_bias: bool,
}

impl Part {
    fn biases(&self) -> usize {
        if self.shares_bias { 1 } else { self.gates }
    }
}

/// The matrix of a layer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Matrix {
    /// Its number among the matrices of the network.
    pub number: usize,
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
    /// The row of each input.
    inputs: Vec<usize>,
}

impl Matrix {
    /// Numbers in it.
    pub fn size(&self) -> usize {
        self.rows * self.columns
    }

    /// Whether a part is the weight of a hidden layer.
    pub(super) fn is_hidden(&self, part: usize) -> bool {
        layout::is_hidden(&self.parts[part].names[0])
    }

    /// Inputs and outputs of a part, without padding.
    pub(super) fn shape(&self, part: usize) -> [usize; 2] {
        [self.inputs.len(), self.parts[part].gates * self.parts[part].outputs]
    }

    /// Tensors of the checkpoint in it.
    pub fn tensors(&self) -> usize {
        2 * self.parts.len()
    }
}

/// Places matrices one behind the other.
#[derive(Default)]
pub(crate) struct Builder {
    packing: Packing,
}

impl Builder {
    /// The next matrix, of these tensors side by side with `stride` columns a gate: `inputs` has the row of each input, `bias` is
    /// the one of the bias, and there are `rows` in all.
    pub(crate) fn matrix(
        &mut self,
        parts: Vec<Part>,
        inputs: Vec<usize>,
        bias: usize,
        rows: usize,
        stride: usize,
    ) -> Matrix {
        let Packing { matrices, size, tensors } = &mut self.packing;
        let gates: usize = parts.iter().map(|part| part.gates).sum();
        let columns = gates * stride;
        let width = columns / parts.len();
        let (first, tensor) = (*size, *tensors);
        let number = matrices.len();
        let matrix =
            Matrix { number, first, rows, columns, bias, width, tensor, parts, stride, inputs };
        *size = round_up(first + matrix.size(), 64);
        *tensors += matrix.tensors();
        matrices.push(matrix.clone());
        matrix
    }

    /// All of them.
    pub(crate) fn finish(self) -> Packing {
        self.packing
    }
}

/// The matrices of a network, in the order of checkpoints' layers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Packing {
    matrices: Vec<Matrix>,
    /// Numbers in all of them.
    pub size: usize,
    /// Tensors in all of them.
    pub tensors: usize,
}

impl Packing {
    /// Every matrix.
    pub fn matrices(&self) -> &[Matrix] {
        &self.matrices
    }

    /// Calls `each` with the place of every number of every tensor, by the tensor's name, in the order of checkpoints
    /// (`[out, in]`).
    fn places(&self, mut each: impl FnMut(&str, Vec<usize>, &mut dyn Iterator<Item = usize>)) {
        for matrix in &self.matrices {
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
                let row = |output| matrix.inputs.iter().map(move |&row| at(row, output));
                each(weight, vec![outputs, matrix.inputs.len()], &mut (0..outputs).flat_map(row));
                let biases = part.biases() * part.outputs;
                each(bias, vec![biases], &mut (0..biases).map(|o| at(matrix.bias, o)));
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
        all
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
        for matrix in &self.matrices {
            for (number, part) in matrix.parts.iter().enumerate() {
                let row = |row: usize, gates: usize| {
                    let first = matrix.first + row * matrix.columns + number * matrix.width;
                    let run = |gate: usize| {
                        let first = first + gate * matrix.stride;
                        first..first + part.outputs
                    };
                    (0..gates).map(run).collect()
                };
                each(matrix.inputs.iter().map(|&input| row(input, part.gates)).collect());
                each(vec![row(matrix.bias, part.biases())]);
            }
        }
    }
}
