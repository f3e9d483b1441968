//! Sorts particles by cell, into packs and chunks.

use eddy_threads::{DisjointSlice, ThreadPool, share};

use super::{
    super::{particle::Particle, step::Step},
    chunk::Chunk,
    field::Field,
    pack::Pack,
    simd::LANES,
};

/// Maximum number of chunks, and so of threads with work.
const MAX_CHUNKS: usize = 16;
/// Minimum number of particles of a chunk: the overlap of patches costs more than smaller chunks gain.
const MIN_CHUNK_PARTICLES: usize = 512;
/// Packs above which all threads fill them.
const WORTH_WAKING: usize = 1000;

/// All particles, in packs.
#[derive(Clone, Debug, Default)]
pub(super) struct Packs {
    /// The packs; only the last one may be partially filled.
    pub(super) packs: Vec<Pack>,
    /// Number of particles.
    particles: usize,
    /// Buffer for sorted packs.
    sorted: Vec<Pack>,
    order: Order,
}

impl Packs {
    /// Stores particles in sorted order.
    pub(super) fn fill(
        &mut self,
        particles: &[Particle],
        step: &Step,
        field: &Field,
        pool: &mut ThreadPool,
    ) {
        self.particles = particles.len();
        self.order.find(particles.iter().map(|p| step.lowest(p.position)), field);
        let numbered = |place: u32| (particles[place as usize], place);
        collect(&self.order.places, numbered, &mut self.packs, pool);
    }

    /// Sorts the particles again.
    pub(super) fn sort(&mut self, step: &Step, field: &Field, pool: &mut ThreadPool) {
        let packs = &self.packs;
        let lowest = (0..self.particles).map(|place| lowest(packs, place, step));
        self.order.find(lowest, field);
        let numbered = |place: u32| state(packs, place as usize);
        collect(&self.order.places, numbered, &mut self.sorted, pool);
        std::mem::swap(&mut self.packs, &mut self.sorted);
    }

    /// Every particle with its index in the solver.
    pub(super) fn states(&self) -> impl Iterator<Item = (Particle, u32)> {
        (0..self.particles).map(|k| state(&self.packs, k))
    }

    /// Divides the packs into chunks of about the same size.
    pub(super) fn cut(&self, chunks: &mut Vec<Chunk>, step: &Step, field: &Field, late: i32) {
        let count = (self.particles / MIN_CHUNK_PARTICLES).clamp(1, MAX_CHUNKS);
        let end = |k: usize| (self.packs.len() * k / count * LANES).min(self.particles);
        chunks.resize_with(count, Chunk::default);
        for (k, chunk) in chunks.iter_mut().enumerate() {
            let range = end(k)..end(k + 1);
            let (mut least, mut most) = ([i32::MAX; 2], [i32::MIN; 2]);
            for k in range.clone() {
                let lowest = lowest(&self.packs, k, step);
                for axis in 0..2 {
                    least[axis] = least[axis].min(lowest[axis]);
                    most[axis] = most[axis].max(lowest[axis]);
                }
            }
            chunk.lay(range, least, most, field, late);
        }
    }
}

/// The state of a particle in packs, and its index in the solver.
pub(super) fn state(packs: &[Pack], place: usize) -> (Particle, u32) {
    let (pack, lane) = (&packs[place / LANES], place % LANES);
    (pack.get(lane), pack.index[lane])
}

/// The lowest node of the stencil of a particle in packs.
fn lowest(packs: &[Pack], place: usize, step: &Step) -> [i32; 2] {
    let [x, y] = &packs[place / LANES].position;
    step.lowest([x[place % LANES], y[place % LANES]])
}

/// Stores the particles at these places in packs.
fn collect(
    places: &[u32],
    numbered: impl Fn(u32) -> (Particle, u32) + Sync,
    packs: &mut Vec<Pack>,
    pool: &mut ThreadPool,
) {
    let pack = |k: usize| {
        let places = &places[k * LANES..places.len().min((k + 1) * LANES)];
        let (first, index) = numbered(places[0]);
        let mut pack = Pack::filled(&first, index);
        for (lane, &place) in places.iter().enumerate() {
            let (particle, index) = numbered(place);
            pack.set(lane, &particle, index);
        }
        pack
    };
    let length = places.len().div_ceil(LANES);
    if length <= WORTH_WAKING {
        packs.clear();
        packs.extend((0..length).map(pack));
        return;
    }
    packs.resize_with(length, || pack(0));
    let (threads, packs) = (pool.threads(), DisjointSlice::new(packs));
    pool.broadcast(threads, &|thread, _| {
        let mine = share(length, thread, threads);
        // SAFETY: shares are disjoint.
        for (to, k) in unsafe { packs.part(mine.clone()) }.iter_mut().zip(mine) {
            *to = pack(k);
        }
    });
}

/// Counting sort of particles by the lowest nodes of their stencils, row by row. Stable within a cell.
#[derive(Clone, Debug, Default)]
struct Order {
    /// Previous place of the particle at each place.
    places: Vec<u32>,
    keys: Vec<u32>,
    starts: Vec<u32>,
}

impl Order {
    /// Sorts particles with these lowest nodes.
    fn find(&mut self, lowest: impl Iterator<Item = [i32; 2]>, field: &Field) {
        let columns = field.sides[1] as u32;
        self.keys.clear();
        self.keys.extend(lowest.map(|[x, y]| x as u32 * columns + y as u32));
        self.starts.clear();
        self.starts.resize(field.sides[0] * field.sides[1] + 1, 0);
        for &key in &self.keys {
            self.starts[key as usize + 1] += 1;
        }
        let mut total = 0;
        for start in &mut self.starts {
            total += *start;
            *start = total;
        }
        self.places.resize(self.keys.len(), 0);
        for (old, &key) in self.keys.iter().enumerate() {
            let place = &mut self.starts[key as usize];
            self.places[*place as usize] = old as u32;
            *place += 1;
        }
    }
}
