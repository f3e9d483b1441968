//! Trajectories for a device.

#![expect(unsafe_code, reason = "memory that the device reads")]

use crate::{
    device::{Device, HostBuffer, List},
    error::Result,
    kernels::MATERIALS,
    streams::Body,
    training::Window,
};

/// Where trajectories lie.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Place {
    /// In the memory of the device.
    Device,
    /// In the memory of the host, from where the device fetches the windows of each step during the step before: for
    /// trajectories that the device has no room for.
    Host,
}

/// Bodies where they lie.
pub(super) enum Bodies {
    Device(List<Body>),
    Host(HostBuffer),
}

/// Trajectories that a device reads.
pub struct Store {
    /// Frame after frame, stream after stream.
    pub(super) bodies: Bodies,
    /// `[streams, N]`.
    pub(super) material: List<u8>,
    /// Particles in the order of their materials, `[streams, N]`.
    pub(super) order: List<u32>,
    /// Where each material starts in that order, `[streams, MATERIALS + 1]`.
    pub(super) segments: List<u32>,
    /// First body of each stream, and the end of the last one.
    first: Vec<u64>,
    particles: usize,
}

impl Store {
    /// N.
    pub fn particles(&self) -> usize {
        self.particles
    }

    /// Whether a window of so many frames lies within its stream.
    pub(super) fn contains(&self, window: &Window, frames: usize) -> bool {
        let end = self.first.get(window.stream + 1);
        end.is_some_and(|&end| {
            let bodies = ((window.start + frames) * self.particles) as u64;
            self.first[window.stream] + bodies <= end
        })
    }

    /// The first body of a window.
    pub(super) fn first(&self, window: &Window) -> u64 {
        self.first[window.stream] + (window.start * self.particles) as u64
    }

    /// Memory that so many frames take (bytes).
    pub fn bytes(frames: usize, particles: usize) -> u64 {
        frames as u64 * particles as u64 * 16
    }
}

/// Particles in the order of their materials, `[N]`, and where each material starts in it, `[MATERIALS + 1]`.
pub(super) fn by_material(material: &[u8]) -> [Vec<u32>; 2] {
    let mut order: Vec<u32> = (0..material.len() as u32).collect();
    order.sort_by_key(|&particle| material[particle as usize]);
    let before =
        |kind: usize| material.iter().filter(|&&one| usize::from(one) < kind).count() as u32;
    [order, (0..=MATERIALS).map(before).collect()]
}

/// Copies streams of N particles to where a device reads them, frame by frame.
pub struct StoreWriter<'a> {
    device: &'a dyn Device,
    particles: usize,
    bodies: Bodies,
    materials: Vec<u8>,
    order: Vec<u32>,
    segments: Vec<u32>,
    first: Vec<u64>,
    /// Bodies written so far.
    written: u64,
}

impl<'a> StoreWriter<'a> {
    /// Memory for so many frames in all streams.
    ///
    /// # Errors
    /// [`CudaError::Call`](crate::CudaError::Call), as of all that follows.
    pub fn new(
        device: &'a dyn Device,
        particles: usize,
        frames: usize,
        place: Place,
    ) -> Result<Self> {
        Ok(Self {
            device,
            particles,
            bodies: match place {
                Place::Device => Bodies::Device(List::new(device, frames * particles)?),
                Place::Host => {
                    Bodies::Host(device.allocate_host(Store::bytes(frames, particles) as usize)?)
                }
            },
            materials: Vec::new(),
            order: Vec::new(),
            segments: Vec::new(),
            first: Vec::new(),
            written: 0,
        })
    }

    /// Begins a stream of particles of these materials (by number), `[N]`.
    ///
    /// # Panics
    /// When there are not N.
    pub fn stream(&mut self, material: &[u8]) {
        assert_eq!(material.len(), self.particles, "materials of a stream");
        self.first.push(self.written);
        let [order, segments] = by_material(material);
        self.segments.extend(segments);
        self.materials.extend_from_slice(material);
        self.order.extend(order);
    }

    /// Adds a frame of x, y, vx, vy to the last stream, `[N]`.
    ///
    /// # Errors
    /// As [`Self::new`].
    ///
    /// # Panics
    /// When there are not N bodies, or more frames than there is memory for.
    pub fn frame(&mut self, bodies: &[[f32; 4]]) -> Result<()> {
        assert_eq!(bodies.len(), self.particles, "bodies of a frame");
        let first = self.written as usize;
        self.written += bodies.len() as u64;
        match &mut self.bodies {
            Bodies::Device(buffer) => {
                self.device.write(buffer, 16 * first, bytemuck::cast_slice(bodies))
            }
            Bodies::Host(buffer) => {
                // SAFETY: the device does not know this memory before `finish`.
                let all = unsafe { buffer.slice::<[f32; 4]>() };
                all[first..first + bodies.len()].copy_from_slice(bodies);
                Ok(())
            }
        }
    }

    /// The store.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn finish(mut self) -> Result<Store> {
        self.first.push(self.written);
        Ok(Store {
            material: List::of(self.device, &self.materials)?,
            order: List::of(self.device, &self.order)?,
            segments: List::of(self.device, &self.segments)?,
            bodies: self.bodies,
            first: self.first,
            particles: self.particles,
        })
    }
}
