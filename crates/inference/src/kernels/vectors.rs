//! Lists of numbers as SIMD vectors, and elementwise operations on several lists.

use std::ops::Range;

use pulp::{Simd, WithSimd};

/// Queries the number of lanes of an instruction set.
pub struct Lanes;

impl WithSimd for Lanes {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> usize {
        S::F32_LANES
    }
}

/// The range of a vector of a row with this number of columns.
#[inline(always)]
pub fn lanes<S: Simd>(row: usize, vector: usize, columns: usize) -> Range<usize> {
    let first = vector * S::F32_LANES;
    row * columns + first..row * columns + (first + S::F32_LANES).min(columns)
}

/// Loads a vector from a list. Behind `lanes` it contains whatever follows in the list, or zeros: masking would take longer
/// than computing with excess lanes and not storing them.
#[inline(always)]
pub fn load<S: Simd>(simd: S, list: &[f32], lanes: Range<usize>) -> S::f32s {
    match list.get(lanes.start..lanes.start + S::F32_LANES) {
        Some(numbers) => S::as_simd_f32s(numbers).0[0],
        None => simd.partial_load_f32s(&list[lanes]),
    }
}

/// Stores the part of a vector that `lanes` covers; what follows in the list is unchanged.
#[inline(always)]
pub fn store<S: Simd>(simd: S, list: &mut [f32], lanes: Range<usize>, vector: S::f32s) {
    let list = &mut list[lanes];
    if list.len() == S::F32_LANES {
        S::as_mut_simd_f32s(list).0[0] = vector;
    } else {
        simd.partial_store_f32s(list, vector);
    }
}

/// Calls `work` with the vectors of `inputs` and `outputs` at each index, and stores its result in the outputs. All lists
/// have the same length; the last vector is padded with zeros.
#[inline(always)]
pub fn zip<S: Simd, const N: usize, const M: usize>(
    simd: S,
    inputs: [&[f32]; N],
    outputs: [&mut [f32]; M],
    mut work: impl FnMut([S::f32s; N], [S::f32s; M]) -> [S::f32s; M],
) {
    let length = outputs[0].len();
    let zero = simd.splat_f32s(0.0);
    let whole = length - length % S::F32_LANES;
    let mut start = 0;
    while start < length {
        let end = if start < whole { start + S::F32_LANES } else { length };
        let mut from = [zero; N];
        let mut to = [zero; M];
        if start < whole {
            for n in 0..N {
                from[n] = S::as_simd_f32s(&inputs[n][start..end]).0[0];
            }
            for m in 0..M {
                to[m] = S::as_simd_f32s(&outputs[m][start..end]).0[0];
            }
            to = work(from, to);
            for m in 0..M {
                S::as_mut_simd_f32s(&mut outputs[m][start..end]).0[0] = to[m];
            }
        } else {
            for n in 0..N {
                from[n] = simd.partial_load_f32s(&inputs[n][start..end]);
            }
            for m in 0..M {
                to[m] = simd.partial_load_f32s(&outputs[m][start..end]);
            }
            to = work(from, to);
            for m in 0..M {
                simd.partial_store_f32s(&mut outputs[m][start..end], to[m]);
            }
        }
        start = end;
    }
}

/// Splits the columns of a matrix with rows of length `width` into strips of at most `strip` columns; each strip consists of
/// its part of every row.
pub fn strips(values: &mut [f32], width: usize, strip: usize) -> Vec<Vec<&mut [f32]>> {
    let mut strips: Vec<Vec<&mut [f32]>> = Vec::new();
    strips.resize_with(width.div_ceil(strip), Vec::new);
    for row in values.chunks_exact_mut(width) {
        for (strip, part) in strips.iter_mut().zip(row.chunks_mut(strip)) {
            strip.push(part);
        }
    }
    strips
}

#[cfg(test)]
mod tests {
    use pulp::Arch;

    use super::*;

    struct Add<'a>(&'a [f32], &'a mut [f32]);

    impl WithSimd for Add<'_> {
        type Output = ();
        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) {
            zip(simd, [self.0], [self.1], |[x], [y]| [simd.add_f32s(x, y)]);
        }
    }

    #[test]
    fn every_number_is_processed_once() {
        for length in 0..70 {
            let x: Vec<f32> = (0..length).map(|i| i as f32).collect();
            let mut y = vec![1.0; length];
            Arch::new().dispatch(Add(&x, &mut y));
            assert!(y.iter().enumerate().all(|(i, y)| *y == i as f32 + 1.0), "{length}");
        }
    }

    #[test]
    fn strips_contain_every_column_of_every_row() {
        let mut values: Vec<f32> = (0..10).map(|i| i as f32).collect();
        let strips = strips(&mut values, 5, 2);
        let expected = [vec![[0.0, 1.0], [5.0, 6.0]], vec![[2.0, 3.0], [7.0, 8.0]]];
        assert_eq!(strips[0], expected[0]);
        assert_eq!(strips[1], expected[1]);
        assert_eq!(strips[2], [[4.0], [9.0]]);
    }
}
