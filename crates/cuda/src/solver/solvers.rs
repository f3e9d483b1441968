//! Solvers side by side on a device.
//!
//! An interval of all scenes is a number of rounds of [`MOST_SUBSTEPS`] substeps at most, each one graph:
//!
//! | stage | a block has | reads | writes |
//! |---|---|---|---|
//! | count, tiles, touch, move | 256 particles or tiles | positions | particles sorted by tiles |
//! | particles | a tile of 8 x 8 cells | particles, nodes around the tile | particles, a patch of 14 x 14 nodes |
//! | nodes | 8 x 8 nodes | the patches that cover them | velocity, mass and J of nodes |
//!
//! The last two are repeated for every substep. A scene that has finished, or has to wait until its particles are sorted,
//! skips its part of the round; the host reads how far each one is and starts rounds until all have finished.

#![expect(unsafe_code, reason = "launches, and memory that the device reads and writes")]

use std::sync::Arc;

use eddy_mpm::{Accelerator, Interval, MpmError, Solver};

use super::{
    layout::{Layout, NUMBERS, PATCH_NUMBERS},
    particles::HostParticles,
};
use crate::{
    device::{Device, Kernel, List, Pointer, Queue, Shape, count},
    error::{CudaError, Result},
    graphs::Graphs,
    kernels::{
        round_up,
        solver::solver::{
            CELLS, NONE, Scene, SolverCount, SolverLoad, SolverMove, SolverNodes, SolverParticles,
            SolverStore, SolverTiles, SolverTouch, Sorted, Status, THREADS as TILE_THREADS, Tile,
        },
    },
};

/// Recorded rounds that are kept.
const ROUNDS: usize = 4;
/// Substeps of a round, at most: after that many, the particles of a tile are no longer near it.
const MOST_SUBSTEPS: u32 = 64;
/// Threads of a block over the particles of a scene, or over tiles.
const THREADS: usize = 256;
/// Blocks over tiles, at most; each goes on with further tiles.
const BLOCKS: usize = 16384;
/// No particle is lost.
const NOT_LOST: u32 = NONE as u32;

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
        if let Some(tools) =
            solvers.iter().map(|solver| solver.tools.len()).find(|&tools| tools > 0)
        {
            let setting = format!("a scene with {tools} tools");
            return Err(CudaError::Unsupported { setting, expected: "none: `--device cpu`" });
        }
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

/// Scenes and their memory.
struct Loaded {
    layout: Layout,
    host: HostParticles,
    scenes: List<Scene>,
    /// The particles' states; the same sorted, or in the order of the solvers.
    states: [List<f32>; 2],
    /// Cell of each particle, its place among those of the cell, and where each scene's particles are.
    keys: List<u32>,
    arrivals: List<u32>,
    places: List<u32>,
    tiles: List<Tile>,
    /// Particles of each cell of the tiles.
    counts: List<u32>,
    /// Places of particles that each scene has given to its tiles, and those of each tile.
    taken: List<u32>,
    starts: List<u32>,
    ends: List<u32>,
    /// Patch of each tile; the tiles with particles, and those with nodes in their patches.
    slots: List<u32>,
    list: List<u32>,
    touched: List<u32>,
    sorted: List<Sorted>,
    patches: List<i64>,
    nodes: List<[f32; 4]>,
    /// Before and after a substep, in turn.
    status: [List<Status>; 2],
    drifted: List<u32>,
    lost: List<u32>,
    /// By the number of substeps.
    rounds: Graphs<u32>,
}

