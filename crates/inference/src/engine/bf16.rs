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
        __m256, __m256bh, __m256i, __m512, __m512bh, __m512i, _mm256_dpbf16_ps, _mm256_load_ps,
        _mm256_load_si256, _mm256_set1_epi32, _mm512_cvtneps_pbh, _mm512_dpbf16_ps, _mm512_load_ps,
        _mm512_load_si512, _mm512_set1_epi32, _mm512_zextps256_ps512,
    },
    mem::transmute,
    ops::Range,
};

use half::bf16;
use pulp::{cast, f32x16, x86::V4};

use super::linear::Aligned;
use crate::checkpoint::Weights;

/// Numbers in a vector of 512 bits.
pub(super) const LANES: usize = 16;

/// The instruction set: that of [`V4`], and products of pairs.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bf16(V4);

/// A linear layer whose inputs are K concatenated rows.
#[derive(Debug)]
pub(super) struct PairLinear<const K: usize> {
    whole: Panels,
    /// The last outputs if they fill at most half a vector, in vectors of 256 bits
    /// (why: [`SplitLinear`](super::linear::SplitLinear)).
    last: Option<Panels>,
}

/// Outputs in panels as wide as a vector.
#[derive(Debug)]
struct Panels {
    count: usize,
    /// Pairs of a row; the last one of an odd row has a zero.
    pairs: usize,
    /// `[panel, K, pair, lane]`: the bits of pairs.
    weight: Aligned,
    /// `[panel, lane]`.
    bias: Aligned,
}

/// Rows of pairs.
#[derive(Clone, Copy)]
pub(super) struct PairRows<'a> {
    /// `[.., width]`. The last number of a layer's last pair, if rows have an odd number of inputs, is multiplied by zero, so that it must
    /// be finite.
    pub(super) pairs: &'a [u32],
    pub(super) width: usize,
    /// Index of the row of zeros that all larger indices stand for.
    pub(super) zero: usize,
}

/// The outputs of a layer, row by row.
pub(super) trait PairSink {
    /// Receives sixteen outputs of a row from `first` on; those that the layer does not have are zero.
    fn put(&mut self, simd: Bf16, row: usize, first: usize, outputs: f32x16);
}

impl<const K: usize> PairLinear<K> {
    /// Packs a checkpoint's weight, `[output, K * input]`, and bias, `[output]`.
    pub(super) fn pack(weight: &Weights, bias: &Weights) -> Self {
        let output = bias.values.len();
        let half = (1..=LANES / 2).contains(&(output % LANES));
        let before = if half { output - output % LANES } else { output };
        Self {
            whole: Panels::pack::<K>(LANES, weight, bias, 0..before),
            last: half.then(|| Panels::pack::<K>(LANES / 2, weight, bias, before..output)),
        }
    }
}

