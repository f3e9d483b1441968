//! The layers of the core, one panel of units for a few rows at a time.
//!
//! All gates of a unit are computed at once, and the unit's new state from them, so that no gate is ever stored.

use std::collections::BTreeMap;

use pulp::Simd;

use crate::ops::linear::packed::{Linear, add_products, load};
use crate::{
    checkpoint::{Description, Weights},
    ops::cell::{AnyCell, Cell, MAX_SUMS},
    with_cell,
};

/// One layer of the core.
#[derive(Debug)]
pub(super) struct CoreLayer {
    cell: AnyCell,
    has_cell: bool,
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
        let pack = |part: &str, gates| {
            let [weight, bias] = core.tensors(layer, part).map(|name| &tensors[&name]);
            (0..gates).map(move |gate| Linear::pack(lanes, weight, bias, gate, gates))
        };
        Self {
            cell: AnyCell::new(description),
            has_cell: core.states() == 2,
            input: core.input_parts().iter().flat_map(|&(part, gates)| pack(part, gates)).collect(),
            hidden: core
                .recurrent_part()
                .into_iter()
                .flat_map(|part| pack(part, core.gates()))
                .collect(),
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
        self.has_cell
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
        with_cell!(self.cell, |cell, GATES| {
            self.step_cell::<S, _, GATES, R, K>(simd, cell, panel, inputs, hidden, cells)
        })
    }

    /// As [`CoreLayer::step`], with the layer's cell and number of gates.
    #[inline(always)]
    fn step_cell<S: Simd, C: Cell, const G: usize, const R: usize, const K: usize>(
        &self,
        simd: S,
        cell: C,
        panel: usize,
        inputs: [&[f32]; R],
        hidden: [&[f32]; R],
        cells: [&[f32]; R],
    ) -> UnitState<S, R> {
        let core = C::CORE;
        let zeros = [simd.splat_f32s(0.0); R];
        let mut sums = self.gates::<S, G, R, K>(simd, panel, inputs);
        // The split gate's part that depends on the input, while the products with the last output are added to its bias; then
        // they change places.
        let mut split = zeros;
        if core.recurrent_part().is_some() {
            let biases = self.biases::<S, G, R>(simd, panel);
            for (gate, bias) in biases.into_iter().enumerate() {
                if core.split_gate() == Some(gate) {
                    split = std::mem::replace(&mut sums[gate], bias);
                } else {
                    for r in 0..R {
                        sums[gate][r] = simd.add_f32s(sums[gate][r], bias[r]);
                    }
                }
            }
            sums = add_products::<S, G, R, K>(simd, self.recurrent(panel), hidden, sums);
            if let Some(gate) = core.split_gate() {
                std::mem::swap(&mut sums[gate], &mut split);
            }
        }
        // Rows may be padded to whole panels.
        let padded = self.padded_units(panel);
        let units = padded.start..padded.end.min(hidden[0].len());
        let mut next = UnitState { hidden: zeros, cell: (core.states() == 2).then_some(zeros) };
        for r in 0..R {
            let mut own = [zeros[0]; MAX_SUMS];
            for gate in 0..G {
                own[gate] = sums[gate][r];
            }
            if core.split_gate().is_some() {
                own[G] = split[r];
            }
            let mut state = [zeros[0]; 2];
            if core.remembers() {
                state[0] = load(simd, &hidden[r][units.clone()]);
            }
            if next.cell.is_some() {
                state[1] = load(simd, &cells[r][units.clone()]);
            }
            cell.next(simd, &mut own, &mut state);
            next.hidden[r] = state[0];
            if let Some(cell) = &mut next.cell {
                cell[r] = state[1];
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