impl Loaded {
    /// Memory for scenes; `host` is used again if it is large enough.
    fn new(device: &dyn Device, layout: Layout, host: Option<HostParticles>) -> Result<Self> {
        let (n, tiles, scenes) = (layout.particles, layout.tiles.len(), layout.scenes.len());
        let host = match host {
            Some(host) if host.length() >= n => host,
            _ => HostParticles::new(device, round_up(n.max(1), 4))?,
        };
        let list = |count: usize| List::new(device, count);
        let states = || List::new(device, NUMBERS * host.length());
        let status = || List::new(device, scenes);
        Ok(Self {
            scenes: List::of(device, &layout.scenes)?,
            states: [states()?, states()?],
            keys: list(n)?,
            arrivals: list(n)?,
            places: list(n)?,
            tiles: List::of(device, &layout.tiles)?,
            counts: list(CELLS * tiles)?,
            taken: list(scenes)?,
            starts: list(tiles)?,
            ends: list(tiles)?,
            slots: list(tiles)?,
            list: list(layout.most_active())?,
            touched: list(tiles)?,
            sorted: List::new(device, 1)?,
            patches: List::new(device, PATCH_NUMBERS * layout.most_active())?,
            nodes: List::new(device, layout.nodes)?,
            status: [status()?, status()?],
            drifted: list(scenes)?,
            lost: list(scenes)?,
            rounds: Graphs::new(ROUNDS),
            host,
            layout,
        })
    }

    /// Runs an interval of each scene; the particle that was lost, if any. `None` if it was cancelled.
    fn advance(
        &mut self,
        device: &dyn Device,
        intervals: &[Interval],
        cancelled: &(dyn Fn() -> bool + Sync),
    ) -> Result<Option<Vec<Option<usize>>>> {
        let scenes = self.layout.scenes.len();
        assert_eq!(intervals.len(), scenes, "an interval for each solver");
        self.layout.set(intervals);
        if scenes == 0 || self.layout.particles == 0 {
            return Ok(Some(vec![None; scenes]));
        }
        device.write(&self.scenes, 0, bytemuck::cast_slice(&self.layout.scenes))?;
        let begun =
            |interval: &Interval| Status { done: u32::from(interval.substeps == 0), stopped: 0 };
        let mut status: Vec<Status> = intervals.iter().map(begun).collect();
        device.write(&self.status[0], 0, bytemuck::cast_slice(&status))?;
        let mut lost = vec![NOT_LOST; scenes];
        device.write(&self.lost, 0, bytemuck::cast_slice(&lost))?;
        let most = intervals.iter().map(|interval| interval.substeps).max().unwrap_or_default();
        let substeps = substeps_of_a_round(most);
        let finished = |(status, interval): (&Status, &Interval)| status.done > interval.substeps;
        while !status
            .iter()
            .zip(intervals)
            .zip(&lost)
            .all(|(scene, &lost)| lost != NOT_LOST || finished(scene))
        {
            if cancelled() {
                return Ok(None);
            }
            self.rounds.run(device, substeps, || self.launch_round(device, substeps))?;
            device.read(&self.status[0], 0, bytemuck::cast_slice_mut(&mut status))?;
            device.read(&self.lost, 0, bytemuck::cast_slice_mut(&mut lost))?;
        }
        let index = |lost: u32| (lost != NOT_LOST).then_some(lost as usize);
        Ok(Some(lost.into_iter().map(index).collect()))
    }

    /// A launch with a thread for each particle of each scene.
    fn over_particles(&self) -> Shape {
        Shape::new(self.layout.largest.div_ceil(THREADS), self.layout.scenes.len(), THREADS)
    }

    /// Particles from the memory of the host.
    fn load(&mut self, device: &dyn Device) -> Result<()> {
        if self.layout.particles == 0 {
            return Ok(());
        }
        let [states, listed] = self.states.each_ref();
        device.write(listed, 0, self.host.bytes())?;
        let load = SolverLoad {
            scenes: self.scenes.pointer(),
            listed: listed.pointer(),
            base: states.pointer(),
            n: count(self.host.length()),
        };
        launch(device, self.over_particles(), load)
    }

    /// Particles to the memory of the host.
    fn store(&mut self, device: &dyn Device) -> Result<()> {
        if self.layout.particles == 0 {
            return Ok(());
        }
        let [states, listed] = self.states.each_ref();
        let store = SolverStore {
            scenes: self.scenes.pointer(),
            listed: listed.pointer(),
            base: states.pointer(),
            places: self.places.pointer(),
            n: count(self.host.length()),
        };
        launch(device, self.over_particles(), store)?;
        device.read(listed, 0, self.host.bytes_mut())
    }

