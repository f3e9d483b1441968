//! The network's layers on a block of particles after the grid, in bfloat16 (`particle_blocks` has them in single precision).
//!
//! A layer reads the rounded outputs of the one before. Hidden states and the decoder's outputs are in single precision.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use std::collections::BTreeMap;

use pulp::{Simd as _, cast, f32x16};

use super::{
    bf16::{Bf16, LANES, PairLinear, PairRows, PairSink},
    core::CoreLayer,
    linear::{load, store},
    particle_blocks::GatheredBlock,
    particle_model::BLOCK,
    products::Rows,
};
use crate::{
    checkpoint::{Core, Description, Weights, layout},
    kernels::math::relu,
};

/// Gates of minLSTM; minGRU has two.
const MOST_GATES: usize = 3;

/// The packed layers.
#[derive(Debug)]
pub(super) struct PairBlocks {
    simd: Bf16,
    /// Number of features.
    features: usize,
    context: PairLinear<1>,
    /// The gates of each layer: a panel of each gate, then the next panel of each.
    core: Vec<PairLinear<1>>,
    mixer: PairLinear<1>,
    decoder: PairLinear<1>,
}

/// Buffers between the layers.
#[derive(Debug, Default)]
pub(super) struct PairBuffer {
    /// `[F / 2, BLOCK]`.
    features: Vec<u32>,
    /// `[BLOCK, width / 2]` each.
    signals: [Vec<u32>; 2],
    /// The sums of the gates of a panel of units, `[BLOCK, gates, LANES]`.
    sums: Vec<f32>,
}

impl PairBlocks {
    /// Packs the layers; `None` if the core is not minimal, or if the processor, or an instruction set with vectors of so many lanes, lacks
    /// products of pairs.
    pub(super) fn pack(
        lanes: usize,
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
    ) -> Option<Self> {
        let simd = Bf16::new().filter(|_| lanes == LANES)?;
        let core = description.core;
        if !matches!(core, Core::MinGru | Core::MinLstm) {
            return None;
        }
        let linear = |name| {
            let [weight, bias] = layout::names(name).map(|name| &tensors[&name]);
            PairLinear::pack(weight, bias)
        };
        let gates = |layer| {
            let parts = layout::core_parts(core).iter();
            let named = |&(part, _): &(&str, usize)| {
                layout::core_names(core, layer, part).map(|name| &tensors[&name])
            };
            alternating(&parts.map(named).collect::<Vec<_>>())
        };
        Some(Self {
            simd,
            features: tensors[&layout::names("context")[0]].shape[1],
            context: linear("context"),
            core: (0..description.sizes.layers).map(gates).collect(),
            mixer: linear("mixer"),
            decoder: linear("decoder"),
        })
    }

    /// A buffer for rows of hidden states of length `width`.
    pub(super) fn buffer(&self, width: usize) -> PairBuffer {
        let signal = || vec![0; BLOCK * width / 2];
        PairBuffer {
            features: vec![0; BLOCK * self.features.div_ceil(2)],
            signals: [signal(), signal()],
            sums: vec![0.0; BLOCK * MOST_GATES * LANES],
        }
    }

    /// Context, core, mixer and decoder, whose outputs are written to `residuals`, rows of `length`. `layers` are those of the core.
    #[inline(always)]
    pub(super) fn decode(
        &self,
        layers: &[CoreLayer],
        block: &GatheredBlock<'_>,
        buffer: &mut PairBuffer,
        (residuals, length): (&mut [f32], usize),
    ) {
        let (count, width) = (block.particles.len(), block.width / 2);
        let PairBuffer { features, signals: [input, output], sums } = buffer;
        let (mut input, mut output) = (input, output);
        self.simd.round_columns(block.features, BLOCK, features);
        let rows = PairRows::<BLOCK>::complete(features, 1);
        let own = |row: usize, _: usize| row;
        let mut sink = Signal { pairs: input, width, added: Some(block.gathered) };
        self.simd.apply(&self.context, rows, count, own, &mut sink);
        for (number, (gates, layer)) in self.core.iter().zip(layers).enumerate() {
            let rows = PairRows::<1>::complete(input, width);
            let first_row = number * block.rows;
            if layer.sums() == 2 {
                let mut sink = Gates::<2> { layer, block, first_row, sums, pairs: output };
                self.simd.apply(gates, rows, count, own, &mut sink);
            } else {
                let mut sink = Gates::<MOST_GATES> { layer, block, first_row, sums, pairs: output };
                self.simd.apply(gates, rows, count, own, &mut sink);
            }
            std::mem::swap(&mut input, &mut output);
        }
        let rows = PairRows::<1>::complete(input, width);
        let mut mixed = Signal { pairs: output, width, added: None };
        self.simd.apply(&self.mixer, rows, count, own, &mut mixed);
        let rows = PairRows::<1>::complete(output, width);
        self.simd.apply(&self.decoder, rows, count, own, &mut Residuals(residuals, length));
    }
}

