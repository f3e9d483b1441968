//! Weights packed for streaming, and their products with rows of numbers.
//!
//! The outputs of a layer are split into panels as wide as a SIMD vector. A panel stores, for each input in turn, the
//! weights of all its outputs. Products so read the weights once and sequentially, and each lane accumulates one output:
//! nothing is summed across lanes, and the order of a sum does not depend on the width of the vectors.
#![expect(unsafe_code, reason = "reads without bounds checks in the innermost loop")]

use std::{collections::BTreeMap, ops::Range};

use pulp::Simd;
#[cfg(target_arch = "x86_64")]
use pulp::x86::V3;

use crate::checkpoint::{Weights, layout};

/// Size of a cache line, and of the widest vectors (bytes).
const CACHE_LINE: usize = 64;

/// A buffer aligned to a cache line.
#[derive(Debug)]
pub(crate) struct Aligned {
    numbers: Vec<f32>,
    offset: usize,
    length: usize,
}

impl Aligned {
    /// A buffer of `length` zeros.
    pub(crate) fn zeros(length: usize) -> Self {
        let numbers = vec![0.0f32; length + CACHE_LINE / size_of::<f32>()];
        let offset = numbers.as_ptr().align_offset(CACHE_LINE);
        Self { numbers, offset, length }
    }

    #[inline(always)]
    pub(crate) fn get(&self) -> &[f32] {
        &self.numbers[self.offset..self.offset + self.length]
    }

    pub(crate) fn get_mut(&mut self) -> &mut [f32] {
        &mut self.numbers[self.offset..self.offset + self.length]
    }
}

/// A linear layer, y = W x + b, or a part of its outputs, packed in panels of outputs.
#[derive(Debug)]
pub(crate) struct Linear {
    /// Outputs per panel.
    lanes: usize,
    input: usize,
    /// Place of the first output in output rows.
    first: usize,
    output: usize,
    /// `[panel, input, lane]`; zero in unused lanes of the last panel.
    weight: Aligned,
    /// `[panel, lane]`.
    bias: Aligned,
    /// Number of panels without the last ones whose weights are all zero.
    computed_panels: usize,
}

impl Linear {
    /// Packs part number `part` of `parts` equal parts of the outputs (a gate, if the layer computes several) from a
    /// checkpoint's weight, `[output, input]`, and bias, `[output]`.
    pub(crate) fn pack(
        lanes: usize,
        weight: &Weights,
        bias: &Weights,
        part: usize,
        parts: usize,
    ) -> Self {
        let output = bias.values.len() / parts;
        let rows = part * output..(part + 1) * output;
        Self::pack_rows(lanes, weight, bias, rows, 0)
    }

    /// Packs rows of a weight, whose outputs follow `first` others in output rows.
    fn pack_rows(
        lanes: usize,
        weight: &Weights,
        bias: &Weights,
        rows: Range<usize>,
        first: usize,
    ) -> Self {
        let (input, output) = (weight.shape[1], rows.len());
        let panels = output.div_ceil(lanes);
        let mut packed = Aligned::zeros(panels * input * lanes);
        let mut packed_bias = Aligned::zeros(panels * lanes);
        packed_bias.get_mut()[..output].copy_from_slice(&bias.values[rows.clone()]);
        let rows = weight.values[rows.start * input..rows.end * input].chunks_exact(input);
        for (row, weights) in rows.enumerate() {
            let panel = &mut packed.get_mut()[row / lanes * input * lanes..][..input * lanes];
            for (group, &weight) in panel.chunks_exact_mut(lanes).zip(weights) {
                group[row % lanes] = weight;
            }
        }
        let mut weights = packed.get().chunks_exact((input * lanes).max(1));
        let last = weights.rposition(|panel| panel.iter().any(|&weight| weight != 0.0));
        let computed_panels = last.map_or(0, |last| last + 1);
        Self { lanes, input, first, output, weight: packed, bias: packed_bias, computed_panels }
    }

    /// Packs a layer outside the core by name.
    pub(crate) fn named(lanes: usize, tensors: &BTreeMap<String, Weights>, layer: &str) -> Self {
        let [weight, bias] = layout::names(layer).map(|name| &tensors[&name]);
        Self::pack(lanes, weight, bias, 0, 1)
    }

    /// Number of inputs.
    pub(crate) fn input(&self) -> usize {
        self.input
    }

    /// Number of outputs.
    pub(crate) fn output(&self) -> usize {
        self.output
    }

    /// Number of panels.
    pub(crate) fn panels(&self) -> usize {
        self.output.div_ceil(self.lanes)
    }

    /// The outputs of a panel.
    #[inline(always)]
    pub(crate) fn outputs(&self, panel: usize) -> Range<usize> {
        let Range { start, end } = outputs(panel, self.lanes, self.output);
        self.first + start..self.first + end
    }

