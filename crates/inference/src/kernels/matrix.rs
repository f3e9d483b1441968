//! Products of matrices.
#![expect(unsafe_code, reason = "calls a matrix product that takes pointers")]

use std::ops::Range;

use gemm::Parallelism;
use pulp::{Arch, Simd, WithSimd};

/// Number of multiplications from which several threads are used.
const LARGE: usize = 1 << 18;

/// A strided view of a matrix.
#[derive(Clone, Copy, Debug)]
pub struct Matrix<'a> {
    values: &'a [f32],
    /// Rows and columns.
    shape: [usize; 2],
    /// Distance between rows and between columns (numbers).
    strides: [usize; 2],
}

impl<'a> Matrix<'a> {
    /// A matrix with contiguous rows.
    ///
    /// # Panics
    /// If there are too few values.
    pub fn new(values: &'a [f32], rows: usize, columns: usize) -> Self {
        Self::with_stride(values, rows, columns, columns)
    }

    /// A matrix whose rows are `stride` numbers apart.
    ///
    /// # Panics
    /// If there are too few values.
    pub fn with_stride(values: &'a [f32], rows: usize, columns: usize, stride: usize) -> Self {
        assert!(
            rows == 0 || values.len() >= (rows - 1) * stride + columns,
            "too few values for the matrix"
        );
        Self { values, shape: [rows, columns], strides: [stride, 1] }
    }

    /// Rows and columns.
    pub fn shape(&self) -> [usize; 2] {
        self.shape
    }

    /// An element.
    #[inline(always)]
    pub fn at(&self, row: usize, column: usize) -> f32 {
        self.values[row * self.strides[0] + column * self.strides[1]]
    }

    /// Copies the columns from `first` on to `packed`, `[rows, lanes]`; lanes beyond the last column are unchanged.
    pub(super) fn pack(&self, first: usize, lanes: usize, packed: &mut [f32]) {
        let ([_, columns], [down, across]) = (self.shape, self.strides);
        let end = columns.min(first + lanes);
        if across == 1 {
            for (row, packed) in packed.chunks_exact_mut(lanes).enumerate() {
                packed[..end - first].copy_from_slice(&self.values[row * down..][first..end]);
            }
            return;
        }
        for (lane, column) in (first..end).enumerate() {
            let numbers = self.values[column * across..].iter().step_by(down);
            packed[lane..]
                .iter_mut()
                .step_by(lanes)
                .zip(numbers)
                .for_each(|(to, from)| *to = *from);
        }
    }

    /// The transpose.
    pub fn transposed(self) -> Self {
        let ([rows, columns], [row, column]) = (self.shape, self.strides);
        Self { shape: [columns, rows], strides: [column, row], ..self }
    }
}

/// What a product does with the previous values of its destination.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Accumulate {
    /// Replaces them.
    Replace,
    /// Adds the product to them.
    Add,
}

/// Writes `a b` to `product`, which has contiguous rows, or adds it.
///
/// # Panics
/// If the shapes do not match.
pub fn multiply(a: Matrix, b: Matrix, product: &mut [f32], accumulate: Accumulate) {
    assert_eq!(product.len(), a.shape[0] * b.shape[1], "shapes {:?}, {:?}", a.shape, b.shape);
    // SAFETY: `product` is large enough and initialised.
    unsafe { gemm(a, b, product.as_mut_ptr(), accumulate, parallelism(a, b)) }
}

/// `a b`, with contiguous rows.
///
/// # Panics
/// If the shapes do not match.
pub fn product(a: Matrix, b: Matrix) -> Vec<f32> {
    let length = a.shape[0] * b.shape[1];
    let mut product = Vec::with_capacity(length);
    // SAFETY: the capacity suffices, and every element is written before it is read.
    unsafe {
        gemm(a, b, product.as_mut_ptr(), Accumulate::Replace, parallelism(a, b));
        product.set_len(length);
    }
    product
}

/// Several threads only for large products.
fn parallelism(a: Matrix, b: Matrix) -> Parallelism {
    let large = a.shape[0] * a.shape[1] * b.shape[1] >= LARGE;
    if large { Parallelism::Rayon(0) } else { Parallelism::None }
}

