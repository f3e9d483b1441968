//! The network's layers on a block of particles: before their outputs are summed on the grid, and after it is gathered.
//!
//! A fused form of the plan: what is between the layers of a block stays in the nearest cache. With all particles as one block, a frame takes 3 %
//! longer for 2,500 particles, 4 to 9 % for 10,000 to 40,000; with whole lists as in training, ten times as long (one thread).
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use pulp::Simd;

use super::{
    core::CoreLayer,
    particle_model::{BLOCK, LayerBuffers, ParticleModel, StepContext},
};
use crate::{
    checkpoint::grid::{READ, WRITTEN},
    kernels::nodes::range,
    ops::{
        ballistic::Motion,
        decoder::ResidualStep,
        features::ballistic_motion,
        linear::{
            packed::store,
            rows::{Columns, Output, Rows, Sum, apply},
        },
        transfer::gather,
    },
};

/// Outputs of the decoder.
const OUTPUTS: usize = 4;

impl StepContext<'_> {
    /// The slots of an item.
    #[inline(always)]
    fn block(&self, item: usize) -> std::ops::Range<usize> {
        item * BLOCK..((item + 1) * BLOCK).min(self.nodes.order().len())
    }

    /// Features, encoder, and the block's sums on the nodes (P2G).
    #[inline(always)]
    pub(super) fn encode<S: Simd>(&self, simd: S, item: usize, thread: usize) {
        let ParticleModel { features, encoder, .. } = self.model;
        let block = self.block(item);
        let particles = &self.nodes.order()[block.clone()];
        let (count, stride, length) = (block.len(), encoder.stride(), self.model.columns());
        let sums = self.segments.sums(item);
        // SAFETY: no other running item has this thread number or this block.
        let (buffers, columns, motions, sums) = unsafe {
            (
                &mut self.buffers.part(thread..thread + 1)[0],
                self.features.part(item * length..(item + 1) * length),
                self.ballistic_motion.part(block),
                self.sums.part(sums.start * stride..sums.end * stride),
            )
        };
        let LayerBuffers { output: encoded, states, .. } = buffers;
        features.fill(
            simd,
            &self.inputs,
            particles,
            #[inline(always)]
            |particle| match self.begun {
                // SAFETY: a particle has one slot, which is in this block.
                true => unsafe { self.expected_velocity.read(particle..particle + 1)[0] },
                false => self.inputs.velocity[particle],
            },
            (states, BLOCK),
            columns,
        );
        for (place, motion) in motions.iter_mut().enumerate() {
            *motion = ballistic_motion(states, BLOCK, place);
        }
        for (&particle, motion) in particles.iter().zip(&*motions) {
            let particle = particle as usize;
            // SAFETY: as above.
            unsafe { self.expected_velocity.part(particle..particle + 1)[0] = motion.1 };
        }

        let input = Columns { numbers: columns, length: BLOCK };
        let mut output = Output { numbers: encoded, width: stride, rectify: true };
        apply(simd, encoder, count, &input, &mut output);
        self.segments.add(simd, self.nodes, item, encoded, stride, sums);
    }

    /// The inputs of a row of nodes, from the sums of the blocks.
    #[inline(always)]
    pub(super) fn to_nodes<S: Simd>(&self, simd: S, item: usize) {
        let Self { model: ParticleModel { grid, .. }, walls, nodes, segments, .. } = self;
        let (row, width) = (&nodes.rows()[item], grid.written_width());
        let own = range(row.nodes);
        // SAFETY: this stage only reads the segments' sums, and only this item has these nodes.
        let (sums, written) = unsafe {
            let written = &self.lists.numbers[WRITTEN];
            let own = written.part(own.start * width..own.end * width);
            (self.sums.read(0..self.sums.len()), own)
        };
        walls.write(simd, nodes, row, (segments, sums), grid.encoded, (written, width));
    }

    /// Gathers from the nodes (G2P), then context, core, decoder, and the predicted motion.
    #[inline(always)]
    pub(super) fn decode<S: Simd>(&self, simd: S, item: usize, thread: usize) {
        let model = self.model;
        let (block, channels, width) = (self.block(item), model.grid.read_width(), self.width);
        let particles = &self.nodes.order()[block.clone()];
        let (count, length) = (block.len(), model.columns());
        let field = &self.lists.numbers[READ];
        // SAFETY: no other running item has this thread number, and this stage only reads the other lists.
        let (buffers, columns, ballistic_motion, field) = unsafe {
            (
                &mut self.buffers.part(thread..thread + 1)[0],
                self.features.read(item * length..(item + 1) * length),
                self.ballistic_motion.read(block.clone()),
                field.read(0..self.nodes.level(0).len() * channels),
            )
        };
        let LayerBuffers { input, output, states: new_cells } = buffers;
        gather(
            simd,
            self.nodes,
            block.clone(),
            field,
            channels,
            #[inline(always)]
            |slot| slot - block.start,
            input,
        );
        let gathered = Rows { numbers: input, width: channels };
        let features = Columns { numbers: columns, length: BLOCK };
        let mut sink = Sum { numbers: output, width, added: gathered };
        apply(simd, &model.context, count, &features, &mut sink);
        std::mem::swap(input, output);

        for (number, layer) in model.core.iter().enumerate() {
            let (first, sums) = (number * self.nodes.order().len(), layer.sums());
            // As many rows as keep the sums of all gates in registers.
            let (layer, new) = ((layer, first), (&mut **output, &mut **new_cells));
            if const { S::REGISTER_COUNT >= 32 } {
                match sums {
                    ..=2 => self.core_layer::<S, 12>(simd, layer, particles, input, new),
                    _ => self.core_layer::<S, 6>(simd, layer, particles, input, new),
                }
            } else {
                match sums {
                    ..=2 => self.core_layer::<S, 6>(simd, layer, particles, input, new),
                    _ => self.core_layer::<S, 3>(simd, layer, particles, input, new),
                }
            }
            std::mem::swap(input, output);
        }
        let signal = Rows { numbers: input, width };
        let mut mixed = Output { numbers: output, width: model.mixer.stride(), rectify: true };
        apply(simd, &model.mixer, count, &signal, &mut mixed);
        let signal = Rows { numbers: output, width: model.mixer.stride() };
        let length = model.decoder.stride();
        let mut residuals = Output { numbers: input, width: length, rectify: false };
        apply(simd, &model.decoder, count, &signal, &mut residuals);

        self.predict(particles, ballistic_motion, input);
    }

    /// Adds the decoder's `residuals` to the ballistic motion of particles.
    #[inline(always)]
    fn predict(&self, particles: &[u32], ballistic_motion: &[Motion], residuals: &[f32]) {
        let model = self.model;
        let step = ResidualStep { ballistic: self.walls.ballistic, ..model.step };
        let residuals = residuals.chunks_exact(model.decoder.stride());
        for ((&particle, ballistic_motion), residual) in
            particles.iter().zip(ballistic_motion).zip(residuals)
        {
            // SAFETY: a particle has one slot, which is in this block, and one place.
            let (position, velocity) =
                unsafe { self.predicted.one(self.place[particle as usize] as usize) };
            let (residual, _) = residual.as_chunks::<OUTPUTS>();
            (*position, *velocity) = step.from_ballistic(ballistic_motion, &residual[0]);
        }
    }

    /// A layer of the core, R rows at a time: writes new outputs to `output` and new cells to `new_cells`, from the layer's
    /// inputs and its last outputs and cells, and both to the hidden state. `first` is the layer's first row there.
    #[inline(always)]
    fn core_layer<S: Simd, const R: usize>(
        &self,
        simd: S,
        (layer, first): (&CoreLayer, usize),
        particles: &[u32],
        input: &[f32],
        (output, new_cells): (&mut [f32], &mut [f32]),
    ) {
        let (width, count) = (self.width, particles.len());
        let input = Rows { numbers: input, width };
        for begin in (0..count).step_by(R) {
            let (mut hidden, mut cells) = ([[].as_slice(); R], [[].as_slice(); R]);
            for r in 0..R {
                let row = (first + particles[(begin + r).min(count - 1)] as usize) * width;
                // SAFETY: a particle has one slot, which is in this block, and its state is written after this use only.
                unsafe {
                    hidden[r] = self.hidden.read(row..row + width);
                    if layer.has_cell() {
                        cells[r] = self.cell.read(row..row + width);
                    }
                }
            }
            let inputs = input.block::<R>(begin, count);
            for panel in 0..layer.panels() {
                let units = layer.padded_units(panel);
                let next = layer.step::<S, R, 1>(simd, panel, inputs, hidden, cells);
                for r in 0..R.min(count - begin) {
                    let row = (begin + r) * width;
                    let own = row + units.start..row + units.end;
                    store(simd, &mut output[own.clone()], next.hidden[r]);
                    if let Some(cells) = &next.cell {
                        store(simd, &mut new_cells[own], cells[r]);
                    }
                }
            }
            let units = layer.padded_units(layer.panels() - 1).end;
            for (r, &particle) in particles[begin..].iter().take(R).enumerate() {
                let row = (first + particle as usize) * width;
                let own = (begin + r) * width..(begin + r) * width + units;
                // SAFETY: as above.
                unsafe {
                    copy(&output[own.clone()], self.hidden.part(row..row + units));
                    if layer.has_cell() {
                        copy(&new_cells[own], self.cell.part(row..row + units));
                    }
                }
            }
        }
    }
}

/// Copies a row of hidden states: a loop, as a call for few numbers is slower.
#[inline(always)]
fn copy(from: &[f32], to: &mut [f32]) {
    let ((chunks, last), (from_chunks, from_last)) = (to.as_chunks_mut::<8>(), from.as_chunks());
    for (to, from) in chunks.iter_mut().zip(from_chunks) {
        *to = *from;
    }
    for (to, from) in last.iter_mut().zip(from_last) {
        *to = *from;
    }
}
