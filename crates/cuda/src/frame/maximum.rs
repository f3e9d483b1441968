//! Pooling by the maximum: the second Linear's outputs for each particle of a few windows at a time.

use crate::{
    device::{Device, Factor, List, Pointer, Product, Shape},
    error::Result,
    kernels::{Constants, frame::maximum::POINT_TILE, round_up},
    training::Matrix,
};

/// The second Linear's inputs and outputs for all particles of some windows.
pub(super) struct Points {
    /// `[rows, N, EP]`.
    pub inputs: List<f32>,
    /// `[rows, N, HP]`.
    pub outputs: List<f32>,
    /// Numbers from a window's inputs, and from its outputs, to those of the next one.
    pub strides: [usize; 2],
}

impl Points {
    /// Memory for so many windows, each of which begins at a multiple of `alignment` numbers.
    pub fn new(
        device: &dyn Device,
        constants: &Constants,
        rows: usize,
        alignment: usize,
    ) -> Result<Self> {
        let strides = Self::strides(constants).map(|stride| round_up(stride, alignment));
        let [inputs, outputs] = strides.map(|stride| List::new(device, rows * stride));
        Ok(Self { inputs: inputs?, outputs: outputs?, strides })
    }

    fn strides(constants: &Constants) -> [usize; 2] {
        [constants.pooled_columns(), constants.hidden_columns()]
            .map(|columns| constants.particles * columns)
    }

    /// Windows that take so many bytes, at least one.
    pub fn rows_within(constants: &Constants, bytes: usize) -> usize {
        (bytes / (4 * Self::strides(constants).iter().sum::<usize>())).max(1)
    }

    /// Blocks over the particles of windows.
    pub fn shape(&self, particles: usize, rows: usize) -> Shape {
        Shape::new(particles.div_ceil(POINT_TILE), rows, 256)
    }

    /// Blocks over the units of the core's input that come from maxima, and their ones.
    pub fn largest(constants: &Constants, rows: usize) -> Shape {
        let means = if constants.mean() { constants.hidden } else { 0 };
        let columns = constants.input_columns() - means;
        Shape { grid: [columns.div_ceil(32), rows, 1], block: [32, 8], shared: 0 }
    }

    /// The second Linear of so many particles from window `row` on.
    pub fn product(
        &self,
        matrix: &Matrix,
        row: usize,
        particles: usize,
        weights: &List<f32>,
    ) -> Product {
        let at = |list: &List<f32>, stride: usize| list.pointer().plus(row * stride);
        let factor = |at: Pointer<f32>, stride| Factor { at, stride, transposed: false };
        Product {
            left: factor(at(&self.inputs, self.strides[0]), matrix.rows),
            right: factor(weights.pointer().plus(matrix.first), matrix.columns),
            result: at(&self.outputs, self.strides[1]),
            stride: matrix.columns,
            sizes: [particles, matrix.rows, matrix.columns],
            add: false,
        }
    }
}
