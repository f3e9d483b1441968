//! Weights packed for streaming, and their products with rows of numbers.
//!
//! The outputs of a layer are cut into panels as wide as a vector of this processor. A panel holds, for
//! each input in turn, its weights to all outputs of the panel, so that products read the weights once
//! and in the order in which they lie in memory, and a lane sums up one output: nothing is summed
//! across lanes, and the order of a sum does not depend on the width of the vectors.
#![expect(unsafe_code, reason = "reads without bounds checks in the innermost loop")]

use std::collections::BTreeMap;

use pulp::Simd;

use crate::checkpoint::{Weights, layout};

/// Bytes of a cache line, which the widest vectors fill.
const LINE: usize = 64;

/// Numbers that begin at a cache line.
#[derive(Debug)]
pub(super) struct Aligned {
    numbers: Vec<f32>,
    offset: usize,
    length: usize,
}

impl Aligned {
    /// So many zeros.
    pub(super) fn zeros(length: usize) -> Self {
        let numbers = vec![0.0f32; length + LINE / size_of::<f32>()];
        let offset = numbers.as_ptr().align_offset(LINE);
        Self { numbers, offset, length }
    }

    #[inline(always)]
    pub(super) fn get(&self) -> &[f32] {
        &self.numbers[self.offset..self.offset + self.length]
    }

    pub(super) fn get_mut(&mut self) -> &mut [f32] {
        &mut self.numbers[self.offset..self.offset + self.length]
    }
}

/// Outputs of a linear layer, y = W x + b, in panels.
#[derive(Debug)]
pub(super) struct Linear {
    /// Outputs of a panel.
    lanes: usize,
    input: usize,
    output: usize,
    /// `[panel, input, lane]`; zero where the last panel reaches beyond the outputs.
    weight: Aligned,
    /// `[panel, lane]`.
    bias: Aligned,
}

impl Linear {
    /// Packs part number `part` of `parts` equal ones of the outputs (a gate, where the layer computes
    /// several) from a checkpoint's weight `[output, input]` and bias `[output]`.
    pub(super) fn pack(
        lanes: usize,
        weight: &Weights,
        bias: &Weights,
        part: usize,
        parts: usize,
    ) -> Self {
        let input = weight.shape[1];
        let output = bias.values.len() / parts;
        let panels = output.div_ceil(lanes);
        let mut packed = Aligned::zeros(panels * input * lanes);
        let mut packed_bias = Aligned::zeros(panels * lanes);
        let first = part * output;
        packed_bias.get_mut()[..output].copy_from_slice(&bias.values[first..first + output]);
        let rows = weight.values[first * input..(first + output) * input].chunks_exact(input);
        for (row, weights) in rows.enumerate() {
            let panel = &mut packed.get_mut()[row / lanes * input * lanes..][..input * lanes];
            for (group, &weight) in panel.chunks_exact_mut(lanes).zip(weights) {
                group[row % lanes] = weight;
            }
        }
        Self { lanes, input, output, weight: packed, bias: packed_bias }
    }

    /// Packs a layer outside the core by its name.
    pub(super) fn named(lanes: usize, tensors: &BTreeMap<String, Weights>, layer: &str) -> Self {
        let [weight, bias] = layout::names(layer).map(|name| &tensors[&name]);
        Self::pack(lanes, weight, bias, 0, 1)
    }

    /// Number of inputs.
    pub(super) fn input(&self) -> usize {
        self.input
    }

    /// Number of outputs.
    pub(super) fn output(&self) -> usize {
        self.output
    }

    /// Number of panels.
    pub(super) fn panels(&self) -> usize {
        self.output.div_ceil(self.lanes)
    }

    /// The outputs of a panel.
    #[inline(always)]
    pub(super) fn outputs(&self, panel: usize) -> std::ops::Range<usize> {
        outputs(panel, self.lanes, self.output)
    }

    /// The outputs of a panel where rows are as long as all panels are.
    #[inline(always)]
    pub(super) fn places(&self, panel: usize) -> std::ops::Range<usize> {
        panel * self.lanes..(panel + 1) * self.lanes
    }

    /// Length of rows that have a place for each lane of each panel; those of no output come out as zero.
    pub(super) fn stride(&self) -> usize {
        self.panels() * self.lanes
    }

    /// Weights of a panel, `[input, lane]`.
    #[inline(always)]
    pub(super) fn panel(&self, panel: usize) -> &[f32] {
        let length = self.input * self.lanes;
        &self.weight.get()[panel * length..(panel + 1) * length]
    }

    /// Weights of a panel to some of its inputs.
    #[inline(always)]
    pub(super) fn inputs(&self, panel: usize, inputs: std::ops::Range<usize>) -> &[f32] {
        &self.panel(panel)[inputs.start * self.lanes..inputs.end * self.lanes]
    }

    /// Biases of a panel, for R rows.
    #[inline(always)]
    pub(super) fn bias<S: Simd, const R: usize>(&self, simd: S, panel: usize) -> [S::f32s; R] {
        [load(simd, &self.bias.get()[panel * self.lanes..(panel + 1) * self.lanes]); R]
    }

    /// How many numbers one pass over the weights reads.
    pub(super) fn numbers(&self) -> usize {
        self.weight.length
    }
}

/// The outputs of a panel: `lanes` of them, fewer in the last one.
#[inline(always)]
pub(super) fn outputs(panel: usize, lanes: usize, output: usize) -> std::ops::Range<usize> {
    panel * lanes..((panel + 1) * lanes).min(output)
}

/// The numbers of a panel in some row: a whole vector where it is full.
#[inline(always)]
pub(super) fn load<S: Simd>(simd: S, row: &[f32]) -> S::f32s {
    match S::as_simd_f32s(row) {
        ([vector], []) => *vector,
        _ => simd.partial_load_f32s(row),
    }
}

/// The inverse.
#[inline(always)]
pub(super) fn store<S: Simd>(simd: S, row: &mut [f32], numbers: S::f32s) {
    match S::as_mut_simd_f32s(row) {
        ([vector], []) => *vector = numbers,
        (_, _) => simd.partial_store_f32s(row, numbers),
    }
}

/// Adds to `sums` the products of G panels, each `[input, lane]`, with R rows of `input` numbers or more. Every
/// sum is in K parts, input k in part k mod K: independent, so that the processor need not wait for
/// one addition before it begins the next.
#[inline(always)]
pub(super) fn add_products<S: Simd, const G: usize, const R: usize, const K: usize>(
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
