//! Solvers side by side on a device.
//!
//! An interval of all scenes is a number of rounds of [`MOST_SUBSTEPS`] substeps at most, each one graph:
//!
//! | stage | a block has | reads | writes |
//! |---|---|---|---|
//! | count, tiles, touch, move | 256 particles or tiles | positions | particles sorted by tiles |
//! | particles | a tile of 8 x 8 cells | particles, nodes around the tile | particles, a patch of 14 x 14 nodes |
//! | nodes | 8 x 8 nodes | the patches that cover them | velocity and mass of nodes |
//!
//! The last two are repeated for every substep. A scene that has finished, or has to wait until its particles are sorted,
//! skips its part of the round; the host reads how far each one is and starts rounds until all have finished.

#![expect(unsafe_code, reason = "launches, and memory that the device reads and writes")]

use std::sync::Arc;

use eddy_mpm::{Accelerator, Interval, MpmError, Solver};

use super::{
    layout::{Layout, NUMBERS, PATCH, TILE},
    particles::HostParticles,
};
use crate::{
    device::{Address, Argument, Buffer, Device, Queue, Shape},
    error::{CudaError, Result},
    graphs::Graphs,
    kernels::{Kernel, round_up},
};

/// Recorded rounds that are kept.
const ROUNDS: usize = 4;
/// Substeps of a round, at most: after that many, the particles of a tile are no longer near it.
const MOST_SUBSTEPS: u32 = 64;
/// Threads of a block over the particles of a scene, or over tiles.
const THREADS: usize = 256;
/// Threads of a block of a tile, `THREADS` of the kernels.
const TILE_THREADS: usize = 128;
/// Blocks over tiles, at most; each goes on with further tiles.
const BLOCKS: usize = 16384;
/// No particle is lost, `NONE` of the kernels.
const NONE: u32 = u32::MAX;

/// Solvers on a device.
pub struct Solvers {
    device: Arc<dyn Device>,
    /// The GPU's number, for errors.
    number: usize,
    loaded: Option<Loaded>,
}

impl Solvers {
    /// None yet, on the GPU of this number, which has the kernels of [`Constants`](super::Constants).
    pub fn new(device: Arc<dyn Device>, number: usize) -> Self {
        Self { device, number, loaded: None }
    }

    /// Runs an interval without copying the particles from and to the solvers, for measurements.
    ///
    /// # Errors
    /// [`CudaError`].
    ///
    /// # Panics
    /// Before [`Accelerator::load`].
    pub fn advance(&mut self, intervals: &[Interval]) -> Result<Vec<Option<usize>>> {
        let loaded = self.loaded.as_mut().expect("solvers are loaded first");
        Ok(loaded.advance(&*self.device, intervals, &|| false)?.unwrap_or_default())
    }

    /// Memory of the device that solvers take in place of those that it has (bytes), and what is free for them.
    fn room(&self, layout: &Layout) -> Result<(u64, u64)> {
        // The kernels number particles and nodes with 32 bits.
        if layout.particles.max(layout.nodes) > u32::MAX as usize {
            return Ok((u64::MAX, self.device.free_memory()?));
        }
        let held = self.loaded.as_ref().map_or(0, |loaded| loaded.layout.bytes());
        Ok((layout.bytes(), self.device.free_memory()?.saturating_add(held)))
    }

    fn load_all(&mut self, solvers: &[&Solver]) -> Result<()> {
        let layout = Layout::of(solvers);
        let (needed, free) = self.room(&layout)?;
        if needed > free {
            return Err(CudaError::Memory {
                device: self.number,
                needed: needed.div_ceil(1 << 20),
                free: free >> 20,
                remedy: "increase the spacing, reduce the domain or the number of particles",
            });
        }
        let host = self.loaded.take().map(|loaded| loaded.host);
        let mut loaded = Loaded::new(&*self.device, layout, host)?;
        loaded.host.write(solvers);
        loaded.load(&*self.device)?;
        self.loaded = Some(loaded);
        Ok(())
    }