/// Gates `[output, input]` as one layer whose panels are the first of each gate, then the second of each, and so on.
fn alternating(gates: &[[&Weights; 2]]) -> PairLinear<1> {
    let [output, input] = [0, 1].map(|axis| gates[0][0].shape[axis]);
    let (mut weight, mut bias) = (Vec::new(), Vec::new());
    for begin in (0..output).step_by(LANES) {
        for [weights, biases] in gates {
            let end = (begin + LANES).min(output);
            weight.extend_from_slice(&weights.values[begin * input..end * input]);
            bias.extend_from_slice(&biases.values[begin..end]);
            weight.resize(bias.len().next_multiple_of(LANES) * input, 0.0);
            bias.resize(bias.len().next_multiple_of(LANES), 0.0);
        }
    }
    let shape = vec![bias.len(), input];
    let bias = Weights { shape: vec![bias.len()], values: bias };
    PairLinear::pack(&Weights { shape, values: weight }, &bias)
}

/// Rows of signals between layers: ReLU of the outputs, or of their sum with other rows.
struct Signal<'a> {
    pairs: &'a mut [u32],
    /// Length of a row (pairs).
    width: usize,
    added: Option<Rows<'a>>,
}

impl PairSink for Signal<'_> {
    #[inline(always)]
    fn put(&mut self, simd: Bf16, row: usize, first: usize, outputs: f32x16) {
        let wide = simd.without_pairs();
        let outputs = match self.added {
            Some(rows) => {
                let place = row * rows.width + first;
                wide.add_f32s(load(wide, &rows.numbers[place..place + LANES]), outputs)
            }
            None => outputs,
        };
        let place = row * self.width + first / 2;
        simd.round(relu(wide, outputs), &mut self.pairs.as_chunks_mut().0[place * 2 / LANES]);
    }
}

/// Receives the sums of G gates, a panel of each in turn, and computes new outputs with those of the last one.
struct Gates<'a, const G: usize> {
    layer: &'a CoreLayer,
    block: &'a GatheredBlock<'a>,
    /// The layer's first row of hidden states.
    first_row: usize,
    sums: &'a mut [f32],
    pairs: &'a mut [u32],
}

impl<const G: usize> PairSink for Gates<'_, G> {
    #[inline(always)]
    fn put(&mut self, simd: Bf16, row: usize, first: usize, outputs: f32x16) {
        let Self { layer, block, sums, pairs, .. } = self;
        let wide = simd.without_pairs();
        let (gate, unit) = (first / LANES % G, first / LANES / G * LANES);
        let sums = &mut sums.as_chunks_mut::<LANES>().0[row * G..(row + 1) * G];
        sums[gate] = cast(outputs);
        if gate + 1 < G {
            return;
        }
        let begin = (self.first_row + block.particles[row] as usize) * block.width + unit;
        // SAFETY: a particle has one slot, which is in this block.
        let hidden = unsafe { block.hidden.part(begin..begin + LANES) };
        let mut gates = [outputs; G];
        for (gate, sums) in gates.iter_mut().zip(sums) {
            *gate = cast(*sums);
        }
        let next = layer.minimal.next(wide, gates, load(wide, hidden));
        store(wide, hidden, next);
        simd.round(next, &mut pairs.as_chunks_mut().0[(row * block.width + unit) / LANES]);
    }
}

/// Rows of the decoder's outputs, and their length.
struct Residuals<'a>(&'a mut [f32], usize);

impl PairSink for Residuals<'_> {
    #[inline(always)]
    fn put(&mut self, simd: Bf16, row: usize, first: usize, outputs: f32x16) {
        let place = row * self.1 + first;
        store(simd.without_pairs(), &mut self.0[place..place + LANES], outputs);
    }
}
