//! Lists of numbers in vectors, and the same work on every number of several lists.

use std::ops::Range;

use pulp::{Simd, WithSimd};

/// Asks a set of instructions how many numbers its vectors hold.
pub struct Lanes;

impl WithSimd for Lanes {
    type Output = usize;

    #[inline(always)]
    fn with_simd<S: Simd>(self, _: S) -> usize {
        S::F32_LANES
    }
}

/// Where a vector of a row is, of so many columns in all.
#[inline(always)]
pub fn lanes<S: Simd>(row: usize, vector: usize, columns: usize) -> Range<usize> {
    let first = vector * S::F32_LANES;
    row * columns + first..row * columns + (first + S::F32_LANES).min(columns)
}

/// Numbers of a list, as many as a vector holds. Behind `lanes` is whatever follows in the list, or zeros:
/// to leave something out takes longer than to compute with it and not to keep the result.
#[inline(always)]
pub fn load<S: Simd>(simd: S, list: &[f32], lanes: Range<usize>) -> S::f32s {
    match list.get(lanes.start..lanes.start + S::F32_LANES) {
        Some(numbers) => S::as_simd_f32s(numbers).0[0],
        None => simd.partial_load_f32s(&list[lanes]),
    }
}

/// The inverse; what is behind `lanes` stays as it is.
#[inline(always)]
pub fn store<S: Simd>(simd: S, list: &mut [f32], lanes: Range<usize>, vector: S::f32s) {
    let list = &mut list[lanes];
    if list.len() == S::F32_LANES {
        S::as_mut_simd_f32s(list).0[0] = vector;
    } else {
        simd.partial_store_f32s(list, vector);
    }
}

/// Gives `work` the numbers of `inputs` and `outputs` at each index, in vectors, and puts what comes back
/// in the places of the outputs. All lists are equally long; numbers that do not fill a vector are
/// worked on in one that is filled up with zeros.
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

/// A row in G parts of equal length: its gates.
pub fn parts<const G: usize>(row: &[f32]) -> [&[f32]; G] {
    let width = row.len() / G;
    std::array::from_fn(|part| &row[part * width..(part + 1) * width])
}

/// The same, to write.
pub fn parts_mut<const G: usize>(row: &mut [f32]) -> [&mut [f32]; G] {
    let mut parts = row.chunks_exact_mut(row.len() / G);
    std::array::from_fn(|_| parts.next().unwrap_or_default())
}

/// The columns of a matrix with rows of `width` numbers, cut into strips of at most `strip`: for each
/// strip its part of every row.
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
    fn every_number_is_worked_on_once() {
        for length in 0..70 {
            let x: Vec<f32> = (0..length).map(|i| i as f32).collect();
            let mut y = vec![1.0; length];
            Arch::new().dispatch(Add(&x, &mut y));
            assert!(y.iter().enumerate().all(|(i, y)| *y == i as f32 + 1.0), "{length}");
        }
    }

    #[test]
    fn strips_hold_every_column_of_every_row() {
        let mut values: Vec<f32> = (0..10).map(|i| i as f32).collect();
        let strips = strips(&mut values, 5, 2);
        let expected = [vec![[0.0, 1.0], [5.0, 6.0]], vec![[2.0, 3.0], [7.0, 8.0]]];
        assert_eq!(strips[0], expected[0]);
        assert_eq!(strips[1], expected[1]);
        assert_eq!(strips[2], [[4.0], [9.0]]);
    }
}
