//! The elastic impulses of jelly in a training.

use eddy_inference::kernels::lattice::Lattice;

use super::Training;
use crate::{
    device::{Buffer, Shape},
    error::Result,
    kernels::Kernel,
    particle::lattice::{ELASTIC_THREADS, MOST_NODES, Placed},
    training::Settings,
};

/// The lattices of all streams, each as it is and mirrored, one behind the other.
#[derive(Default)]
pub(super) struct Lattices {
    placed: Vec<Placed>,
    words: Vec<u32>,
}

impl Lattices {
    /// Adds the lattices of stream number `stream`; streams before it that were not added have none.
    pub(super) fn add(&mut self, stream: usize, lattices: [&Lattice; 2]) -> Result<()> {
        self.placed.resize(2 * stream, Placed::default());
        for lattice in lattices {
            self.placed.push(Placed::append(lattice, &mut self.words)?);
        }
        Ok(())
    }

    /// Copies those of so many streams to a device, if there are any.
    pub(super) fn finish(
        mut self,
        streams: usize,
        keep: impl Fn(&[u8]) -> Result<Buffer>,
    ) -> Result<Option<DeviceLattices>> {
        self.placed.resize(2 * streams, Placed::default());
        let most = |of: fn(&Placed) -> usize| self.placed.iter().map(of).max().unwrap_or(0);
        let most = [most(|placed| placed.nodes), most(Placed::forces)];
        if most == [0; 2] {
            return Ok(None);
        }
        let lists = keep(bytemuck::cast_slice(&self.words))?;
        let on_device = |placed: &Placed| placed.on_device(lists.address());
        let table: Vec<_> = self.placed.iter().map(on_device).collect();
        Ok(Some(DeviceLattices { table: keep(bytemuck::cast_slice(&table))?, most, _lists: lists }))
    }
}

/// The lattices of all streams on a device.
pub(super) struct DeviceLattices {
    /// `struct Lattice` of the kernels, `[2 streams]`.
    table: Buffer,
    /// Nodes of the largest, and numbers of 4 bytes of its forces ([`Placed::forces`]).
    pub(super) most: [usize; 2],
    _lists: Buffer,
}

/// Memory that streams of these numbers of particles take for their lattices, and steps on the largest of them (bytes), about: if all
/// are of jelly, in one body.
pub(in super::super) fn elastic_bytes(
    streams: impl IntoIterator<Item = usize>,
    settings: &[Settings],
) -> u64 {
    /// Of a particle: its row, corners and samples, and its share of points and of parts of surfaces.
    const PARTICLE: u64 = 36 + 32 + 40 + 12;
    /// Particles of a node, at least.
    const OF_NODE: u64 = 4;
    /// Of a particle in a step: its share of nodes, and of points or parts.
    const SCRATCH: u64 = 8 + 48;
    /// Of a particle in a frame of a step: its impulse.
    const IMPULSE: u64 = 16;
    // Of a body, whose nodes are limited.
    let inverse = |particles: u64| {
        let nodes = particles / OF_NODE;
        4 * nodes * nodes.min(MOST_NODES as u64)
    };
    let (mut all, mut most) = (0, 0);
    for particles in streams.into_iter().map(|particles| particles as u64) {
        all += 2 * (PARTICLE * particles + inverse(particles));
        most = particles.max(most);
    }
    let bytes = |stage: &Settings| {
        let frames = stage.warm_up + stage.unroll;
        stage.batch as u64 * (stage.warm_up as u64 * SCRATCH + frames as u64 * IMPULSE)
    };
    all + most * settings.iter().map(bytes).max().unwrap_or(0)
}

impl Training {
    /// The elastic impulses of `sheets` windows' frames from `sheet` on.
    pub(super) fn impulses(&self, sheet: usize, sheets: usize) -> Result<()> {
        let Some(lattices) = self.store.lattices.as_ref().filter(|_| self.has_impulses) else {
            return Ok(());
        };
        let shape = Shape::new(1, sheets, ELASTIC_THREADS);
        let arguments = [self.plan(), lattices.table.address().into(), sheet.into()];
        self.launch(Kernel::TrainElastic, shape, &arguments)
    }
}