    /// The outputs of a panel in rows of all outputs, padded to whole panels.
    #[inline(always)]
    pub(crate) fn padded_outputs(&self, panel: usize) -> Range<usize> {
        self.first + panel * self.lanes..self.first + (panel + 1) * self.lanes
    }

    /// Weights of a panel, `[input, lane]`.
    #[inline(always)]
    pub(crate) fn panel(&self, panel: usize) -> &[f32] {
        let length = self.input * self.lanes;
        &self.weight.get()[panel * length..(panel + 1) * length]
    }

    /// Weights of a panel for a range of inputs.
    #[inline(always)]
    pub(crate) fn inputs(&self, panel: usize, inputs: Range<usize>) -> &[f32] {
        &self.panel(panel)[inputs.start * self.lanes..inputs.end * self.lanes]
    }

    /// Biases of a panel, repeated for R rows.
    #[inline(always)]
    pub(crate) fn bias<S: Simd, const R: usize>(&self, simd: S, panel: usize) -> [S::f32s; R] {
        [load(simd, &self.bias.get()[panel * self.lanes..(panel + 1) * self.lanes]); R]
    }

    /// Number of panels without the last ones whose outputs are their biases, as their weights are all zero (with NaN as an input, too).
    #[inline(always)]
    pub(crate) fn computed_panels(&self) -> usize {
        self.computed_panels
    }

    /// Number of weights, including padding.
    pub(crate) fn weight_count(&self) -> usize {
        self.weight.length
    }
}

/// A linear layer for [`apply`](super::rows::apply). On processors with vectors of 512 bits, last outputs that fill at most half
/// of one are computed in vectors of 256 bits. Where a product of 512 bits takes as long as two of 256 (AMD Zen 4) they take half
/// the time, which is 2 % of a frame of the shipped model: its decoder has 4 outputs, its coarser levels have 40 and 56.
#[derive(Debug)]
pub(crate) struct SplitLinear {
    pub(crate) whole: Linear,
    /// The last outputs, and the instruction set that they are packed for.
    #[cfg(target_arch = "x86_64")]
    pub(crate) last: Option<(V3, Linear)>,
    /// Length of output rows.
    stride: usize,
}

impl SplitLinear {
    /// Packs a checkpoint's weight, `[output, input]`, and bias, `[output]`.
    pub(crate) fn pack(lanes: usize, weight: &Weights, bias: &Weights) -> Self {
        let output = bias.values.len();
        let stride = output.next_multiple_of(lanes);
        #[cfg(target_arch = "x86_64")]
        {
            let before = output - output % lanes;
            let few = lanes == 2 * HALF_LANES && (1..=HALF_LANES).contains(&(output - before));
            if let Some(simd) = V3::try_new().filter(|_| few) {
                let last = Linear::pack_rows(HALF_LANES, weight, bias, before..output, before);
                // Constant outputs cost nothing either way, and whole vectors of them are written and read faster.
                if last.computed_panels() > 0 {
                    let whole = Linear::pack_rows(lanes, weight, bias, 0..before, 0);
                    return Self { whole, last: Some((simd, last)), stride };
                }
            }
        }
        Self {
            whole: Linear::pack(lanes, weight, bias, 0, 1),
            #[cfg(target_arch = "x86_64")]
            last: None,
            stride,
        }
    }

    /// Packs a layer by name.
    pub(crate) fn named(lanes: usize, tensors: &BTreeMap<String, Weights>, layer: &str) -> Self {
        let [weight, bias] = layout::names(layer).map(|name| &tensors[&name]);
        Self::pack(lanes, weight, bias)
    }

    /// Number of inputs.
    pub(crate) fn input(&self) -> usize {
        self.whole.input()
    }

    /// Length of output rows: whole panels of the widest vectors. Numbers behind the outputs are arbitrary.
    pub(crate) fn stride(&self) -> usize {
        self.stride
    }

    /// Number of weights, including padding.
    pub(crate) fn weight_count(&self) -> usize {
        self.stride * self.input()
    }
}

/// Numbers in a vector of 256 bits.
#[cfg(target_arch = "x86_64")]
const HALF_LANES: usize = 8;

/// The outputs of a panel: `lanes`, or fewer in the last one.
#[inline(always)]
pub(crate) fn outputs(panel: usize, lanes: usize, output: usize) -> Range<usize> {
    panel * lanes..((panel + 1) * lanes).min(output)
}

/// Loads a vector, which the last panel of a row may fill only in part.
#[inline(always)]
pub(crate) fn load<S: Simd>(simd: S, row: &[f32]) -> S::f32s {
    match S::as_simd_f32s(row) {
        ([vector], []) => *vector,
        _ => simd.partial_load_f32s(row),
    }
}

/// Stores a vector, of which the last panel of a row may hold only a part.
#[inline(always)]
pub(crate) fn store<S: Simd>(simd: S, row: &mut [f32], numbers: S::f32s) {
    match S::as_mut_simd_f32s(row) {
        ([vector], []) => *vector = numbers,
        (_, _) => simd.partial_store_f32s(row, numbers),
    }
}

