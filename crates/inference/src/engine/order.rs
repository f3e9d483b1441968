//! In which order a stream's particles lie in memory: that of their places in its first frame.
//!
//! Particles that are worked on one after the other were near each other then, and most still are. In the
//! order in which they come they may lie anywhere, and every look at one would wait for memory.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use super::crew::{Crew, Parts, Task};
use eddy_frames::{Frame, Particles};

/// The particles by rows of cells, so that what is worked on one after the other is near in memory, too.
pub(super) fn by_place(frame: &Frame, cell_width: f32) -> Vec<u32> {
    let lower = frame.domain.lower;
    let cell = |particle: u32| {
        let x = frame.position[particle as usize];
        [1, 0].map(|axis| ((x[axis] - lower[axis]) / cell_width) as i32)
    };
    let mut order: Vec<_> = (0..frame.len() as u32).collect();
    order.sort_by_cached_key(|&particle| cell(particle));
    order
}

/// Particles that are put in order at once.
const SOME: usize = 4096;

/// Positions and velocities of a frame's particles, those of particle `order[row]` in each row: the one time
/// that what was observed is read.
pub(super) fn put_in_order(
    crew: &mut Crew,
    alone: bool,
    order: &[u32],
    particles: Particles<'_>,
    state: &mut [Vec<[f32; 2]>; 2],
) {
    for list in &mut *state {
        list.resize(order.len(), [0.0; 2]);
    }
    let [position, velocity] = state.each_mut().map(|list| Parts::new(list));
    let alone = alone || order.len() <= 2 * SOME;
    crew.run([order.len().div_ceil(SOME)], alone, &|Task { item, .. }| {
        let rows = item * SOME..((item + 1) * SOME).min(order.len());
        // SAFETY: these rows are those of this item alone.
        let lists = unsafe { (position.part(rows.clone()), velocity.part(rows.clone())) };
        for ((&particle, x), v) in order[rows].iter().zip(lists.0).zip(lists.1) {
            (*x, *v) = particles.motion(particle as usize);
        }
    });
}
