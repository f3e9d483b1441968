//! What happens to a block of particles before they write to the grid, and after they have read from it.

use std::array;

use pulp::Simd;

use super::{
    core::CoreLayer,
    free_flight::REACH,
    linear::store,
    particle_features::{FEATURES, State},
    particle_model::{BLOCK, Bench, ParticleModel, Pass},
    products::{Beside, Output, Rows, pass},
    surroundings::READ,
};
use crate::{kernels::transfer::gather, model::Ballistic};

/// Outputs of the decoder.
const OUTPUTS: usize = 4;

impl Pass<'_> {
    /// The slots of an item.
    #[inline(always)]
    fn block(&self, item: usize) -> std::ops::Range<usize> {
        item * BLOCK..((item + 1) * BLOCK).min(self.nodes.order().len())
    }

    /// From frames to what a block of particles writes to the grid.
    #[inline(always)]
    pub(super) fn encode<S: Simd>(&self, simd: S, item: usize, thread: usize) {
        let ParticleModel { features, encoder: [first, second], .. } = self.model;
        let (block, width) = (self.block(item), second.output());
        let particles = &self.nodes.order()[block.clone()];
        let count = block.len();
        // SAFETY: no other item has this thread's number, or this block, while this one is under way.
        let (bench, rows, fallen, encoded, near) = unsafe {
            (
                &mut self.benches.part(thread..thread + 1)[0],
                self.features.part(block.start * FEATURES..block.end * FEATURES),
                self.fallen.part(block.clone()),
                self.encoded.part(block.start * width..block.end * width),
                self.near.part(block.clone()),
            )
        };
        features.fill(
            simd,
            &self.known,
            particles,
            #[inline(always)]
            |particle| match self.begun {
                // SAFETY: a particle has one slot, in this block.
                true => unsafe { self.foretold.read(particle..particle + 1)[0] },
                false => self.known.frame.velocity[particle],
            },
            fallen,
            rows,
        );
        for ((&particle, fallen), near) in particles.iter().zip(&*fallen).zip(near) {
            let particle = particle as usize;
            // SAFETY: as above.
            unsafe { self.foretold.part(particle..particle + 1)[0] = fallen.1 };
            let now = self.known.frame.position[particle];
            *near = is_near(&self.walls.ballistic, now, REACH * self.walls.cell_width)
                || is_near(&self.walls.ballistic, fallen.0, REACH * self.walls.cell_width);
        }

        let Bench { input: hidden, .. } = bench;
        let input = Rows { numbers: rows, width: FEATURES };
        let mut output = Output { numbers: hidden, width: first.output(), rectify: true };
        pass(simd, first, count, &input, &mut output);
        let input = Rows { numbers: hidden, width: first.output() };
        let mut output = Output { numbers: encoded, width, rectify: false };
        pass(simd, second, count, &input, &mut output);
    }

    /// From what a block of particles reads to their next states.
    #[inline(always)]
    pub(super) fn decode<S: Simd>(&self, simd: S, item: usize, thread: usize) {
        let model = self.model;
        let (block, channels, width) = (self.block(item), model.grid.channels, model.hidden);
        let particles = &self.nodes.order()[block.clone()];
        let count = block.len();
        let field = &self.fields[READ];
        // SAFETY: no other item has this thread's number while this one is under way, and this stage only
        // reads the other lists.
        let (bench, features, fallen, field) = unsafe {
            (
                &mut self.benches.part(thread..thread + 1)[0],
                self.features.read(block.start * FEATURES..block.end * FEATURES),
                self.fallen.read(block.clone()),
                field.read(0..self.nodes.level(0).len() * channels),
            )
        };
        let Bench { input, output } = bench;
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
        let seen = Rows { numbers: features, width: FEATURES };
        let read = Rows { numbers: input, width: channels };
        let mut context = Output { numbers: output, width, rectify: true };
        pass(simd, &model.context, count, &Beside(seen, read), &mut context);
        std::mem::swap(input, output);

        for (number, layer) in model.core.iter().enumerate() {
            let first = number * self.nodes.order().len();
            // So many rows that the sums of all gates fit into registers.
            match (layer.sums(), S::REGISTER_COUNT >= 32) {
                (..=2, true) => self.recur::<S, 12>(simd, layer, first, particles, input, output),
                (_, true) => self.recur::<S, 6>(simd, layer, first, particles, input, output),
                (..=2, false) => self.recur::<S, 6>(simd, layer, first, particles, input, output),
                (_, false) => self.recur::<S, 3>(simd, layer, first, particles, input, output),
            }
            for (&particle, output) in particles.iter().zip(output.chunks_exact(width)) {
                let row = (first + particle as usize) * width;
                // SAFETY: a particle has one slot, in this block.
                unsafe { self.hidden.part(row..row + width) }.copy_from_slice(output);
            }
            std::mem::swap(input, output);
        }
        let signal = Rows { numbers: input, width };
        let mut mixed = Output { numbers: output, width, rectify: true };
        pass(simd, &model.mixer, count, &signal, &mut mixed);
        let signal = Rows { numbers: output, width };
        let mut residuals = Output { numbers: input, width: OUTPUTS, rectify: false };
        pass(simd, &model.decoder, count, &signal, &mut residuals);

        let residuals = input.as_chunks::<OUTPUTS>().0;
        for ((&particle, fallen), residual) in particles.iter().zip(fallen).zip(residuals) {
            let particle = particle as usize..particle as usize + 1;
            // SAFETY: as above.
            let (position, velocity) =
                unsafe { (self.position.part(particle.clone()), self.velocity.part(particle)) };
            (position[0], velocity[0]) = model.add(&self.walls.ballistic, fallen, residual);
        }
    }

    /// A layer of the core, R rows at a time: new outputs to `output`, new cells in place. The states of its particles begin
    /// with row `first`.
    #[inline(always)]
    fn recur<S: Simd, const R: usize>(
        &self,
        simd: S,
        layer: &CoreLayer,
        first: usize,
        particles: &[u32],
        input: &[f32],
        output: &mut [f32],
    ) {
        let (width, count) = (self.model.hidden, particles.len());
        let input = Rows { numbers: input, width };
        for panel in 0..layer.panels() {
            let units = layer.units(panel);
            for begin in (0..count).step_by(R) {
                let mut hidden = [[].as_slice(); R];
                let mut cells = [[].as_slice(); R];
                for r in 0..R {
                    let row = (first + particles[(begin + r).min(count - 1)] as usize) * width;
                    // SAFETY: a particle has one slot, in this block, and its cells are written only after
                    // this use.
                    unsafe {
                        hidden[r] = self.hidden.read(row..row + width);
                        if self.cell.len() > 0 {
                            cells[r] = self.cell.read(row..row + width);
                        }
                    }
                }
                let inputs = input.some::<R>(begin, count);
                let next = layer.step::<S, R, 1>(simd, panel, inputs, hidden, cells);
                for r in 0..R.min(count - begin) {
                    let row = (begin + r) * width;
                    let own = row + units.start..row + units.end;
                    store(simd, &mut output[own], next.hidden[r]);
                    if let Some(cells) = &next.cell {
                        let row = (first + particles[begin + r] as usize) * width;
                        // SAFETY: as above.
                        let own = unsafe { self.cell.part(row + units.start..row + units.end) };
                        store(simd, own, cells[r]);
                    }
                }
            }
        }
    }
}

impl ParticleModel {
    /// The residual on the ballistic step, within bounds. NaN stays.
    #[inline(always)]
    fn add(
        &self,
        ballistic: &Ballistic,
        (position, velocity): &State,
        residual: &[f32; OUTPUTS],
    ) -> State {
        let between = |x: f32, low: f32, high: f32| {
            let raised = if x < low { low } else { x };
            if raised > high { high } else { raised }
        };
        let residual = residual.map(|number| number * self.features.velocity_unit);
        (
            array::from_fn(|axis| {
                let farther = position[axis] + residual[2 + axis] * ballistic.dt;
                between(farther, ballistic.lower[axis], ballistic.upper[axis])
            }),
            array::from_fn(|axis| {
                let faster = velocity[axis] + residual[axis];
                between(faster, self.slowest[axis], self.fastest[axis])
            }),
        )
    }
}

/// Whether a position is less than `reach` from a wall (domain lengths).
#[inline(always)]
fn is_near(walls: &Ballistic, position: [f32; 2], reach: f32) -> bool {
    let Ballistic { lower, upper, .. } = walls;
    (0..2).any(|axis| position[axis] < lower[axis] + reach || position[axis] > upper[axis] - reach)
}
