//! A matrix for products with many small ones: the recurrent weights of a layer, once per frame.
//!
//! A product with a few rows is bound by reading the weights. They are therefore packed once in the order in which they are
//! read: in panels as wide as a SIMD vector, each storing its columns for one inner index after the other.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{
    matrix::{Accumulate, Matrix, multiply, product, sum_rows},
    vectors::Lanes,
};

/// Rows per block, for vectors as long as a cache line and for shorter ones. Each row needs a register.
const ROWS: [usize; 2] = [16, 8];

/// A packed matrix, `[K, N]`.
#[derive(Clone, Debug)]
pub struct Packed {
    /// `[panel, K, lane]`; zero in unused lanes of the last panel.
    panels: Vec<f32>,
    inner: usize,
    columns: usize,
    lanes: usize,
}

impl Packed {
    /// Packs a matrix.
    pub fn new(matrix: Matrix) -> Self {
        let [inner, columns] = matrix.shape();
        let lanes = Arch::new().dispatch(Lanes);
        let mut panels = vec![0.0; columns.div_ceil(lanes) * inner * lanes];
        panels.par_chunks_exact_mut(inner * lanes).enumerate().for_each(|(panel, packed)| {
            let first = panel * lanes;
            for (k, group) in packed.chunks_exact_mut(lanes).enumerate() {
                for (column, value) in (first..columns).zip(group) {
                    *value = matrix.at(k, column);
                }
            }
        });
        Self { panels, inner, columns, lanes }
    }

    /// Adds the product of `rows` `[M, K]` with the matrix to `sums` `[M, N]`.
    pub fn add_product(&self, rows: Matrix, sums: &mut [f32]) {
        let [count, inner] = rows.shape();
        assert!(inner == self.inner && sums.len() == count * self.columns, "{:?}", rows.shape());
        // Inner index first, as the panels have it.
        let rows: Vec<f32> =
            (0..inner).flat_map(|k| (0..count).map(move |row| rows.at(row, k))).collect();
        let mut products = vec![0.0; self.columns.div_ceil(self.lanes) * count * self.lanes];
        products
            .par_chunks_exact_mut(count * self.lanes)
            .zip(self.panels.par_chunks_exact(inner * self.lanes))
            .with_min_len(8)
            .for_each(|(products, panel)| {
                Arch::new().dispatch(Product { panel, rows: &rows, count, products });
            });
        for (panel, products) in products.chunks_exact(count * self.lanes).enumerate() {
            let first = panel * self.lanes;
            let last = (first + self.lanes).min(self.columns);
            let sums = sums.chunks_exact_mut(self.columns);
            for (sums, products) in sums.zip(products.chunks_exact(self.lanes)) {
                for (sum, product) in sums[first..last].iter_mut().zip(products) {
                    *sum += product;
                }
            }
        }
    }
}

/// Number of frames from which packing pays: it takes about as long as two products of 16 rows.
const MIN_FRAMES: usize = 4;

/// Recurrent weights, packed if there are enough frames.
#[derive(Clone, Debug)]
pub enum Recurrent<'a> {
    /// Not packed.
    Plain(Matrix<'a>),
    /// Packed.
    Packed(Packed),
}

impl<'a> Recurrent<'a> {
    /// Weights for products in `frames` frames.
    pub fn new(weight: Matrix<'a>, frames: usize) -> Self {
        if frames < MIN_FRAMES { Self::Plain(weight) } else { Self::Packed(Packed::new(weight)) }
    }

    /// As [`Packed::add_product`].
    pub fn add_product(&self, rows: Matrix, sums: &mut [f32]) {
        match self {
            Self::Plain(weight) => multiply(rows, *weight, sums, Accumulate::Add),
            Self::Packed(packed) => packed.add_product(rows, sums),
        }
    }
}

/// Whether a state, and so its product with the weights, is zero.
pub(crate) fn is_zero(state: &[f32]) -> bool {
    state.iter().all(|&number| number == 0.0)
}

/// The gradients by the recurrent weights, `[H, G]`, and their bias, `[G]`, from those by the products, `[T, R, G]`. The outputs
/// of all frames are in rows of `states`, `stride` numbers apart, those before the first frame, R rows, in such of `initial`.
pub(crate) fn recurrent_gradients(
    states: &[f32],
    initial: &[f32],
    stride: usize,
    by_products: &[f32],
    [rows, width, gates]: [usize; 3],
) -> [Vec<f32>; 2] {
    let (first, rest) = by_products.split_at(rows * gates);
    let later = rest.len() / gates;
    let before = Matrix::with_stride(states, later, width, stride).transposed();
    let mut weight = product(before, Matrix::new(rest, later, gates));
    if !is_zero(initial) {
        let before = Matrix::with_stride(initial, rows, width, stride).transposed();
        multiply(before, Matrix::new(first, rows, gates), &mut weight, Accumulate::Add);
    }
    let mut bias = vec![0.0; gates];
    sum_rows(by_products, &mut bias);
    [weight, bias]
}

/// The product with one panel.
struct Product<'a> {
    /// `[K, lane]`.
    panel: &'a [f32],
    /// `[K, M]`.
    rows: &'a [f32],
    /// M.
    count: usize,
    /// `[M, lane]`.
    products: &'a mut [f32],
}

impl WithSimd for Product<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { panel, rows, count, products } = self;
        let (panel, _) = S::as_simd_f32s(panel);
        let (products, _) = S::as_mut_simd_f32s(products);
        let mut first = 0;
        while first < count {
            let left = count - first;
            if const { S::F32_LANES == 16 } && left >= ROWS[0] {
                block::<S, { ROWS[0] }>(simd, panel, rows, count, first, products);
                first += ROWS[0];
            } else if left >= ROWS[1] {
                block::<S, { ROWS[1] }>(simd, panel, rows, count, first, products);
                first += ROWS[1];
            } else {
                block::<S, 1>(simd, panel, rows, count, first, products);
                first += 1;
            }
        }
    }
}

/// R rows from `first` on.
#[inline(always)]
fn block<S: Simd, const R: usize>(
    simd: S,
    panel: &[S::f32s],
    rows: &[f32],
    count: usize,
    first: usize,
    products: &mut [S::f32s],
) {
    let mut sums = [simd.splat_f32s(0.0); R];
    for (weights, row) in panel.iter().zip(rows.chunks_exact(count)) {
        let (numbers, _) = row[first..first + R].as_chunks::<R>();
        let numbers = &numbers[0];
        for r in 0..R {
            sums[r] = simd.mul_add_e_f32s(*weights, simd.splat_f32s(numbers[r]), sums[r]);
        }
    }
    products[first..first + R].copy_from_slice(&sums);
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn a_packed_product_is_the_product(
            count in 1usize..40,
            inner in 1usize..20,
            columns in 1usize..60,
            transposed: bool,
            seed in proptest::collection::vec(-1f32..1.0, 40 * 20 + 20 * 60),
        ) {
            let (rows, rest) = seed.split_at(count * inner);
            let rows = Matrix::new(rows, count, inner);
            let matrix = if transposed {
                Matrix::new(rest, columns, inner).transposed()
            } else {
                Matrix::new(rest, inner, columns)
            };
            let mut expected = vec![0.5; count * columns];
            let mut found = expected.clone();
            multiply(rows, matrix, &mut expected, Accumulate::Add);
            Packed::new(matrix).add_product(rows, &mut found);
            for (found, expected) in found.iter().zip(&expected) {
                prop_assert!((found - expected).abs() <= 1e-5);
            }
        }
    }
}
