//! The particle model, one frame at a time: `model/particle_model.rs` for one stream.
//!
//! Particles go through all layers in blocks, small enough for what they hand on to stay in the
//! nearest caches; within a block, a few rows at a time stay in registers.

use std::{array, collections::BTreeMap};

use pulp::{Arch, Simd, WithSimd};

use super::{
    core::CoreLayer,
    crew::{Crew, Parts, Task},
    linear::{Linear, add_products},
    memory::Memory,
    particle_features::{Features, NEARNESSES},
};
use crate::{
    checkpoint::{Description, Weights},
    frame::Frame,
    kernels::math::relu,
    kernels::vectors::Lanes,
    model::particle_model::velocity_limits,
};

/// Particles of a block: a multiple of the rows that are computed at once.
pub(super) const BLOCK: usize = 48;

/// Outputs of the decoder.
const OUTPUTS: usize = 4;

/// The packed network.
#[derive(Debug)]
pub(super) struct ParticleModel {
    /// Whose vectors the weights are packed for.
    arch: Arch,
    features: Features,
    encoder: [Linear; 2],
    core: Vec<CoreLayer>,
    mixer: Linear,
    decoder: Linear,
    /// H.
    hidden: usize,
    /// Bounds of the predicted velocities (domain lengths per second).
    slowest: [f32; 2],
    fastest: [f32; 2],
}

/// Room for what the layers hand on, for one block.
#[derive(Debug)]
pub(super) struct Room {
    /// Nearness of the walls, `[BLOCK, 8]`.
    nearness: Vec<f32>,
    /// Input of a layer, `[BLOCK, its width]`.
    input: Vec<f32>,
    /// Its output, `[BLOCK, its width]`.
    output: Vec<f32>,
    /// The ballistic step of each particle: position, velocity.
    fallen: Vec<([f32; 2], [f32; 2])>,
}

impl ParticleModel {
    pub(super) fn pack(
        arch: Arch,
        description: &Description,
        tensors: &BTreeMap<String, Weights>,
    ) -> Self {
        let lanes = arch.dispatch(Lanes);
        let linear = |layer| Linear::named(lanes, tensors, layer);
        let (slowest, fastest) = velocity_limits(&description.normalization);
        Self {
            arch,
            features: Features::new(description),
            encoder: ["encoder.0", "encoder.1"].map(linear),
            core: (0..description.sizes.layers)
                .map(|layer| CoreLayer::pack(lanes, description, tensors, layer))
                .collect(),
            mixer: linear("mixer"),
            decoder: linear("decoder"),
            hidden: description.sizes.hidden,
            slowest,
            fastest,
        }
    }

    /// Multiplications of a frame for one particle.
    pub(super) fn work(&self) -> usize {
        let core = self.core.iter().flat_map(CoreLayer::linears);
        let linears = self.encoder.iter().chain(core).chain([&self.mixer, &self.decoder]);
        linears.map(Linear::numbers).sum()
    }

    pub(super) fn room(&self) -> Room {
        let widest = [&self.encoder[0], &self.encoder[1], &self.mixer, &self.decoder]
            .map(|linear| linear.input().max(linear.output()));
        let widest = widest.into_iter().max().unwrap_or(0);
        Room {
            nearness: vec![0.0; BLOCK * NEARNESSES],
            input: vec![0.0; BLOCK * widest],
            output: vec![0.0; BLOCK * widest],
            fallen: vec![([0.0; 2], [0.0; 2]); BLOCK],
        }
    }

    /// Observes `frame` and writes the next positions and velocities. There is a room for each thread.
    pub(super) fn step(
        &self,
        crew: &mut Crew,
        alone: bool,
        rooms: &mut [Room],
        memory: &mut Memory,
        frame: &Frame,
        next: &mut Frame,
    ) {
        let pass = Pass {
            model: self,
            frame,
            material: &memory.material,
            begun: memory.begun,
            rooms: Parts::new(rooms),
            hidden: Parts::new(&mut memory.hidden),
            cell: Parts::new(&mut memory.cell),
            foretold: Parts::new(&mut memory.foretold),
            position: Parts::new(&mut next.position),
            velocity: Parts::new(&mut next.velocity),
        };
        let blocks = frame.len().div_ceil(BLOCK);
        crew.run([blocks], alone, &|task| self.arch.dispatch(Block { pass: &pass, task }));
        memory.begun = true;
    }
}

/// One frame under way. The items of its only stage are blocks of particles; each has its own part of
/// what is written.
struct Pass<'a> {
    model: &'a ParticleModel,
    frame: &'a Frame,
    material: &'a [u8],
    begun: bool,
    rooms: Parts<'a, Room>,
    hidden: Parts<'a, f32>,
    cell: Parts<'a, f32>,
    foretold: Parts<'a, [f32; 2]>,
    position: Parts<'a, [f32; 2]>,
    velocity: Parts<'a, [f32; 2]>,
}

/// A block of particles.
struct Block<'a> {
    pass: &'a Pass<'a>,
    task: Task,
}

impl WithSimd for Block<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        if S::REGISTER_COUNT >= 32 {
            self.run::<S, 6>(simd);
        } else {
            self.run::<S, 3>(simd);
        }
    }
}

