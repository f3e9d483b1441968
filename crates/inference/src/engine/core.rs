//! The layers of the core, one panel of units for a few rows at a time.
//!
//! The equations are those of `mlp.rs`, `lstm.rs`, `gru.rs`, `minlstm.rs` and `mingru.rs` in `eddy-learning`'s `model`. All
//! gates of a unit are computed at once, and the unit's new state from them, so that no gate is ever stored.

use std::collections::BTreeMap;

use pulp::Simd;

use super::linear::{Linear, add_products, load};
use crate::{
    checkpoint::{Activation, Core, Description, Form, Weights, layout},
    kernels::{
        gru, lstm,
        math::{elu, relu, sigmoid, tanh},
        minimal::Minimal,
    },
};

/// One layer of the core.
#[derive(Debug)]
pub(super) struct CoreLayer {
    core: Core,
    /// The variant of the minimal recurrences.
    pub(super) minimal: Minimal,
    activation: Activation,
    /// Products with the layer's input, gate by gate.
    input: Vec<Linear>,
    /// LSTM and GRU: products with the layer's last output, gate by gate.
    hidden: Vec<Linear>,
}

/// The new state of a panel of units in R rows.
pub(super) struct UnitState<S: Simd, const R: usize> {
    pub(super) hidden: [S::f32s; R],
    /// LSTM only.
    pub(super) cell: Option<[S::f32s; R]>,
}

impl CoreLayer {
    /// Packs layer number `layer` of the described core.
    pub(super) fn pack(
        lanes: usize,
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
        layer: usize,
    ) -> Self {
        let core = description.core;
        let (mut input, mut hidden) = (Vec::new(), Vec::new());
        for &(part, gates) in layout::core_parts(core) {
            let [weight, bias] = layout::core_names(core, layer, part).map(|name| &tensors[&name]);
            let packed = (0..gates).map(|gate| Linear::pack(lanes, weight, bias, gate, gates));
            if part == "hh" { hidden.extend(packed) } else { input.extend(packed) }
        }
        let Description { form, normalize_gates, frame, .. } = description;
        Self {
            core,
            minimal: Minimal { log: *form == Form::Log, normalize: *normalize_gates },
            activation: frame.activation,
            input,
            hidden,
        }
    }

    /// Number of panels.
    pub(super) fn panels(&self) -> usize {
        self.input[0].panels()
    }

    /// The units of a panel in rows that are padded to whole panels.
    #[inline(always)]
    pub(super) fn padded_units(&self, panel: usize) -> std::ops::Range<usize> {
        self.input[0].padded_outputs(panel)
    }

    /// The units of a panel.
    #[inline(always)]
    pub(super) fn units(&self, panel: usize) -> std::ops::Range<usize> {
        self.input[0].outputs(panel)
    }

    /// Whether its state includes a cell.
    pub(super) fn has_cell(&self) -> bool {
        self.core == Core::Lstm
    }

    /// Sums per unit that are accumulated at once.
    pub(super) fn sums(&self) -> usize {
        self.input.len()
    }

    /// The linear parts.
    pub(super) fn linears(&self) -> impl Iterator<Item = &Linear> {
        self.input.iter().chain(&self.hidden)
    }

