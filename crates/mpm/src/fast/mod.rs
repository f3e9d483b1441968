//! The vectorised, multi-threaded solver. Tests compare it with the plain one ([`p2g`](super::p2g), [`grid`](super::grid),
//! [`g2p`](super::g2p)).
//!
//! The substeps of a call:
//!
//! 1. [`sort`]: sort particles by cell, store them in packs of sixteen ([`pack`]) and divide these into [`chunk`]s, each
//!    with its own patch of the grid. Repeated when particles have drifted.
//! 2. [`transfer`]: one pass over the particles of each chunk, in the vectors of [`simd`]: gather velocities ([`gather`])
//!    from the surrounding nodes ([`stencil`]), advance positions, update deformation and stress ([`law`]), scatter momentum
//!    ([`scatter`]).
//! 3. [`field`]: sum the patches to the velocities of all nodes; apply gravity, tools and walls; what liquids follow.
//!
//! Particles that do not see all of their nodes because of tools ([`sight`]) keep a part, as in the plain solver ([`obstacles`]).
//!
//! [`level`] selects the vector instructions at run time. The results are bit-identical for all of them and any number of
//! threads.
#![expect(
    unsafe_code,
    reason = "vector instructions, and threads that write to disjoint parts of one slice"
)]

mod chunk;
mod field;
mod gather;
mod law;
mod level;
mod obstacles;
mod pack;
mod scatter;
mod sight;
mod simd;
mod sort;
mod stencil;
#[cfg(test)]
mod tests;
mod transfer;
mod watch;

use std::sync::{
    Arc, Mutex, MutexGuard, PoisonError,
    atomic::{AtomicU32, Ordering},
};

use eddy_threads::{DisjointSlice, ThreadPool, share};

use chunk::Chunk;
use field::{Field, Forces, Nodes, Sum, Update};
use pack::Pack;
use sort::Packs;
use transfer::{Around, pass};
use watch::Search;

use super::{
    attractor::Attractor,
    bound::Bound,
    grid::GridShape,
    particle::Particle,
    solver::{SolverSettings, Stop},
    step::Step,
    tool::{Barriers, Loads, ToolMotion},
};

pub(super) use level::Level;

/// Maximum number of substeps between sorts: after that many, neighbours in a cell are no longer neighbours in memory.
const SORT_EVERY: u32 = 64;

/// What a run checks whenever particles are sorted, and at its end.
pub(super) struct Watch<'a> {
    /// Limits of the substep.
    pub(super) bound: Bound,
    /// Whether no further substeps are wanted.
    pub(super) cancelled: &'a (dyn Fn() -> bool + Sync),
}

/// Buffers reused from call to call. The state itself is in the particles.
#[derive(Clone, Debug)]
pub(super) struct Fast {
    level: Level,
    /// Shared by the copies of a solver.
    pool: Arc<Mutex<ThreadPool>>,
    field: Field,
    packs: Packs,
    chunks: Vec<Chunk>,
}

impl Fast {
    /// Buffers for a grid, and the threads.
    pub(super) fn new(shape: GridShape, threads: usize, level: Level) -> Self {
        let pool = ThreadPool::new("solver", threads, 0);
        if let Some(error) = pool.spawn_error() {
            let started = pool.threads();
            tracing::warn!("the solver has {started} threads instead of {threads}: {error}");
        }
        Self {
            level,
            pool: Arc::new(Mutex::new(pool)),
            field: Field::new(shape),
            packs: Packs::default(),
            chunks: Vec::new(),
        }
    }

