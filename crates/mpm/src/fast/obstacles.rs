//! Tools beside the particles of a chunk: those that may not see all of their nodes are computed one by one, as in the plain solver.

use super::{
    super::{
        g2p,
        grid::Node,
        material::DENSITY,
        particle::Particle,
        spline::Stencil,
        step::Step,
        tool::{Barriers, Hidden},
    },
    chunk::Chunk,
    field::Nodes,
    pack::Pack,
    simd::LANES,
    transfer::Scratch,
};

/// The tools in a pass.
#[derive(Clone, Copy, Debug)]
pub(super) struct Obstacles<'a> {
    /// Where they were when particles have scattered, and where they are when they have moved.
    pub(super) barriers: [&'a Barriers; 2],
}

/// A particle that has scattered beside a tool.
#[derive(Clone, Debug)]
pub(super) struct Kept {
    /// Its pack in the chunk.
    pack: usize,
    lane: usize,
    /// As it was then.
    particle: Particle,
    hidden: Hidden,
}

impl<'a> Obstacles<'a> {
    /// `None` if there are no tools.
    pub(super) fn of(barriers: [&'a Barriers; 2]) -> Option<Self> {
        (!barriers[1].is_empty()).then_some(Self { barriers })
    }

    /// Gathers the particles of a pack that have scattered beside a tool, in place of what the pack has gathered: the first of `kept`,
    /// which are left out then.
    pub(super) fn gather(
        &self,
        number: usize,
        pack: &mut Pack,
        lanes: usize,
        kept: &mut &[Kept],
        field: Nodes<'_>,
        step: &Step,
    ) {
        let mass = DENSITY * step.dx * step.dx / step.particles_per_cell;
        while let Some((first, rest)) = kept.split_first().filter(|(first, _)| first.pack == number)
        {
            *kept = rest;
            let stencil = Stencil::at(first.particle.position, step.inverse_dx);
            let node = |[i, j]: [usize; 2]| {
                let at = (stencil.base[0] + i) * field.stride + stencil.base[1] + j;
                let liquid = field.liquid[at];
                Node { motion: field.velocity[at], mass: liquid * mass, area: liquid, solid: 0.0 }
            };
            let mut particle = first.particle;
            g2p::advance(&mut particle, &stencil, node, Some(&first.hidden), self.barriers, step);
            pack.set(first.lane, &particle, pack.index[first.lane]);
        }
        // Unused lanes stay copies of another particle.
        for lane in lanes..LANES {
            pack.set(lane, &pack.get(0), pack.index[0]);
        }
    }

    /// Scatters the particles of a pack that are beside a tool, and marks them in `scratch`.
    pub(super) fn scatter<const SETTLING: bool>(
        &self,
        number: usize,
        pack: &Pack,
        lanes: usize,
        scratch: &mut Scratch,
        chunk: &mut Chunk,
        step: &Step,
    ) {
        scratch.apart = 0;
        let [_, now] = self.barriers;
        if !now.are_near(bounds(pack)) {
            return;
        }
        for lane in 0..lanes.min(LANES) {
            let position = pack.position.map(|along| along[lane]);
            let stencil = Stencil::at(position, step.inverse_dx);
            let [lowest, along_x, along_y] =
                scratch.vectors.each_ref().map(|vectors| vectors[lane]);
            let given = |[i, j]: [usize; 2]| {
                [0, 1].map(|k| lowest[k] + i as f32 * along_x[k] + j as f32 * along_y[k])
            };
            let falling = |place: [usize; 2]| {
                let [x, y] = given(place);
                [x, y - step.fall]
            };
            let Some(hidden) = now.hidden(position, &stencil, falling, &mut chunk.loads) else {
                continue;
            };
            scratch.apart |= 1 << lane;
            let solid = if SETTLING && scratch.has_solids { scratch.solid[lane] } else { 0.0 };
            let of_settling = SETTLING.then_some([solid, scratch.area[lane]]);
            for (place, weight, _) in stencil.nodes().filter(|(place, ..)| hidden.sees(*place)) {
                let at = [0, 1].map(|k| (stencil.base[k] + place[k]) as i32 - chunk.origin[k]);
                chunk.add(at.map(|k| k as usize), weight, given(place), of_settling);
            }
            chunk.kept.push(Kept { pack: number, lane, particle: pack.get(lane), hidden });
        }
    }
}

/// Corners of the box around the particles of a pack, lower first.
fn bounds(pack: &Pack) -> [[f32; 2]; 2] {
    let [mut lower, mut upper] = [pack.position.map(|along| along[0]); 2];
    for axis in 0..2 {
        for x in pack.position[axis] {
            lower[axis] = if x < lower[axis] { x } else { lower[axis] };
            upper[axis] = if x > upper[axis] { x } else { upper[axis] };
        }
    }
    [lower, upper]
}
