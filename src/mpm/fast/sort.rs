//! Particles in the order of their cells, cut into chunks.

use super::{field::Field, simd::LANES};

/// Most chunks; more threads than that have nothing to do.
const CHUNKS: usize = 16;
/// Particles of a chunk, at least: two overlapping patches cost more than a small chunk gains.
const FEWEST: usize = 512;

/// How many particles each chunk of `particles` gets: whole packs, but for the last one.
pub(super) fn chunk_sizes(particles: usize) -> Vec<usize> {
    let packs = particles.div_ceil(LANES);
    let chunks = (particles / FEWEST).clamp(1, CHUNKS);
    (0..chunks)
        .map(|k| {
            let end = |k: usize| (packs * k / chunks * LANES).min(particles);
            end(k + 1) - end(k)
        })
        .collect()
}

/// Orders particles by the lowest nodes of their stencils, row by row. Those of one cell keep their
/// order.
#[derive(Clone, Debug, Default)]
pub(super) struct Order {
    /// The number that each place gets: places in the old order.
    pub(super) places: Vec<u32>,
    keys: Vec<u32>,
    starts: Vec<u32>,
}

impl Order {
    /// Finds the order of particles with these lowest nodes.
    pub(super) fn sort(&mut self, lowest: impl Iterator<Item = [i32; 2]>, field: &Field) {
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
