//! The order of a stream's particles in memory: sorted by grid cell in its first frame.
//!
//! Particles that are processed together were neighbours then, and most still are. In the order of the input they could be
//! anywhere, and every access to a neighbour would miss the cache.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use eddy_frames::{Frame, Particles};
use eddy_threads::{DisjointSlice, Task, ThreadPool};

/// The particles sorted by cells, row by row.
pub(super) fn spatial_order(frame: &Frame, cell_width: f32) -> Vec<u32> {
    let lower = frame.domain.lower;
    let cell = |particle: u32| {
        let x = frame.position[particle as usize];
        [1, 0].map(|axis| ((x[axis] - lower[axis]) / cell_width) as i32)
    };
    let mut order: Vec<_> = (0..frame.len() as u32).collect();
    order.sort_by_cached_key(|&particle| cell(particle));
    order
}

/// Particles per item.
const ITEM_ROWS: usize = 4096;

/// Copies positions and velocities of a frame into `state`, particle `order[row]` into each row. This is the only pass over
/// the observed frame.
pub(super) fn reorder(
    pool: &mut ThreadPool,
    alone: bool,
    order: &[u32],
    particles: Particles<'_>,
    state: &mut [Vec<[f32; 2]>; 2],
) {
    for list in &mut *state {
        list.resize(order.len(), [0.0; 2]);
    }
    let [position, velocity] = state.each_mut().map(|list| DisjointSlice::new(list));
    let alone = alone || order.len() <= 2 * ITEM_ROWS;
    pool.run([order.len().div_ceil(ITEM_ROWS)], alone, &|Task { item, .. }| {
        let rows = item * ITEM_ROWS..((item + 1) * ITEM_ROWS).min(order.len());
        // SAFETY: only this item uses these rows.
        let lists = unsafe { (position.part(rows.clone()), velocity.part(rows.clone())) };
        for ((&particle, x), v) in order[rows].iter().zip(lists.0).zip(lists.1) {
            (*x, *v) = particles.motion(particle as usize);
        }
    });
}
