//! What a network remembers of a stream.

use std::sync::Arc;

use super::order::by_place;
use crate::{
    checkpoint::{Core, Description, Surroundings},
    kernels::rest::Rest,
};
use eddy_frames::Frame;

/// Rows of hidden states are a multiple of this long, and begin at a cache line as often as can be.
const LINE: usize = 16;

/// Length of the row of so many units in the particle model.
pub(super) fn stride(hidden: usize) -> usize {
    hidden.next_multiple_of(LINE)
}

/// The hidden state of one stream: what the network remembers of the frames it observed.
///
/// `clone_from` copies into a memory of the same network and number of particles without asking for
/// more room, as a look-ahead does at every frame.
#[derive(Debug, PartialEq)]
pub struct Memory {
    /// Particle model: the particle in each row here, those that were near each other in the stream's first
    /// frame one after the other; empty in the frame model, which has them in their own order.
    pub(super) order: Arc<Vec<u32>>,
    /// The material number of each row's particle, `[N]`.
    pub(super) material: Vec<u8>,
    /// Particle model: the shape in which jelly and rope rest, taken from the stream's first frame; it
    /// holds no particles in the frame model.
    pub(super) rest: Arc<Rest>,
    /// Last outputs of the core, `[layer, R, H]`, R being 1 in the frame model and N in the particle
    /// model, whose rows are [`stride`] long. Zero before the first frame.
    pub(super) hidden: Vec<f32>,
    /// Cells of an LSTM, of the same shape; empty in other cores.
    pub(super) cell: Vec<f32>,
    /// Particle model: velocities that the ballistic step foretold for the coming frame, `[N, 2]`;
    /// empty in the frame model.
    pub(super) foretold: Vec<[f32; 2]>,
    /// Whether a frame was observed.
    pub(super) begun: bool,
}

impl Memory {
    /// The empty memory for the particles of `frame`.
    pub(super) fn new(description: &Description, frame: &Frame) -> Self {
        let particles = frame.len();
        let mut material: Vec<_> = frame.material.iter().map(|&kind| kind as u8).collect();
        let (mut order, mut rest) = (Vec::new(), Rest::default());
        if let Some(Surroundings { cell_width, spacing, .. }) = description.surroundings {
            order = by_place(frame, cell_width);
            // Which neighbours count where several are as far must not depend on the order.
            rest = Rest::new(&frame.position, &frame.material, 1, spacing).permuted(&order);
            material = order.iter().map(|&row| frame.material[row as usize] as u8).collect();
        }
        let hidden = description.sizes.hidden;
        let (numbers, foretold) = match description.sizes.particles {
            Some(_) => (hidden, 0),
            None => (particles * stride(hidden), particles),
        };
        let states = description.sizes.layers * numbers;
        let cells = if description.core == Core::Lstm { states } else { 0 };
        Self {
            order: Arc::new(order),
            material,
            rest: Arc::new(rest),
            hidden: vec![0.0; states],
            cell: vec![0.0; cells],
            foretold: vec![[0.0; 2]; foretold],
            begun: false,
        }
    }

    /// How many particles it is for.
    pub fn particles(&self) -> usize {
        self.material.len()
    }

    /// Forgets the frames it observed, but not the shape that solids rest in: for a stream that was not
    /// seen for a while.
    pub fn forget(&mut self) {
        self.hidden.fill(0.0);
        self.cell.fill(0.0);
        self.foretold.fill([0.0; 2]);
        self.begun = false;
    }
}

impl Clone for Memory {
    fn clone(&self) -> Self {
        Self {
            order: Arc::clone(&self.order),
            material: self.material.clone(),
            rest: Arc::clone(&self.rest),
            hidden: self.hidden.clone(),
            cell: self.cell.clone(),
            foretold: self.foretold.clone(),
            begun: self.begun,
        }
    }

    fn clone_from(&mut self, other: &Self) {
        let Self { order, material, rest, hidden, cell, foretold, begun } = self;
        *order = Arc::clone(&other.order);
        material.clone_from(&other.material);
        *rest = Arc::clone(&other.rest);
        hidden.clone_from(&other.hidden);
        cell.clone_from(&other.cell);
        foretold.clone_from(&other.foretold);
        *begun = other.begun;
    }
}