/// Adds to `sums` the products of G panels, each `[input, lane]`, with R rows of `input` numbers or more. Each sum is
/// accumulated in K independent parts, input k in part k mod K, which hides the latency of additions.
#[inline(always)]
pub(crate) fn add_products<S: Simd, const G: usize, const R: usize, const K: usize>(
    simd: S,
    panels: [&[f32]; G],
    rows: [&[f32]; R],
    sums: [[S::f32s; R]; G],
) -> [[S::f32s; R]; G] {
    let panels = panels.map(|panel| S::as_simd_f32s(panel).0);
    let width = panels[0].len();
    assert!(rows.iter().all(|row| row.len() >= width));
    assert!(panels.iter().all(|panel| panel.len() == width));

    let mut parts = [[[simd.splat_f32s(0.0); R]; G]; K];
    parts[0] = sums;
    let whole = width - width % K;
    let mut k = 0;
    while k < whole {
        for (part, sums) in parts.iter_mut().enumerate() {
            // SAFETY: k + part < whole <= the length of every panel and row.
            let weights = panels.map(|panel| unsafe { *panel.get_unchecked(k + part) });
            for r in 0..R {
                // SAFETY: as above.
                let number = simd.splat_f32s(unsafe { *rows[r].get_unchecked(k + part) });
                for g in 0..G {
                    sums[g][r] = simd.mul_add_e_f32s(weights[g], number, sums[g][r]);
                }
            }
        }
        k += K;
    }
    for k in whole..width {
        for r in 0..R {
            let number = simd.splat_f32s(rows[r][k]);
            for g in 0..G {
                parts[0][g][r] = simd.mul_add_e_f32s(panels[g][k], number, parts[0][g][r]);
            }
        }
    }
    let mut sums = parts[0];
    for part in &parts[1..] {
        for g in 0..G {
            for r in 0..R {
                sums[g][r] = simd.add_f32s(sums[g][r], part[g][r]);
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use pulp::{Arch, WithSimd};

    use super::{
        super::rows::{Output, Rows, apply},
        *,
    };
    use crate::kernels::vectors::Lanes;

    /// The outputs of a layer, `[rows, output]`, from `[rows, input]`.
    struct Outputs<'a>(&'a SplitLinear, &'a [f32], usize);

    impl WithSimd for Outputs<'_> {
        type Output = Vec<f32>;

        #[inline(always)]
        fn with_simd<S: Simd>(self, simd: S) -> Vec<f32> {
            let Self(layer, numbers, output) = self;
            let (width, stride) = (layer.input(), layer.stride());
            let count = numbers.len() / width;
            let mut outputs = vec![f32::NAN; count * stride];
            let mut sink = Output { numbers: &mut outputs, width: stride, rectify: false };
            apply(simd, layer, count, &Rows { numbers, width }, &mut sink);
            outputs.chunks_exact(stride).flat_map(|row| row[..output].to_vec()).collect()
        }
    }

    proptest! {
        #[test]
        fn outputs_are_those_of_whole_vectors_and_of_plain_sums(
            input in 1usize..20,
            output in 1usize..70,
            count in 1usize..30,
            constant in 0usize..40,
        ) {
            let number = |k: usize| (k * 37 % 101) as f32 / 50.5 - 1.0;
            let mut weight: Vec<_> = (0..output * input).map(number).collect();
            // Weights of the last outputs.
            weight[output.saturating_sub(constant) * input..].fill(0.0);
            let weight = Weights { shape: vec![output, input], values: weight };
            let bias: Vec<_> = (0..output).map(|k| number(k + 5)).collect();
            let bias = Weights { shape: vec![output], values: bias };
            let rows: Vec<_> = (0..count * input).map(|k| number(3 * k + 1)).collect();

            let arch = Arch::new();
            let split = SplitLinear::pack(arch.dispatch(Lanes), &weight, &bias);
            let whole = SplitLinear {
                whole: Linear::pack(arch.dispatch(Lanes), &weight, &bias, 0, 1),
                #[cfg(target_arch = "x86_64")]
                last: None,
                stride: split.stride,
            };
            let found = arch.dispatch(Outputs(&split, &rows, output));
            prop_assert_eq!(&found, &arch.dispatch(Outputs(&whole, &rows, output)));
            let expected = rows.chunks_exact(input).flat_map(|row| {
                bias.values.iter().zip(weight.values.chunks_exact(input)).map(move |(bias, weight)| {
                    weight.iter().zip(row).fold(*bias, |sum, (weight, x)| sum + weight * x)
                })
            });
            for (found, expected) in found.iter().zip(expected) {
                prop_assert!((found - expected).abs() < 1e-5, "{} {}", found, expected);
            }
        }
    }
}
