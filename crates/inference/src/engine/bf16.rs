//! Linear layers with factors in bfloat16, on processors with AVX-512 BF16: one instruction multiplies twice as many of them as in
//! single precision.
//!
//! Weights and inputs are rounded to eight significant bits; their products and sums are in single precision. Inputs and the
//! weights that they are multiplied with are in pairs, 32 bits each, the first number in the lower half.
#![expect(
    unsafe_code,
    reason = "intrinsics, and reads without bounds checks in the innermost loop"
)]

use std::{
    arch::x86_64::{
        __m256bh, __m256i, __m512, __m512bh, __m512i, _mm512_cvtepu16_epi32, _mm512_cvtneps_pbh,
        _mm512_dpbf16_ps, _mm512_load_ps, _mm512_load_si512, _mm512_or_si512, _mm512_set1_epi32,
        _mm512_slli_epi32,
    },
    mem::transmute,
};

use half::bf16;
use pulp::{cast, f32x16, x86::V4};

use super::linear::Aligned;
use crate::checkpoint::Weights;

/// Numbers in a vector.
pub(super) const LANES: usize = 16;

/// The instruction set: that of [`V4`], and products of pairs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bf16(V4);

/// A linear layer whose inputs are K concatenated rows, packed in panels of sixteen outputs.
#[derive(Debug)]
pub(super) struct PairLinear<const K: usize> {
    panels: usize,
    /// Pairs of a row; the last one of an odd row has a zero.
    pairs: usize,
    /// `[panel, K, pair, lane]`: the bits of pairs; zero in unused lanes of the last panel.
    weight: Aligned,
    /// `[panel, lane]`.
    bias: Aligned,
}

/// Rows whose pairs are STEP apart.
#[derive(Clone, Copy)]
pub(super) struct PairRows<'a, const STEP: usize = 1> {
    /// A row begins every `width` pairs. The last number of a layer's last pair, if rows have an odd number of inputs, is multiplied by
    /// zero, so that it must be finite.
    pub(super) pairs: &'a [u32],
    pub(super) width: usize,
    /// Index of the row of zeros that all larger indices stand for.
    pub(super) zero: usize,
}

impl<'a, const STEP: usize> PairRows<'a, STEP> {
    /// Rows of which none is missing.
    pub(super) fn complete(pairs: &'a [u32], width: usize) -> Self {
        Self { pairs, width, zero: usize::MAX }
    }
}

/// The outputs of a layer, row by row.
pub(super) trait PairSink {
    /// Receives sixteen outputs of a row from `first` on; those that the layer does not have are zero.
    fn put(&mut self, simd: Bf16, row: usize, first: usize, outputs: f32x16);
}

impl<const K: usize> PairLinear<K> {
    /// Packs a checkpoint's weight, `[output, K * input]`, and bias, `[output]`.
    pub(super) fn pack(weight: &Weights, bias: &Weights) -> Self {
        let (input, output) = (weight.shape[1] / K, bias.values.len());
        let (panels, pairs) = (output.div_ceil(LANES), input.div_ceil(2));
        let mut packed = Aligned::zeros(panels * K * pairs * LANES);
        let mut packed_bias = Aligned::zeros(panels * LANES);
        packed_bias.get_mut()[..output].copy_from_slice(&bias.values);
        for (row, weights) in weight.values.chunks_exact(K * input).enumerate() {
            for (place, weights) in weights.chunks_exact(input).enumerate() {
                for (pair, weights) in weights.chunks(2).enumerate() {
                    let second = weights.get(1).map_or(0, |&weight| rounded(weight));
                    let group = (row / LANES * K + place) * pairs + pair;
                    packed.get_mut()[group * LANES + row % LANES] =
                        f32::from_bits(rounded(weights[0]) | second << 16);
                }
            }
        }
        Self { panels, pairs, weight: packed, bias: packed_bias }
    }
}

/// The nearest number in bfloat16.
fn rounded(number: f32) -> u32 {
    bf16::from_f32(number).to_bits().into()
}

impl Bf16 {
    /// The instruction set, if the processor has it.
    pub(super) fn new() -> Option<Self> {
        V4::try_new().filter(|_| is_x86_feature_detected!("avx512bf16")).map(Self)
    }

