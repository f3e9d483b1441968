//! A matrix packed in panels as wide as a SIMD vector.

use pulp::{Arch, Simd};

use crate::kernels::{matrix::Matrix, vectors::Lanes};

/// A packed matrix, `[I, O]`.
#[derive(Clone, Debug)]
pub struct Panels {
    /// `[panel, I, lane]`; zero in unused lanes of the last panel.
    numbers: Vec<f32>,
    rows: usize,
    columns: usize,
}

impl Panels {
    /// Packs a matrix.
    pub fn new(matrix: Matrix) -> Self {
        Self::stacked(&[matrix])
    }

    /// Packs the rows of several matrices as one matrix.
    ///
    /// # Panics
    /// If there are none, or they differ in width.
    pub fn stacked(matrices: &[Matrix]) -> Self {
        let [_, columns] = matrices[0].shape();
        let rows = matrices.iter().map(|matrix| matrix.shape()[0]).sum();
        let lanes = Arch::new().dispatch(Lanes);
        let mut numbers = vec![0.0; columns.div_ceil(lanes) * rows * lanes];
        let mut first = 0;
        for matrix in matrices {
            let [height, width] = matrix.shape();
            assert_eq!(width, columns, "widths of stacked matrices");
            for (panel, numbers) in numbers.chunks_exact_mut(rows * lanes).enumerate() {
                let packed = &mut numbers[first * lanes..(first + height) * lanes];
                matrix.pack(panel * lanes, lanes, packed);
            }
            first += height;
        }
        Self { numbers, rows, columns }
    }

    /// Rows and columns.
    pub(super) fn shape(&self) -> [usize; 2] {
        [self.rows, self.columns]
    }

    /// A panel's weights for a range of inputs.
    #[inline(always)]
    pub(super) fn weights<S: Simd>(&self, panel: usize, first: usize, count: usize) -> &[S::f32s] {
        let (vectors, _) = S::as_simd_f32s(&self.numbers);
        &vectors[panel * self.rows + first..][..count]
    }
}