    /// As [`Accelerator::run`]; `None` if it was cancelled.
    fn run_all(
        &mut self,
        intervals: &[Interval],
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Option<Vec<Option<usize>>>> {
        let loaded = self.loaded.as_mut().expect("solvers are loaded first");
        let lost = loaded.advance(&*self.device, intervals, cancelled)?;
        if lost.is_some() && intervals.iter().any(|interval| interval.substeps > 0) {
            loaded.store(&*self.device)?;
        }
        Ok(lost)
    }
}

fn failed(reason: CudaError) -> MpmError {
    MpmError::Device(reason.to_string())
}

impl Accelerator for Solvers {
    fn has_room(&self, solvers: &[&Solver]) -> std::result::Result<bool, MpmError> {
        let (needed, free) = self.room(&Layout::of(solvers)).map_err(failed)?;
        Ok(needed <= free)
    }

    fn load(&mut self, solvers: &[&Solver]) -> std::result::Result<(), MpmError> {
        self.load_all(solvers).map_err(failed)
    }

    fn run(
        &mut self,
        intervals: &[Interval],
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> std::result::Result<Vec<std::result::Result<(), usize>>, MpmError> {
        let lost = self.run_all(intervals, cancelled).map_err(failed)?;
        let lost = lost.ok_or(MpmError::Cancelled)?;
        Ok(lost.into_iter().map(|lost| lost.map_or(Ok(()), Err)).collect())
    }

    fn fetch(&mut self, solvers: &mut [&mut Solver]) {
        if let Some(loaded) = &mut self.loaded {
            loaded.host.read(solvers);
        }
    }
}

/// How far a scene is, `struct Status` of the kernels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(C)]
struct Status {
    done: u32,
    stopped: u32,
}

// SAFETY: two integers.
unsafe impl bytemuck::Zeroable for Status {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for Status {}

/// Scenes and their memory.
struct Loaded {
    layout: Layout,
    host: HostParticles,
    scenes: Buffer,
    /// The particles' states; the same sorted, or in the order of the solvers.
    states: [Buffer; 2],
    /// Cell of each particle, its place among those of the cell, and where each scene's particles are.
    keys: Buffer,
    arrivals: Buffer,
    places: Buffer,
    tiles: Buffer,
    /// Particles of each cell of the tiles.
    counts: Buffer,
    /// Places of particles that each scene has given to its tiles, and those of each tile.
    taken: Buffer,
    starts: Buffer,
    ends: Buffer,
    /// Patch of each tile; the tiles with particles, and those with nodes in their patches.
    slots: Buffer,
    list: Buffer,
    touched: Buffer,
    sorted: Buffer,
    patches: Buffer,
    nodes: Buffer,
    /// Before and after a substep, in turn.
    status: [Buffer; 2],
    drifted: Buffer,
    lost: Buffer,
    /// By the number of substeps.
    rounds: Graphs<u32>,
}

impl Loaded {
    /// Memory for scenes; `host` is used again if it is large enough.
    fn new(device: &dyn Device, layout: Layout, host: Option<HostParticles>) -> Result<Self> {
        let number = size_of::<u32>();
        let (n, tiles, scenes) = (layout.particles, layout.tiles.len(), layout.rows.len());
        let host = match host {
            Some(host) if host.length() >= n => host,
            _ => HostParticles::new(device, round_up(n.max(1), 4))?,
        };
        let list = |count: usize| device.allocate(count.max(1) * number);
        let states = || list(NUMBERS * host.length());
        let status = || device.allocate(scenes.max(1) * size_of::<Status>());
        let loaded = Self {
            scenes: device.allocate(size_of_val(&layout.rows[..]).max(1))?,
            states: [states()?, states()?],
            keys: list(n)?,
            arrivals: list(n)?,
            places: list(n)?,
            tiles: list(3 * tiles)?,
            counts: list(TILE * TILE * tiles)?,
            taken: list(scenes)?,
            starts: list(tiles)?,
            ends: list(tiles)?,
            slots: list(tiles)?,
            list: list(layout.most_active())?,
            touched: list(tiles)?,
            sorted: list(2)?,
            patches: device.allocate(PATCH * layout.most_active().max(1) * size_of::<i64>())?,
            nodes: list(4 * layout.nodes)?,
            status: [status()?, status()?],
            drifted: list(scenes)?,
            lost: list(scenes)?,
            rounds: Graphs::new(ROUNDS),
            host,
            layout,
        };
        device.write(&loaded.tiles, 0, bytemuck::cast_slice(&loaded.layout.tiles))?;
        device.write(&loaded.scenes, 0, bytemuck::cast_slice(&loaded.layout.rows))?;
        Ok(loaded)
    }