    /// The instruction set without products of pairs.
    #[inline(always)]
    pub(super) fn without_pairs(self) -> V4 {
        self.0
    }

    /// Applies a layer to `count` rows; `index` gives the K concatenated rows of each, by row and place.
    #[inline(always)]
    pub(super) fn apply<const K: usize, const STEP: usize>(
        self,
        linear: &PairLinear<K>,
        rows: PairRows<'_, STEP>,
        count: usize,
        index: impl Fn(usize, usize) -> usize,
        sink: &mut impl PairSink,
    ) {
        // SAFETY: the processor has these instructions.
        unsafe { apply(self, linear, rows, count, index, sink) }
    }

    /// Rounds lists of numbers.
    #[inline(always)]
    pub(super) fn round_all(self, numbers: &[[f32; LANES]], pairs: &mut [[u32; LANES / 2]]) {
        // SAFETY: the processor has these instructions.
        unsafe { round_all(self, numbers, pairs) }
    }

    /// Rounds columns of `length` numbers, a multiple of sixteen, to columns of pairs, each of two columns; the last of an odd number of
    /// columns has zeros beside it.
    #[inline(always)]
    pub(super) fn round_columns(self, columns: &[f32], length: usize, pairs: &mut [u32]) {
        // SAFETY: the processor has these instructions.
        unsafe { round_columns(columns, length, pairs) }
    }

