//! What happens to a block of particles before they write to the grid, and after they have read from it.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use pulp::Simd;

use super::{
    Ballistic,
    core::CoreLayer,
    linear::store,
    particle_features::{FEATURES, State, fallen},
    particle_model::{BLOCK, Bench, COLUMNS, ParticleModel, Pass},
    products::{Beside, Columns, Output, Rows, pass},
    surroundings::READ,
};
use crate::kernels::transfer::gather;

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
        let block = self.block(item);
        let particles = &self.nodes.order()[block.clone()];
        let (count, stride) = (block.len(), second.stride());
        let sums = self.pieces.sums(item);
        // SAFETY: no other item has this thread's number, or this block, while this one is under way.
        let (bench, columns, later, sums) = unsafe {
            (
                &mut self.benches.part(thread..thread + 1)[0],
                self.features.part(item * COLUMNS..(item + 1) * COLUMNS),
                self.fallen.part(block),
                self.sums.part(sums.start * stride..sums.end * stride),
            )
        };
        let Bench { input: hidden, output: encoded, states } = bench;
        features.fill(
            simd,
            &self.known,
            particles,
            #[inline(always)]
            |particle| match self.begun {
                // SAFETY: a particle has one slot, in this block.
                true => unsafe { self.foretold.read(particle..particle + 1)[0] },
                false => self.known.velocity[particle],
            },
            (states, BLOCK),
            columns,
        );
        for (place, later) in later.iter_mut().enumerate() {
            *later = fallen(states, BLOCK, place);
        }
        for (&particle, later) in particles.iter().zip(&*later) {
            let particle = particle as usize;
            // SAFETY: as above.
            unsafe { self.foretold.part(particle..particle + 1)[0] = later.1 };
        }

        let input = Columns { numbers: columns, width: FEATURES, length: BLOCK };
        let mut output = Output { numbers: hidden, width: first.stride(), rectify: true };
        pass(simd, first, count, &input, &mut output);
        let input = Rows { numbers: hidden, width: first.stride() };
        let mut output = Output { numbers: encoded, width: stride, rectify: false };
        pass(simd, second, count, &input, &mut output);
        self.pieces.add(simd, self.nodes, item, encoded, stride, sums);
    }

    /// From what a block of particles reads to their next states.
    #[inline(always)]
    pub(super) fn decode<S: Simd>(&self, simd: S, item: usize, thread: usize) {
        let model = self.model;
        let (block, channels, width) = (self.block(item), model.grid.read(), self.width);
        let particles = &self.nodes.order()[block.clone()];
        let count = block.len();
        let field = &self.fields[READ];
        // SAFETY: no other item has this thread's number while this one is under way, and this stage only
        // reads the other lists.
        let (bench, columns, fallen, field) = unsafe {
            (
                &mut self.benches.part(thread..thread + 1)[0],
                self.features.read(item * COLUMNS..(item + 1) * COLUMNS),
                self.fallen.read(block.clone()),
                field.read(0..self.nodes.level(0).len() * channels),
            )
        };
        let Bench { input, output, states } = bench;
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
        let seen = Columns { numbers: columns, width: FEATURES, length: BLOCK };
        let read = Rows { numbers: input, width: channels };
        let mut context = Output { numbers: output, width, rectify: true };
        pass(simd, &model.context, count, &Beside(seen, read), &mut context);
        std::mem::swap(input, output);

        for (number, layer) in model.core.iter().enumerate() {
            let first = number * self.nodes.order().len();
            for (&particle, last) in particles.iter().zip(states.chunks_exact_mut(width)) {
                let row = (first + particle as usize) * width;
                // SAFETY: a particle has one slot, in this block.
                copy(unsafe { self.hidden.read(row..row + width) }, last);
            }
            // So many rows that the sums of all gates fit into registers.
            let lists = (&**input, &**states);
            match (layer.sums(), S::REGISTER_COUNT >= 32) {
                (..=2, true) => self.recur::<S, 12>(simd, layer, first, particles, lists, output),
                (_, true) => self.recur::<S, 6>(simd, layer, first, particles, lists, output),
                (..=2, false) => self.recur::<S, 6>(simd, layer, first, particles, lists, output),
                (_, false) => self.recur::<S, 3>(simd, layer, first, particles, lists, output),
            }
            for (&particle, output) in particles.iter().zip(output.chunks_exact(width)) {
                let row = (first + particle as usize) * width;
                // SAFETY: as above.
                copy(output, unsafe { self.hidden.part(row..row + width) });
            }
            std::mem::swap(input, output);
        }
        let signal = Rows { numbers: input, width };
        let mut mixed = Output { numbers: output, width: model.mixer.stride(), rectify: true };
        pass(simd, &model.mixer, count, &signal, &mut mixed);
        let signal = Rows { numbers: output, width: model.mixer.stride() };
        let length = model.decoder.stride();
        let mut residuals = Output { numbers: input, width: length, rectify: false };
        pass(simd, &model.decoder, count, &signal, &mut residuals);

        let residuals = input.chunks_exact(length);
        for ((&particle, fallen), residual) in particles.iter().zip(fallen).zip(residuals) {
            // SAFETY: as above.
            let (position, velocity) =
                unsafe { self.predicted.one(self.place[particle as usize] as usize) };
            let (residual, _) = residual.as_chunks::<OUTPUTS>();
            (*position, *velocity) = model.add(&self.walls.ballistic, fallen, &residual[0]);
        }
    }

    /// A layer of the core, R rows at a time: new outputs to `output`, new cells in place, from the
    /// layer's inputs and its last outputs. The states of its particles begin with row `first`.
    #[inline(always)]
    fn recur<S: Simd, const R: usize>(
        &self,
        simd: S,
        layer: &CoreLayer,
        first: usize,
        particles: &[u32],
        (input, last): (&[f32], &[f32]),
        output: &mut [f32],
    ) {
        let (width, count) = (self.width, particles.len());
        let [input, last] = [input, last].map(|numbers| Rows { numbers, width });
        for panel in 0..layer.panels() {
            let units = layer.places(panel);
            for begin in (0..count).step_by(R) {
                let mut cells = [[].as_slice(); R];
                if self.cell.len() > 0 {
                    for (r, cells) in cells.iter_mut().enumerate() {
                        let row = (first + particles[(begin + r).min(count - 1)] as usize) * width;
                        // SAFETY: a particle has one slot, in this block, and its cells are written only
                        // after this use.
                        *cells = unsafe { self.cell.read(row..row + width) };
                    }
                }
                let inputs = input.some::<R>(begin, count);
                let hidden = last.some::<R>(begin, count);
                let next = layer.step::<S, R, 1>(simd, panel, inputs, hidden, cells);
                for r in 0..R.min(count - begin) {
                    let row = (begin + r) * width;
                    store(simd, &mut output[row + units.start..row + units.end], next.hidden[r]);
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
        // Loops: what `map` and `from_fn` call may not be inlined, and so use other instructions.
        let (mut place, mut speed, unit) = ([0.0; 2], [0.0; 2], self.features.velocity_unit);
        for axis in 0..2 {
            let faster = velocity[axis] + residual[axis] * unit;
            speed[axis] = between(faster, self.slowest[axis], self.fastest[axis]);
            let farther = position[axis] + residual[2 + axis] * unit * ballistic.dt;
            place[axis] = ballistic.hold(axis, farther);
        }
        (place, speed)
    }
}

/// Copies a row of hidden states, a multiple of eight long.
#[inline(always)]
fn copy(from: &[f32], to: &mut [f32]) {
    for (to, from) in to.as_chunks_mut::<8>().0.iter_mut().zip(from.as_chunks().0) {
        *to = *from;
    }
}
