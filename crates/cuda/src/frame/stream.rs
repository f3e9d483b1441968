//! What is remembered of a stream of the frame model.

use std::sync::Arc;

use super::{data::by_material, layout::Layout};
use crate::{
    device::{Buffer, Device, Pointer},
    error::Result,
    kernels::{Constants, frame::inference::Row},
    streams::StreamMemory,
};

/// What is remembered of a stream: states and cells, then the particles in the order of their materials, and where each
/// material starts in it.
pub struct Memory {
    device: Arc<dyn Device>,
    buffer: Buffer,
    /// Layers of states, with those of cells, and their padded and their actual width.
    layers: usize,
    widths: [usize; 2],
    particles: usize,
}

impl Memory {
    pub(super) fn new(
        device: Arc<dyn Device>,
        constants: &Constants,
        layout: &Layout,
        material: &[u8],
    ) -> Result<Self> {
        let layers = layout.core.len() * constants.core.states();
        let widths = [constants.hidden_columns(), constants.hidden];
        let particles = material.len();
        let [order, segments] = by_material(material);
        let bytes = 4 * (layers * widths[0] + order.len() + segments.len());
        let buffer = device.allocate(bytes)?;
        let memory = Self { device, buffer, layers, widths, particles };
        memory.clear()?;
        let tables = [order, segments].concat();
        let offset = 4 * layers * widths[0];
        memory.device.write(&memory.buffer, offset, bytemuck::cast_slice(&tables))?;
        Ok(memory)
    }

    /// As the kernels have it.
    pub(super) fn row(&self) -> Row {
        let state = Pointer::<f32>::at(self.buffer.address());
        let order = state.plus(self.layers * self.widths[0]).cast();
        Row { state, order, segments: order.plus(self.particles) }
    }
}

impl StreamMemory for Memory {
    /// States as they are before the first frame: zero, with the ones that the bias of W_hh is multiplied by.
    fn clear(&self) -> Result<()> {
        let [wide, hidden] = self.widths;
        let mut states = vec![0f32; self.layers * wide];
        states.iter_mut().skip(hidden).step_by(wide).for_each(|one| *one = 1.0);
        self.device.write(&self.buffer, 0, bytemuck::cast_slice(&states))
    }

    fn numbers(&self) -> Result<Vec<f32>> {
        let mut states = vec![0f32; self.layers * self.widths[0]];
        self.device.read(&self.buffer, 0, bytemuck::cast_slice_mut(&mut states))?;
        Ok(states)
    }

    fn resembles(&self, other: &Self) -> bool {
        self.buffer.bytes() == other.buffer.bytes()
    }

    fn copy_from(&self, other: &Self) -> Result<()> {
        self.device.copy(&self.buffer, &other.buffer)
    }

    fn duplicate(&self) -> Result<Self> {
        let buffer = self.device.allocate(self.buffer.bytes())?;
        let Self { device, layers, widths, particles, .. } = self;
        let copy = Self {
            device: device.clone(),
            buffer,
            layers: *layers,
            widths: *widths,
            particles: *particles,
        };
        copy.copy_from(self)?;
        Ok(copy)
    }
}