    /// Writes the particles as they are after the substeps of a motion of tools to `advanced`, and what they have given to each tool.
    ///
    /// # Errors
    /// [`Stop::Lost`]; with a `watch` also the others.
    pub(super) fn run(
        &mut self,
        particles: &Vec<Particle>,
        advanced: &mut Vec<Particle>,
        settings: &SolverSettings,
        attractor: Option<Attractor>,
        (tools, loads): (&ToolMotion<'_>, &mut Loads),
        watch: Option<&Watch<'_>>,
    ) -> Result<(), Stop> {
        let substeps = tools.substeps;
        *loads = Loads::new(tools.tools.len());
        if particles.is_empty() || substeps == 0 {
            advanced.clone_from(particles);
            return Ok(());
        }
        // All are replaced at the end.
        advanced.resize(particles.len(), particles[0]);
        // After an error the lost particle keeps its position outside the grid.
        if let Some(lost) = particles.iter().position(|p| !settings.grid.contains(p.position)) {
            return Err(Stop::Lost { particle: lost, state: particles[lost] });
        }
        let step = &Step::of(settings);
        let forces = &Forces::new(settings, step, attractor);
        self.field.clear();
        self.packs.fill(particles, step, &self.field, &mut lock(&self.pool));
        // With tools, the velocities of the last substep are gathered before particles are sorted.
        let late = if tools.tools.is_empty() { 1 } else { 2 };
        self.packs.cut(&mut self.chunks, step, &self.field, late);
        let mut done = 0;
        while done < substeps {
            let gathered = done == 0 || !tools.tools.is_empty();
            if done > 0 {
                self.sort(step, late);
            }
            self.check(watch)?;
            let most = (substeps - done).min(SORT_EVERY);
            let barriers: Vec<_> =
                (done..=done + most).map(|substep| Barriers::new(tools, substep, step)).collect();
            let of_chunks = self.chunks.iter_mut().map(|chunk| &mut chunk.loads);
            for sum in of_chunks.chain(&mut self.field.loads) {
                *sum = Loads::new(tools.tools.len());
            }
            let run = self.substeps(gathered, most, step, forces, &barriers);
            done += run;
            self.check_lost()?;
            // What particles keep behind tools is known in the order in which they have scattered.
            if !tools.tools.is_empty() {
                let moved = [&barriers[run as usize - 1], &barriers[run as usize]];
                self.finish(step, moved, loads);
                self.check_lost()?;
            }
        }
        if tools.tools.is_empty() {
            self.finish(step, [&Barriers::default(); 2], loads);
            self.check_lost()?;
        }
        self.check(watch)?;
        for (particle, k) in self.packs.states() {
            advanced[k as usize] = particle;
        }
        Ok(())
    }

    /// Checks that further substeps are wanted, and short enough for the particles as they are.
    ///
    /// # Errors
    /// [`Stop::Cancelled`], [`Stop::TooLong`].
    fn check(&self, watch: Option<&Watch<'_>>) -> Result<(), Stop> {
        let Some(Watch { bound, cancelled }) = watch else { return Ok(()) };
        if cancelled() {
            return Err(Stop::Cancelled);
        }
        if !self.level.run(Search { packs: &self.packs.packs, bound }) {
            return Ok(());
        }
        bound.check(self.packs.states().map(|(particle, k)| (k as usize, particle)))
    }

    /// Sorts the particles again and divides them into chunks; `late` as in [`Chunk::lay`].
    fn sort(&mut self, step: &Step, late: i32) {
        self.packs.sort(step, &self.field, &mut lock(&self.pool));
        self.packs.cut(&mut self.chunks, step, &self.field, late);
    }

    /// Runs up to `most` substeps, up to the velocities of the nodes, and returns their number. Ends early when particles
    /// have to be sorted or one is lost. If they have `gathered`, they already have their velocities in the first substep. `barriers` are the
    /// tools before each substep, and after the last.
    fn substeps(
        &mut self,
        gathered: bool,
        most: u32,
        step: &Step,
        forces: &Forces,
        barriers: &[Barriers],
    ) -> u32 {
        let (level, stride) = (self.level, self.field.stride);
        let (rows, parts) = (self.field.sides[0], self.chunks.len());
        let packs = DisjointSlice::new(&mut self.packs.packs);
        let chunks = DisjointSlice::new(&mut self.chunks);
        let velocities = DisjointSlice::new(&mut self.field.velocity);
        let liquids = DisjointSlice::new(&mut self.field.liquid);
        let loads = DisjointSlice::new(&mut self.field.loads);
        let mut pool = lock(&self.pool);
        let threads = pool.threads().min(parts);
        let done = AtomicU32::new(0);
        pool.broadcast(threads, &|thread, barrier| {
            let mut sum = Sum::new(stride);
            for substep in 0..most {
                let now = &barriers[substep as usize];
                let before = &barriers[substep.saturating_sub(1) as usize];
                // SAFETY: each chunk, with its packs, belongs to one thread; no thread writes nodes.
                let (mine, velocity, liquid) = unsafe {
                    let mine = chunks.part(share(parts, thread, threads));
                    (mine, velocities.read(0..velocities.len()), liquids.read(0..liquids.len()))
                };
                let field = Nodes { velocity, liquid, stride };
                let around = Around { field, step, barriers: [before, now] };
                for chunk in mine {
                    // SAFETY: as above; the packs of different chunks are different.
                    let packs = unsafe { packs.part(chunk.packs()) };
                    let gathers = substep > 0 || !gathered;
                    scatter(level, gathers, chunk, packs, around);
                }
                barrier.wait();
                // SAFETY: no thread writes chunks before the next barrier.
                let all = unsafe { chunks.read(0..parts) };
                if all.iter().any(|chunk| chunk.lost) {
                    break;
                }
                for row in share(rows, thread, threads) {
                    let nodes = row * stride..(row + 1) * stride;
                    // SAFETY: each row belongs to one thread; no thread reads nodes.
                    let (velocity, liquid, loads) = unsafe {
                        let velocity = velocities.part(nodes.clone());
                        (velocity, liquids.part(nodes), &mut loads.part(row..row + 1)[0])
                    };
                    let sum = &mut sum;
                    level.run(Update {
                        forces,
                        row,
                        chunks: all,
                        velocity,
                        liquid,
                        sum,
                        barriers: now,
                        loads,
                    });
                }
                let drifted = all.iter().any(|chunk| chunk.drifted);
                barrier.wait();
                if thread == 0 {
                    done.store(substep + 1, Ordering::Relaxed);
                }
                if drifted {
                    break;
                }
            }
        });
        done.into_inner()
    }

    /// Gathers the velocities of the nodes: the end of the last substep, in which tools move as in `barriers`.
    fn finish(&mut self, step: &Step, barriers: [&Barriers; 2], loads: &mut Loads) {
        // With tools the margin is wide enough for this substep.
        if barriers[1].is_empty() && self.chunks.iter().any(|chunk| chunk.drifted) {
            self.sort(step, 1);
        }
        let Field { velocity, liquid, stride, .. } = &self.field;
        let field = Nodes { velocity, liquid, stride: *stride };
        let around = Around { field, step, barriers };
        for chunk in &mut self.chunks {
            let packs = &mut self.packs.packs[chunk.packs()];
            pass::<true, false, false>(self.level, chunk, packs, around);
            loads.add(&chunk.loads);
        }
        self.field.loads.iter().for_each(|of_row| loads.add(of_row));
    }

    /// Checks that no particle is lost.
    ///
    /// # Errors
    /// [`Stop::Lost`].
    fn check_lost(&self) -> Result<(), Stop> {
        let lost = self.chunks.iter().filter(|chunk| chunk.lost).flat_map(|chunk| {
            let states = chunk.particles().map(|k| sort::state(&self.packs.packs, k));
            states.filter(|(particle, _)| !chunk.holds_one(particle.position))
        });
        match lost.min_by_key(|(_, k)| *k) {
            None => Ok(()),
            Some((state, k)) => Err(Stop::Lost { particle: k as usize, state }),
        }
    }
}

/// Runs a pass over a chunk that scatters; if it does not gather, the particles have their velocities already.
fn scatter(level: Level, gathers: bool, chunk: &mut Chunk, packs: &mut [Pack], around: Around<'_>) {
    match (gathers, around.step.settling.is_some()) {
        (false, false) => pass::<false, true, false>(level, chunk, packs, around),
        (false, true) => pass::<false, true, true>(level, chunk, packs, around),
        (true, false) => pass::<true, true, false>(level, chunk, packs, around),
        (true, true) => pass::<true, true, true>(level, chunk, packs, around),
    }
}

/// Locks the pool, which stays usable after a panic in a job.
fn lock(pool: &Mutex<ThreadPool>) -> MutexGuard<'_, ThreadPool> {
    pool.lock().unwrap_or_else(PoisonError::into_inner)
}