    /// Rounds numbers to eight pairs. Inlined only into what is compiled with these instructions, as sinks are.
    #[inline(always)]
    pub(super) fn round(self, numbers: f32x16, pairs: &mut [u32; LANES / 2]) {
        // SAFETY: the processor has these instructions; eight pairs are as long as a vector of 256 bits.
        unsafe {
            let rounded = _mm512_cvtneps_pbh(cast(numbers));
            (&raw mut *pairs).cast::<__m256bh>().write_unaligned(rounded);
        }
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512bf16")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
fn round_all(simd: Bf16, numbers: &[[f32; LANES]], pairs: &mut [[u32; LANES / 2]]) {
    for (&numbers, pairs) in numbers.iter().zip(pairs) {
        simd.round(cast(numbers), pairs);
    }
}

#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512bf16")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
fn round_columns(columns: &[f32], length: usize, pairs: &mut [u32]) {
    let widened = |numbers: [f32; LANES]| {
        let rounded = _mm512_cvtneps_pbh(cast(numbers));
        // SAFETY: both are sixteen numbers of 16 bits.
        _mm512_cvtepu16_epi32(unsafe { transmute::<__m256bh, __m256i>(rounded) })
    };
    for (columns, pairs) in columns.chunks(2 * length).zip(pairs.chunks_exact_mut(length)) {
        let (first, second) = columns.split_at(length);
        let second = second.as_chunks().0;
        let places = pairs.as_chunks_mut::<LANES>().0.iter_mut().zip(first.as_chunks().0);
        for (place, (pairs, &first)) in places.enumerate() {
            let second = widened(second.get(place).copied().unwrap_or_default());
            let both = _mm512_or_si512(widened(first), _mm512_slli_epi32::<16>(second));
            // SAFETY: both have 512 bits.
            *pairs = unsafe { transmute::<__m512i, [u32; LANES]>(both) };
        }
    }
}

/// Compiled with these instructions, and what is inlined into it. Panel by panel, as the rows of a block of nodes stay in the nearest cache:
/// 4 % of a frame faster than row by row.
#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512bf16")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
fn apply<const K: usize, const STEP: usize>(
    simd: Bf16,
    linear: &PairLinear<K>,
    rows: PairRows<'_, STEP>,
    count: usize,
    index: impl Fn(usize, usize) -> usize,
    sink: &mut impl PairSink,
) {
    let mut panel = 0;
    while panel < linear.panels {
        let two = panel + 1 < linear.panels;
        let mut first = 0;
        while first < count {
            let (many, block) = (count - first >= 12, (first, count));
            match (two, many) {
                (true, true) => {
                    apply_block::<K, STEP, 2, 12>(simd, linear, panel, rows, block, &index, sink);
                }
                (true, false) => {
                    apply_block::<K, STEP, 2, 4>(simd, linear, panel, rows, block, &index, sink);
                }
                (false, true) => {
                    apply_block::<K, STEP, 1, 12>(simd, linear, panel, rows, block, &index, sink);
                }
                (false, false) => {
                    apply_block::<K, STEP, 1, 4>(simd, linear, panel, rows, block, &index, sink);
                }
            }
            first += if many { 12 } else { 4 };
        }
        panel += if two { 2 } else { 1 };
    }
}

/// G panels of R rows from `first` on; beyond `count` rows, the last one is repeated.
#[inline(always)]
fn apply_block<const K: usize, const STEP: usize, const G: usize, const R: usize>(
    simd: Bf16,
    linear: &PairLinear<K>,
    panel: usize,
    rows: PairRows<'_, STEP>,
    (first, count): (usize, usize),
    index: &impl Fn(usize, usize) -> usize,
    sink: &mut impl PairSink,
) {
    let width = linear.pairs;
    let bias = |g: usize| {
        let bias = &linear.bias.get()[(panel + g) * LANES..][..LANES];
        // SAFETY: `apply` runs where the processor has the instruction; panels of biases are as long as a vector and aligned to it.
        unsafe { _mm512_load_ps(bias.as_ptr()) }
    };
    let mut sums = [[bias(0); R]; G];
    for (g, sums) in sums.iter_mut().enumerate().skip(1) {
        *sums = [bias(g); R];
    }
    for k in 0..K {
        let mut inputs = [[].as_slice(); R];
        let mut none = true;
        for (r, inputs) in inputs.iter_mut().enumerate() {
            let row = index((first + r).min(count - 1), k).min(rows.zero);
            none &= row == rows.zero;
            *inputs = &rows.pairs[row * rows.width..][..(width - 1) * STEP + 1];
        }
        if !none {
            let mut weights = [[].as_slice(); G];
            for (g, weights) in weights.iter_mut().enumerate() {
                let group = ((panel + g) * K + k) * width;
                *weights = &linear.weight.get()[group * LANES..][..width * LANES];
            }
            // SAFETY: `apply` runs where the processor has the instructions; panels of weights are aligned to a vector.
            sums = unsafe { add_products::<STEP, G, R>(weights, inputs, sums) };
        }
    }
    for g in 0..G {
        for (row, &sums) in (first..count).zip(&sums[g]) {
            sink.put(simd, row, (panel + g) * LANES, cast(sums));
        }
    }
}

/// Adds to `sums` the products of G panels, each `[pair, lane]`, with R rows of as many pairs, STEP apart. A function that returns the sums: they are
/// kept in registers, while a loop in [`apply_block`] stored each of them after every product.
///
/// # Safety
/// The processor must have the instructions of [`apply`], and panels must be aligned to a vector.
#[inline(always)]
unsafe fn add_products<const STEP: usize, const G: usize, const R: usize>(
    panels: [&[f32]; G],
    rows: [&[u32]; R],
    mut sums: [[__m512; R]; G],
) -> [[__m512; R]; G] {
    let width = panels[0].len() / LANES;
    assert!(panels.iter().all(|panel| panel.len() == width * LANES));
    assert!(rows.iter().all(|row| width > 0 && row.len() > (width - 1) * STEP));
    for pair in 0..width {
        // SAFETY: the caller's promises; panels have `width` vectors, and `pair * STEP` is at most `(width - 1) * STEP`, which is less than
        // the length of every row.
        unsafe {
            let weights = panels
                .map(|panel| _mm512_load_si512(panel.as_ptr().add(pair * LANES).cast::<__m512i>()));
            for r in 0..R {
                let numbers = _mm512_set1_epi32(rows[r].get_unchecked(pair * STEP).cast_signed());
                let numbers = transmute::<__m512i, __m512bh>(numbers);
                for g in 0..G {
                    let weights = transmute::<__m512i, __m512bh>(weights[g]);
                    sums[g][r] = _mm512_dpbf16_ps(sums[g][r], weights, numbers);
                }
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PLACES: usize = 4;
    /// Length of a column.
    const COLUMN: usize = 32;

    /// Receives outputs, `[row, width]`.
    struct Outputs(Vec<f32>, usize);

    impl PairSink for Outputs {
        fn put(&mut self, _: Bf16, row: usize, first: usize, outputs: f32x16) {
            let outputs: [f32; LANES] = cast(outputs);
            self.0[row * self.1 + first..][..LANES].copy_from_slice(&outputs);
        }
    }

    fn matrix(rows: usize, columns: usize) -> impl Strategy<Value = Vec<f32>> {
        prop::collection::vec(-3.0f32..3.0, rows * columns)
    }

    /// Sizes, weight, bias, rows, and the rows that each row of inputs consists of; the number of rows stands for a missing one.
    fn layers() -> impl Strategy<Value = ([usize; 2], [Vec<f32>; 3], Vec<[usize; PLACES]>)> {
        (1..40usize, 1..70usize, 1..9usize, 1..40usize).prop_flat_map(
            |(input, output, rows, count)| {
                let numbers =
                    [matrix(output, PLACES * input), matrix(output, 1), matrix(rows, input)];
                let index = prop::array::uniform4(0..=rows);
                (Just([input, output]), numbers, prop::collection::vec(index, count))
            },
        )
    }

    proptest! {
        #[test]
        fn layers_are_sums_of_products_of_rounded_factors(
            ([input, output], [weight, bias, rows], table) in layers(),
        ) {
            let Some(simd) = Bf16::new() else {
                prop_assert!(!is_x86_feature_detected!("avx512bf16"));
                return Ok(());
            };
            let round = |number: f32| f64::from(bf16::from_f32(number).to_f32());
            let zero = rows.len() / input;
            let width = input.next_multiple_of(LANES);
            let mut pairs = vec![0; (zero + 1) * width / 2];
            for (row, pairs) in rows.chunks(input).zip(pairs.chunks_mut(width / 2)) {
                let mut padded = row.to_vec();
                padded.resize(width, 3.0);
                for (numbers, pairs) in padded.as_chunks().0.iter().zip(pairs.as_chunks_mut().0) {
                    simd.round(cast::<[f32; LANES], _>(*numbers), pairs);
                }
            }
            let shape = vec![output, PLACES * input];
            let linear = PairLinear::<PLACES>::pack(
                &Weights { shape, values: weight.clone() },
                &Weights { shape: vec![output], values: bias.clone() },
            );
            let stride = output.next_multiple_of(LANES);
            let mut outputs = Outputs(vec![f32::NAN; table.len() * stride], stride);
            let rows_of_pairs = PairRows::<1> { pairs: &pairs, width: width / 2, zero };
            // The same rows as columns, and columns of zeros.
            let mut columns = vec![0.0; input * COLUMN];
            for (row, numbers) in rows.chunks(input).enumerate() {
                for (k, &number) in numbers.iter().enumerate() {
                    columns[k * COLUMN + row] = number;
                }
            }
            let mut pairs_of_columns = vec![u32::MAX; input.div_ceil(2) * COLUMN];
            simd.round_columns(&columns, COLUMN, &mut pairs_of_columns);
            let columns = PairRows::<COLUMN> { pairs: &pairs_of_columns, width: 1, zero };
            let index = |row: usize, place: usize| match table[row][place] {
                missing if missing == zero => usize::MAX,
                row => row,
            };
            simd.apply(&linear, rows_of_pairs, table.len(), index, &mut outputs);
            let mut of_columns = Outputs(vec![f32::NAN; table.len() * stride], stride);
            simd.apply(&linear, columns, table.len(), index, &mut of_columns);
            prop_assert_eq!(&of_columns.0, &outputs.0);
            for (places, outputs) in table.iter().zip(outputs.0.chunks(stride)) {
                for (unit, &found) in outputs.iter().enumerate() {
                    let expected = bias.get(unit).map_or(0.0, |&bias| {
                        let products = (0..PLACES * input).filter_map(|k| {
                            let row = rows.chunks(input).nth(places[k / input])?;
                            Some(round(weight[unit * PLACES * input + k]) * round(row[k % input]))
                        });
                        f64::from(bias) + products.sum::<f64>()
                    });
                    prop_assert!((f64::from(found) - expected).abs() < 1e-3, "{found}, {expected}");
                }
            }
        }
    }
}