    /// The new state of a panel of units from the layer's inputs and its last outputs and cells (rows of all units, or
    /// longer). Each sum is accumulated in K parts, see [`add_products`].
    #[inline(always)]
    pub(super) fn step<S: Simd, const R: usize, const K: usize>(
        &self,
        simd: S,
        panel: usize,
        inputs: [&[f32]; R],
        hidden: [&[f32]; R],
        cells: [&[f32]; R],
    ) -> UnitState<S, R> {
        // Rows may be padded to whole panels.
        let padded = self.padded_units(panel);
        let units = padded.start..padded.end.min(hidden[0].len());
        let mut next = UnitState { hidden: [simd.splat_f32s(0.0); R], cell: None };
        match self.core {
            Core::Mlp => {
                let [sums] = self.gates::<S, 1, R, K>(simd, panel, inputs);
                for (output, sum) in next.hidden.iter_mut().zip(sums) {
                    *output = activate(simd, self.activation, sum);
                }
            }
            Core::MinGru => {
                let [gate, candidate] = self.gates::<S, 2, R, K>(simd, panel, inputs);
                for r in 0..R {
                    let last = load(simd, &hidden[r][units.clone()]);
                    next.hidden[r] = self.minimal.next(simd, [gate[r], candidate[r]], last);
                }
            }
            Core::MinLstm => {
                let [forget, input, candidate] = self.gates::<S, 3, R, K>(simd, panel, inputs);
                for r in 0..R {
                    let last = load(simd, &hidden[r][units.clone()]);
                    let sums = [forget[r], input[r], candidate[r]];
                    next.hidden[r] = self.minimal.next(simd, sums, last);
                }
            }
            Core::Gru => {
                let mut sums = self.gates::<S, 3, R, K>(simd, panel, inputs);
                let mut biases = self.biases::<S, 3, R>(simd, panel);
                // The products for n are kept apart: the reset gate scales those of the state only.
                std::mem::swap(&mut sums[2], &mut biases[2]);
                let input = biases[2];
                add_biases(simd, &mut sums[..2], &biases[..2]);
                let [reset, update, recurrent] =
                    add_products::<S, 3, R, K>(simd, self.recurrent(panel), hidden, sums);
                for r in 0..R {
                    let sums = [reset[r], update[r], input[r], recurrent[r]];
                    let last = load(simd, &hidden[r][units.clone()]);
                    next.hidden[r] = gru::cell(simd, sums, last)[3];
                }
            }
            Core::Lstm => {
                let mut sums = self.gates::<S, 4, R, K>(simd, panel, inputs);
                add_biases(simd, &mut sums, &self.biases::<S, 4, R>(simd, panel));
                let [input, forget, candidate, output] =
                    add_products::<S, 4, R, K>(simd, self.recurrent(panel), hidden, sums);
                let mut cell = [simd.splat_f32s(0.0); R];
                for r in 0..R {
                    let sums = [input[r], forget[r], candidate[r], output[r]];
                    let last = load(simd, &cells[r][units.clone()]);
                    [.., next.hidden[r], cell[r]] = lstm::cell(simd, sums, last);
                }
                next.cell = Some(cell);
            }
        }
        next
    }

    /// The G sums over the input.
    #[inline(always)]
    fn gates<S: Simd, const G: usize, const R: usize, const K: usize>(
        &self,
        simd: S,
        panel: usize,
        inputs: [&[f32]; R],
    ) -> [[S::f32s; R]; G] {
        let mut panels = [[].as_slice(); G];
        let mut sums = [[simd.splat_f32s(0.0); R]; G];
        for (g, linear) in self.input.iter().enumerate() {
            panels[g] = linear.panel(panel);
            sums[g] = linear.bias(simd, panel);
        }
        add_products::<S, G, R, K>(simd, panels, inputs, sums)
    }

    /// The G biases of the products with the last output.
    #[inline(always)]
    fn biases<S: Simd, const G: usize, const R: usize>(
        &self,
        simd: S,
        panel: usize,
    ) -> [[S::f32s; R]; G] {
        let mut biases = [[simd.splat_f32s(0.0); R]; G];
        for (bias, linear) in biases.iter_mut().zip(&self.hidden) {
            *bias = linear.bias(simd, panel);
        }
        biases
    }

    /// The G panels of weights for the last output.
    #[inline(always)]
    fn recurrent<const G: usize>(&self, panel: usize) -> [&[f32]; G] {
        let mut panels = [[].as_slice(); G];
        for (weights, linear) in panels.iter_mut().zip(&self.hidden) {
            *weights = linear.panel(panel);
        }
        panels
    }
}

#[inline(always)]
fn add_biases<S: Simd, const R: usize>(
    simd: S,
    sums: &mut [[S::f32s; R]],
    biases: &[[S::f32s; R]],
) {
    for (sums, biases) in sums.iter_mut().zip(biases) {
        for r in 0..R {
            sums[r] = simd.add_f32s(sums[r], biases[r]);
        }
    }
}

/// Applies an activation function elementwise.
#[inline(always)]
pub(super) fn activate<S: Simd>(simd: S, kind: Activation, x: S::f32s) -> S::f32s {
    match kind {
        Activation::Sigmoid => sigmoid(simd, x),
        Activation::Tanh => tanh(simd, x),
        Activation::Relu => relu(simd, x),
        Activation::Elu => elu(simd, x),
    }
}