impl Panels {
    /// Packs some of a layer's outputs.
    fn pack<const K: usize>(
        lanes: usize,
        weight: &Weights,
        bias: &Weights,
        outputs: Range<usize>,
    ) -> Self {
        let (input, count) = (weight.shape[1] / K, outputs.len().div_ceil(lanes));
        let pairs = input.div_ceil(2);
        let mut packed = Aligned::zeros(count * K * pairs * lanes);
        let mut packed_bias = Aligned::zeros(count * lanes);
        packed_bias.get_mut()[..outputs.len()].copy_from_slice(&bias.values[outputs.clone()]);
        for (row, output) in outputs.enumerate() {
            let weights = &weight.values[output * K * input..(output + 1) * K * input];
            for (place, weights) in weights.chunks_exact(input).enumerate() {
                for (pair, weights) in weights.chunks(2).enumerate() {
                    let second = weights.get(1).map_or(0, |&weight| rounded(weight));
                    let group = (row / lanes * K + place) * pairs + pair;
                    packed.get_mut()[group * lanes + row % lanes] =
                        f32::from_bits(rounded(weights[0]) | second << 16);
                }
            }
        }
        Self { count, pairs, weight: packed, bias: packed_bias }
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
    pub(super) fn apply<const K: usize>(
        self,
        linear: &PairLinear<K>,
        rows: PairRows<'_>,
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

/// Compiled with these instructions, and what is inlined into it. Panel by panel, as the rows of a block of nodes stay in the nearest cache:
/// 4 % of a frame faster than row by row.
#[target_feature(enable = "avx512f,avx512bw,avx512cd,avx512dq,avx512vl,avx512bf16")]
#[target_feature(enable = "avx2,fma,bmi1,bmi2,lzcnt,popcnt")]
fn apply<const K: usize>(
    simd: Bf16,
    linear: &PairLinear<K>,
    rows: PairRows<'_>,
    count: usize,
    index: impl Fn(usize, usize) -> usize,
    sink: &mut impl PairSink,
) {
    let PairLinear { whole, last } = linear;
    let mut panel = 0;
    while panel + 1 < whole.count {
        apply_panels::<__m512, K, 2>(simd, (whole, panel), panel, rows, count, &index, sink);
        panel += 2;
    }
    if panel < whole.count {
        apply_panels::<__m512, K, 1>(simd, (whole, panel), panel, rows, count, &index, sink);
    }
    if let Some(last) = last {
        apply_panels::<__m256, K, 1>(simd, (last, 0), whole.count, rows, count, &index, sink);
    }
}

/// G panels of all rows, from a panel on that is number `place` of output rows. Blocks of twelve rows, whose sums fill the registers, then of
/// four.
#[inline(always)]
fn apply_panels<V: Vector, const K: usize, const G: usize>(
    simd: Bf16,
    panels: (&Panels, usize),
    place: usize,
    rows: PairRows<'_>,
    count: usize,
    index: &impl Fn(usize, usize) -> usize,
    sink: &mut impl PairSink,
) {
    let mut first = 0;
    while first < count {
        if count - first >= 12 {
            block::<V, K, G, 12>(simd, panels, place, rows, (first, count), index, sink);
            first += 12;
        } else {
            block::<V, K, G, 4>(simd, panels, place, rows, (first, count), index, sink);
            first += 4;
        }
    }
}

/// G panels of R rows from `first` on; beyond `count` rows, the last one is repeated.
#[inline(always)]
fn block<V: Vector, const K: usize, const G: usize, const R: usize>(
    simd: Bf16,
    (panels, panel): (&Panels, usize),
    place: usize,
    rows: PairRows<'_>,
    (first, count): (usize, usize),
    index: &impl Fn(usize, usize) -> usize,
    sink: &mut impl PairSink,
) {
    let width = panels.pairs;
    let bias = |g: usize| &panels.bias.get()[(panel + g) * V::LANES..][..V::LANES];
    // SAFETY: `apply` runs where the processor has the instructions; panels of biases are as long as a vector and aligned to it.
    let mut sums = [[unsafe { V::load(bias(0)) }; R]; G];
    for (g, sums) in sums.iter_mut().enumerate().skip(1) {
        // SAFETY: as above.
        *sums = [unsafe { V::load(bias(g)) }; R];
    }
    for k in 0..K {
        let mut inputs = [[].as_slice(); R];
        let mut none = true;
        for (r, inputs) in inputs.iter_mut().enumerate() {
            let row = index((first + r).min(count - 1), k).min(rows.zero);
            none &= row == rows.zero;
            *inputs = &rows.pairs[row * rows.width..][..width];
        }
        if !none {
            let mut weights = [[].as_slice(); G];
            for (g, weights) in weights.iter_mut().enumerate() {
                let group = ((panel + g) * K + k) * width;
                *weights = &panels.weight.get()[group * V::LANES..][..width * V::LANES];
            }
            // SAFETY: `apply` runs where the processor has the instructions; panels of weights are aligned to a vector.
            sums = unsafe { add_products(weights, inputs, sums) };
        }
    }
    for g in 0..G {
        for (row, &sums) in (first..count).zip(&sums[g]) {
            // SAFETY: `apply` runs where the processor has the instructions.
            sink.put(simd, row, (place + g) * LANES, unsafe { sums.widened() });
        }
    }
}

/// Adds to `sums` the products of G panels, each `[pair, lane]`, with R rows of as many pairs. A function that returns the sums: they are
/// kept in registers, while a loop in [`block`] stored each of them after every product.
///
/// # Safety
/// The processor must have the instructions of [`apply`], and panels must be aligned to a vector.
#[inline(always)]
unsafe fn add_products<V: Vector, const G: usize, const R: usize>(
    panels: [&[f32]; G],
    rows: [&[u32]; R],
    mut sums: [[V; R]; G],
) -> [[V; R]; G] {
    let width = rows[0].len();
    assert!(rows.iter().all(|row| row.len() == width));
    assert!(panels.iter().all(|panel| panel.len() == width * V::LANES));
    for pair in 0..width {
        // SAFETY: the caller's promises; `pair` is less than `width`, the number of pairs of all rows and panels.
        unsafe {
            let mut weights = [V::pairs(panels[0], pair); G];
            for g in 1..G {
                weights[g] = V::pairs(panels[g], pair);
            }
            for r in 0..R {
                let numbers = V::splat(*rows[r].get_unchecked(pair));
                for g in 0..G {
                    sums[g][r] = sums[g][r].add_products(weights[g], numbers);
                }
            }
        }
    }
    sums
}

/// A vector of sums.
///
/// # Safety
/// The processor must have the instructions of [`apply`]: this holds for all operations.
trait Vector: Copy {
    /// As many pairs as sums.
    type Pairs: Copy;
    const LANES: usize;

    /// Loads a list of as many numbers, which must be aligned to the vector.
    unsafe fn load(numbers: &[f32]) -> Self;
    /// Group number `group` of a packed list, which must have it and be aligned to the vector.
    unsafe fn pairs(list: &[f32], group: usize) -> Self::Pairs;
    unsafe fn splat(pair: u32) -> Self::Pairs;
    /// Adds the two products of each pair to its sum.
    unsafe fn add_products(self, a: Self::Pairs, b: Self::Pairs) -> Self;
    /// With zeros.
    unsafe fn widened(self) -> f32x16;
}

impl Vector for __m512 {
    type Pairs = __m512bh;
    const LANES: usize = LANES;

    #[inline(always)]
    unsafe fn load(numbers: &[f32]) -> Self {
        // SAFETY: the caller's promises.
        unsafe { _mm512_load_ps(numbers.as_ptr()) }
    }

    #[inline(always)]
    unsafe fn pairs(list: &[f32], group: usize) -> __m512bh {
        // SAFETY: the caller's promises; pairs are bits.
        unsafe {
            let group = list.as_ptr().add(group * Self::LANES).cast::<__m512i>();
            transmute::<__m512i, __m512bh>(_mm512_load_si512(group))
        }
    }

    #[inline(always)]
    unsafe fn splat(pair: u32) -> __m512bh {
        // SAFETY: as above.
        unsafe { transmute::<__m512i, __m512bh>(_mm512_set1_epi32(pair.cast_signed())) }
    }

    #[inline(always)]
    unsafe fn add_products(self, a: __m512bh, b: __m512bh) -> Self {
        // SAFETY: the caller's promise.
        unsafe { _mm512_dpbf16_ps(self, a, b) }
    }

    #[inline(always)]
    unsafe fn widened(self) -> f32x16 {
        cast(self)
    }
}

impl Vector for __m256 {
    type Pairs = __m256bh;
    const LANES: usize = LANES / 2;

    #[inline(always)]
    unsafe fn load(numbers: &[f32]) -> Self {
        // SAFETY: the caller's promises.
        unsafe { _mm256_load_ps(numbers.as_ptr()) }
    }

    #[inline(always)]
    unsafe fn pairs(list: &[f32], group: usize) -> __m256bh {
        // SAFETY: the caller's promises; pairs are bits.
        unsafe {
            let group = list.as_ptr().add(group * Self::LANES).cast::<__m256i>();
            transmute::<__m256i, __m256bh>(_mm256_load_si256(group))
        }
    }

    #[inline(always)]
    unsafe fn splat(pair: u32) -> __m256bh {
        // SAFETY: as above.
        unsafe { transmute::<__m256i, __m256bh>(_mm256_set1_epi32(pair.cast_signed())) }
    }

    #[inline(always)]
    unsafe fn add_products(self, a: __m256bh, b: __m256bh) -> Self {
        // SAFETY: the caller's promise.
        unsafe { _mm256_dpbf16_ps(self, a, b) }
    }

    #[inline(always)]
    unsafe fn widened(self) -> f32x16 {
        // SAFETY: the caller's promise.
        cast(unsafe { _mm512_zextps256_ps512(self) })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    const PLACES: usize = 4;

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
            let rows_of_pairs = PairRows { pairs: &pairs, width: width / 2, zero };
            let index = |row: usize, place: usize| match table[row][place] {
                missing if missing == zero => usize::MAX,
                row => row,
            };
            simd.apply(&linear, rows_of_pairs, table.len(), index, &mut outputs);
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