/// # Safety
/// `product` is large enough and, if the product is added, initialised.
unsafe fn gemm(
    a: Matrix,
    b: Matrix,
    product: *mut f32,
    accumulate: Accumulate,
    parallelism: Parallelism,
) {
    let ([m, k], [inner, n]) = (a.shape, b.shape);
    assert_eq!(k, inner, "shapes {:?}, {:?}", a.shape, b.shape);
    let stride = |strides: [usize; 2], axis: usize| strides[axis] as isize;
    // SAFETY: the shapes match, the views were checked against their lists, and the caller guarantees the product.
    unsafe {
        gemm::gemm(
            m,
            n,
            k,
            product,
            1,
            n as isize,
            accumulate == Accumulate::Add,
            a.values.as_ptr(),
            stride(a.strides, 1),
            stride(a.strides, 0),
            b.values.as_ptr(),
            stride(b.strides, 1),
            stride(b.strides, 0),
            1.0,
            1.0,
            false,
            false,
            false,
            parallelism,
        );
    }
}

/// Adds the rows of a matrix, each of length `sums.len()`, to `sums`.
pub fn sum_rows(values: &[f32], sums: &mut [f32]) {
    Arch::new().dispatch(SumRows { values, sums });
}

struct SumRows<'a> {
    values: &'a [f32],
    sums: &'a mut [f32],
}

impl WithSimd for SumRows<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { values, sums } = self;
        let width = sums.len();
        let mut first = 0;
        while width - first >= 4 * S::F32_LANES {
            sum_columns::<S, 4>(simd, values, sums, first..first + 4 * S::F32_LANES);
            first += 4 * S::F32_LANES;
        }
        while width - first >= S::F32_LANES {
            sum_columns::<S, 1>(simd, values, sums, first..first + S::F32_LANES);
            first += S::F32_LANES;
        }
        if first < width {
            let mut sum = simd.partial_load_f32s(&sums[first..]);
            for row in values.chunks_exact(width) {
                sum = simd.add_f32s(sum, simd.partial_load_f32s(&row[first..]));
            }
            simd.partial_store_f32s(&mut sums[first..], sum);
        }
    }
}

/// V vectors of columns.
#[inline(always)]
fn sum_columns<S: Simd, const V: usize>(
    simd: S,
    values: &[f32],
    sums: &mut [f32],
    columns: Range<usize>,
) {
    let (vectors, _) = S::as_mut_simd_f32s(&mut sums[columns.clone()]);
    let mut sum = [simd.splat_f32s(0.0); V];
    sum.copy_from_slice(vectors);
    for row in values.chunks_exact(sums.len()) {
        let (row, _) = S::as_simd_f32s(&row[columns.clone()]);
        for (sum, &number) in sum.iter_mut().zip(row) {
            *sum = simd.add_f32s(*sum, number);
        }
    }
    let (vectors, _) = S::as_mut_simd_f32s(&mut sums[columns]);
    vectors.copy_from_slice(&sum);
}

/// Rows and columns of a part of a matrix that fits into the nearest cache with its transpose.
const TURNED: usize = 32;

/// The transpose of a matrix of so many columns.
pub fn transposed(matrix: &[f32], columns: usize) -> Vec<f32> {
    let rows = matrix.len() / columns;
    let mut turned = vec![0.0; matrix.len()];
    for first_row in (0..rows).step_by(TURNED) {
        for first_column in (0..columns).step_by(TURNED) {
            for row in first_row..(first_row + TURNED).min(rows) {
                for column in first_column..(first_column + TURNED).min(columns) {
                    turned[column * rows + row] = matrix[row * columns + column];
                }
            }
        }
    }
    turned
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn products_of_strided_and_transposed_matrices() {
        let a = [1.0, 2.0, 9.0, 3.0, 4.0, 9.0]; // rows (1, 2), (3, 4)
        let b = [5.0, 6.0, 7.0, 8.0];
        let a = Matrix::with_stride(&a, 2, 2, 3);
        let mut product = [1.0; 4];
        multiply(a, Matrix::new(&b, 2, 2), &mut product, Accumulate::Replace);
        assert_eq!(product, [19.0, 22.0, 43.0, 50.0]);
        multiply(a.transposed(), Matrix::new(&b, 2, 2), &mut product, Accumulate::Add);
        assert_eq!(product, [19.0 + 26.0, 22.0 + 30.0, 43.0 + 38.0, 50.0 + 44.0]);
    }
}