impl Block<'_> {
    /// R rows at a time.
    #[inline(always)]
    fn run<S: Simd, const R: usize>(self, simd: S) {
        let Self { pass, task } = self;
        let (model, particles) = (pass.model, pass.frame.len());
        let block = task.item * BLOCK..((task.item + 1) * BLOCK).min(particles);
        let count = block.len();
        // SAFETY: no other item has this thread's number, or this block, while this one is under way.
        let (room, foretold, next_position, next_velocity) = unsafe {
            let rooms = pass.rooms.part(task.thread..task.thread + 1);
            let foretold = pass.foretold.part(block.clone());
            let position = pass.position.part(block.clone());
            (&mut rooms[0], foretold, position, pass.velocity.part(block.clone()))
        };
        let Room { nearness, input, output, fallen } = room;

        let position = &pass.frame.position[block.clone()];
        let velocity = &pass.frame.velocity[block.clone()];
        let material = &pass.material[block.clone()];
        let seen = pass.begun.then_some(&*foretold);
        model.features.fill(simd, position, velocity, seen, material, nearness, fallen, input);
        for (foretold, (_, velocity)) in foretold.iter_mut().zip(&*fallen) {
            *foretold = *velocity;
        }

        for linear in &model.encoder {
            dense::<S, R>(simd, linear, true, count, input, output);
            std::mem::swap(input, output);
        }
        for (number, layer) in model.core.iter().enumerate() {
            let width = model.hidden;
            let first = (number * particles + block.start) * width;
            let rows = first..first + count * width;
            // SAFETY: these rows are this block's alone; without cells there is nothing to share.
            let (hidden, cell) = unsafe {
                let cells = if pass.cell.len() == 0 { 0..0 } else { rows.clone() };
                (pass.hidden.part(rows), pass.cell.part(cells))
            };
            recur::<S, R>(simd, layer, count, input, hidden, cell, output);
            hidden.copy_from_slice(&output[..count * width]);
            std::mem::swap(input, output);
        }
        dense::<S, R>(simd, &model.mixer, true, count, input, output);
        dense::<S, R>(simd, &model.decoder, false, count, output, input);

        let residuals = input.as_chunks::<OUTPUTS>().0;
        let after = next_position.iter_mut().zip(next_velocity);
        for ((position, velocity), (fallen, residual)) in after.zip(fallen.iter().zip(residuals)) {
            (*position, *velocity) = model.add(fallen, residual);
        }
    }
}

impl ParticleModel {
    /// The residual on the ballistic step, within bounds. NaN stays.
    #[inline(always)]
    fn add(
        &self,
        (position, velocity): &([f32; 2], [f32; 2]),
        residual: &[f32; OUTPUTS],
    ) -> ([f32; 2], [f32; 2]) {
        let Features { ballistic, velocity_unit, .. } = &self.features;
        let between = |x: f32, low: f32, high: f32| {
            let raised = if x < low { low } else { x };
            if raised > high { high } else { raised }
        };
        let residual = residual.map(|number| number * velocity_unit);
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

/// R rows of `[.., width]` from row `first` on; the last of `count` rows again where there are no more.
#[inline(always)]
fn rows<const R: usize>(numbers: &[f32], width: usize, first: usize, count: usize) -> [&[f32]; R] {
    array::from_fn(
        #[inline(always)]
        |r| {
            let row = (first + r).min(count - 1);
            &numbers[row * width..(row + 1) * width]
        },
    )
}

/// A linear layer for `count` rows, with ReLU if `rectify`.
#[inline(always)]
fn dense<S: Simd, const R: usize>(
    simd: S,
    linear: &Linear,
    rectify: bool,
    count: usize,
    input: &[f32],
    output: &mut [f32],
) {
    let width = linear.output();
    // Two panels at a time; the last one twice where their number is odd.
    for pair in (0..linear.panels()).step_by(2) {
        let panels = [pair, (pair + 1).min(linear.panels() - 1)];
        let weights = [linear.panel(panels[0]), linear.panel(panels[1])];
        let biases = [linear.bias(simd, panels[0]), linear.bias(simd, panels[1])];
        for first in (0..count).step_by(R) {
            let rows = rows::<R>(input, linear.input(), first, count);
            let sums = add_products::<S, 2, R, 1>(simd, weights, rows, biases);
            for g in 0..2 {
                let units = linear.outputs(panels[g]);
                for r in 0..R.min(count - first) {
                    let row = &mut output[(first + r) * width..(first + r + 1) * width];
                    let sum = if rectify { relu(simd, sums[g][r]) } else { sums[g][r] };
                    simd.partial_store_f32s(&mut row[units.clone()], sum);
                }
            }
        }
    }
}

/// A layer of the core for `count` rows: new outputs to `output`, new cells in place.
#[inline(always)]
fn recur<S: Simd, const R: usize>(
    simd: S,
    layer: &CoreLayer,
    count: usize,
    input: &[f32],
    hidden: &[f32],
    cell: &mut [f32],
    output: &mut [f32],
) {
    let width = hidden.len() / count;
    for panel in 0..layer.panels() {
        let units = layer.units(panel);
        for first in (0..count).step_by(R) {
            let inputs = rows::<R>(input, width, first, count);
            let last = rows::<R>(hidden, width, first, count);
            let cells = match cell.is_empty() {
                true => [[].as_slice(); R],
                false => rows::<R>(cell, width, first, count),
            };
            let next = layer.step::<S, R, 1>(simd, panel, inputs, last, cells);
            for r in 0..R.min(count - first) {
                let row = (first + r) * width;
                let units = row + units.start..row + units.end;
                simd.partial_store_f32s(&mut output[units.clone()], next.hidden[r]);
                if let Some(cells) = &next.cell {
                    simd.partial_store_f32s(&mut cell[units], cells[r]);
                }
            }
        }
    }
}