    /// Runs an interval of each scene; the particle that was lost, if any. `None` if it was cancelled.
    fn advance(
        &mut self,
        device: &dyn Device,
        intervals: &[Interval],
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Option<Vec<Option<usize>>>> {
        let scenes = self.layout.rows.len();
        assert_eq!(intervals.len(), scenes, "an interval for each solver");
        self.layout.set(intervals);
        if scenes == 0 || self.layout.particles == 0 {
            return Ok(Some(vec![None; scenes]));
        }
        device.write(&self.scenes, 0, bytemuck::cast_slice(&self.layout.rows))?;
        let begun =
            |interval: &Interval| Status { done: u32::from(interval.substeps == 0), stopped: 0 };
        let mut status: Vec<Status> = intervals.iter().map(begun).collect();
        device.write(&self.status[0], 0, bytemuck::cast_slice(&status))?;
        let mut lost = vec![NONE; scenes];
        device.write(&self.lost, 0, bytemuck::cast_slice(&lost))?;
        let most = intervals.iter().map(|interval| interval.substeps).max().unwrap_or_default();
        let substeps = substeps_of_a_round(most);
        let finished = |(status, interval): (&Status, &Interval)| status.done > interval.substeps;
        while !status
            .iter()
            .zip(intervals)
            .zip(&lost)
            .all(|(scene, &lost)| lost != NONE || finished(scene))
        {
            if cancelled() {
                return Ok(None);
            }
            self.rounds.run(device, substeps, || self.launch_round(device, substeps))?;
            device.read(&self.status[0], 0, bytemuck::cast_slice_mut(&mut status))?;
            device.read(&self.lost, 0, bytemuck::cast_slice_mut(&mut lost))?;
        }
        let index = |lost: u32| (lost != NONE).then_some(lost as usize);
        Ok(Some(lost.into_iter().map(index).collect()))
    }

    /// A launch with a thread for each particle of each scene.
    fn over_particles(&self) -> Shape {
        Shape::new(self.layout.largest.div_ceil(THREADS), self.layout.rows.len(), THREADS)
    }

    /// Particles from the memory of the host.
    fn load(&mut self, device: &dyn Device) -> Result<()> {
        if self.layout.particles == 0 {
            return Ok(());
        }
        let [states, listed] = self.states.each_ref();
        device.write(listed, 0, self.host.bytes())?;
        let arguments = [
            self.scenes.address().into(),
            listed.address().into(),
            states.address().into(),
            self.host.length().into(),
        ];
        // SAFETY: the arguments of the kernel; all lists are as long as `new` makes them.
        unsafe { device.launch(Queue::Main, Kernel::SolverLoad, self.over_particles(), &arguments) }
    }

    /// Particles to the memory of the host.
    fn store(&mut self, device: &dyn Device) -> Result<()> {
        if self.layout.particles == 0 {
            return Ok(());
        }
        let [states, listed] = self.states.each_ref();
        let arguments = [
            self.scenes.address().into(),
            listed.address().into(),
            states.address().into(),
            self.places.address().into(),
            self.host.length().into(),
        ];
        let shape = self.over_particles();
        // SAFETY: as above.
        unsafe { device.launch(Queue::Main, Kernel::SolverStore, shape, &arguments)? };
        device.read(listed, 0, self.host.bytes_mut())
    }

    /// Sorts the particles and puts so many substeps into the queue.
    fn launch_round(&self, device: &dyn Device, substeps: u32) -> Result<()> {
        self.launch_sort(device)?;
        for substep in 0..substeps as usize {
            let status = [substep % 2, (substep + 1) % 2].map(|k| self.status[k].address());
            self.launch_substep(device, status)?;
        }
        Ok(())
    }

    fn launch_sort(&self, device: &dyn Device) -> Result<()> {
        let length = self.host.length();
        let [from, to] = self.states.each_ref();
        let tiles = self.layout.tiles.len();
        for zero in [&self.counts, &self.taken, &self.sorted] {
            device.clear(Queue::Main, zero)?;
        }
        let count = [
            self.scenes.address().into(),
            from.address().into(),
            self.keys.address().into(),
            self.arrivals.address().into(),
            self.counts.address().into(),
            length.into(),
        ];
        let place = [
            self.scenes.address().into(),
            self.tiles.address().into(),
            self.counts.address().into(),
            self.taken.address().into(),
            self.starts.address().into(),
            self.ends.address().into(),
            self.slots.address().into(),
            self.list.address().into(),
            self.sorted.address().into(),
            tiles.into(),
            self.status[0].address().into(),
            self.drifted.address().into(),
            self.lost.address().into(),
            self.layout.rows.len().into(),
        ];
        let touch = [
            self.scenes.address().into(),
            self.tiles.address().into(),
            self.slots.address().into(),
            self.touched.address().into(),
            self.sorted.address().into(),
            tiles.into(),
        ];
        let rearrange = [
            self.scenes.address().into(),
            from.address().into(),
            to.address().into(),
            self.keys.address().into(),
            self.arrivals.address().into(),
            self.starts.address().into(),
            self.counts.address().into(),
            self.places.address().into(),
            length.into(),
        ];
        let over_tiles = Shape::new(tiles.div_ceil(THREADS), 1, THREADS);
        // SAFETY: as above.
        unsafe {
            device.launch(Queue::Main, Kernel::SolverCount, self.over_particles(), &count)?;
            device.launch(Queue::Main, Kernel::SolverTiles, over_tiles, &place)?;
            device.launch(Queue::Main, Kernel::SolverTouch, over_tiles, &touch)?;
            device.launch(Queue::Main, Kernel::SolverMove, self.over_particles(), &rearrange)?;
        }
        device.copy(from, to)
    }

    /// A substep of the scenes that are not done with theirs; `status` before and after.
    fn launch_substep(&self, device: &dyn Device, status: [Address; 2]) -> Result<()> {
        let tiles = self.layout.tiles.len();
        let particles: [Argument; 13] = [
            self.scenes.address().into(),
            self.tiles.address().into(),
            self.list.address().into(),
            self.sorted.address().into(),
            self.starts.address().into(),
            self.ends.address().into(),
            self.states[0].address().into(),
            self.host.length().into(),
            self.nodes.address().into(),
            self.patches.address().into(),
            status[0].into(),
            self.drifted.address().into(),
            self.lost.address().into(),
        ];
        let nodes: [Argument; 12] = [
            self.scenes.address().into(),
            self.tiles.address().into(),
            self.slots.address().into(),
            self.touched.address().into(),
            self.sorted.address().into(),
            self.patches.address().into(),
            self.nodes.address().into(),
            status[0].into(),
            status[1].into(),
            self.drifted.address().into(),
            self.lost.address().into(),
            self.layout.rows.len().into(),
        ];
        let active = Shape::new(self.layout.most_active().min(BLOCKS), 1, TILE_THREADS);
        let all = Shape::new(tiles.min(BLOCKS), 1, TILE * TILE);
        // SAFETY: as above.
        unsafe {
            device.launch(Queue::Main, Kernel::SolverParticles, active, &particles)?;
            device.launch(Queue::Main, Kernel::SolverNodes, all, &nodes)
        }
    }
}

/// Substeps of a round in an interval of at most `most`, which ends with one more that only gathers: an even number, because
/// successive substeps alternate between two status buffers.
fn substeps_of_a_round(most: u32) -> u32 {
    let steps = most + 1;
    steps.div_ceil(steps.div_ceil(MOST_SUBSTEPS)).next_multiple_of(2)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rounds_share_the_substeps_of_an_interval() {
        assert_eq!([0, 1, 63, 64, 153, 1000].map(substeps_of_a_round), [2, 2, 64, 34, 52, 64]);
    }
}