    /// Sorts the particles and puts so many substeps into the queue.
    fn launch_round(&self, device: &dyn Device, substeps: u32) -> Result<()> {
        self.launch_sort(device)?;
        for substep in 0..substeps as usize {
            let status = [substep % 2, (substep + 1) % 2].map(|k| self.status[k].pointer());
            self.launch_substep(device, status)?;
        }
        Ok(())
    }

    fn launch_sort(&self, device: &dyn Device) -> Result<()> {
        let [from, to] = self.states.each_ref();
        for zero in [&*self.counts, &*self.taken, &*self.sorted] {
            device.clear(Queue::Main, zero)?;
        }
        let (scenes, tiles) = (self.scenes.pointer(), self.tiles.pointer());
        let (keys, arrivals) = (self.keys.pointer(), self.arrivals.pointer());
        let (counts, starts, slots) =
            (self.counts.pointer(), self.starts.pointer(), self.slots.pointer());
        let (sorted, base) = (self.sorted.pointer(), from.pointer());
        let (n, tile_count) = (count(self.host.length()), count(self.layout.tiles.len()));
        let over_tiles = Shape::new(self.layout.tiles.len().div_ceil(THREADS), 1, THREADS);
        let particles = SolverCount { scenes, base, keys, arrivals, counts, n };
        launch(device, self.over_particles(), particles)?;
        launch(
            device,
            over_tiles,
            SolverTiles {
                scenes,
                tiles,
                counts: counts.cast(),
                taken: self.taken.pointer(),
                starts,
                ends: self.ends.pointer(),
                slots,
                list: self.list.pointer(),
                sorted,
                tile_count,
                status: self.status[0].pointer(),
                drifted: self.drifted.pointer(),
                lost: self.lost.pointer(),
                scene_count: count(self.layout.scenes.len()),
            },
        )?;
        let touched = self.touched.pointer();
        let touch = SolverTouch { scenes, tiles, slots, touched, sorted, tile_count };
        launch(device, over_tiles, touch)?;
        let (to_base, places) = (to.pointer(), self.places.pointer());
        launch(
            device,
            self.over_particles(),
            SolverMove {
                scenes,
                from_base: base,
                to_base,
                keys,
                arrivals,
                starts,
                counts: counts.cast(),
                places,
                n,
            },
        )?;
        device.copy(from, to)
    }

    /// A substep of the scenes that are not done with theirs; `status` before and after.
    fn launch_substep(&self, device: &dyn Device, status: [Pointer<Status>; 2]) -> Result<()> {
        let (scenes, tiles) = (self.scenes.pointer(), self.tiles.pointer());
        let (sorted, nodes, patches) =
            (self.sorted.pointer(), self.nodes.pointer(), self.patches.pointer());
        let (drifted, lost) = (self.drifted.pointer(), self.lost.pointer());
        launch(
            device,
            Shape::new(self.layout.most_active().min(BLOCKS), 1, TILE_THREADS),
            SolverParticles {
                scenes,
                tiles,
                list: self.list.pointer(),
                sorted,
                starts: self.starts.pointer(),
                ends: self.ends.pointer(),
                base: self.states[0].pointer(),
                n: count(self.host.length()),
                nodes,
                patches,
                status: status[0],
                drifted,
                lost,
            },
        )?;
        launch(
            device,
            Shape::new(self.layout.tiles.len().min(BLOCKS), 1, CELLS),
            SolverNodes {
                scenes,
                tiles,
                slots: self.slots.pointer(),
                touched: self.touched.pointer(),
                sorted,
                patches,
                nodes,
                status: status[0],
                next: status[1],
                drifted,
                lost,
                scene_count: count(self.layout.scenes.len()),
            },
        )
    }
}

/// Puts a kernel into the main queue; all lists are as long as [`Loaded::new`] makes them.
fn launch(device: &dyn Device, shape: Shape, kernel: impl Kernel) -> Result<()> {
    // SAFETY: as above.
    unsafe { device.launch(Queue::Main, shape, &kernel) }
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
