//! Physical measures of predicted states beside true ones.
//!
//! 1. `density`: where the mass is.
//! 2. `bulk`: kinetic energy, centre of mass, what is outside the walls.
//! 3. `flight`: momentum and spin of bodies that nothing touches.
//! 4. `area`: the area that liquids occupy.
//! 5. `stretch`: how far rope and jelly are stretched and distorted.
//! 6. `blow_up`: rollouts that no truth could come near.

mod area;
mod blow_up;
pub(super) mod bulk;
mod density;
mod flight;
mod stretch;

use super::{Arena, errors::square};
use crate::{
    dataset::{State, Stream},
    frame::Material,
};

pub use blow_up::Extremes;
pub(super) use blow_up::{VelocityLimits, is_blown_up};
pub use flight::FlightSums;
pub(super) use flight::Flights;

/// The frames ahead at which measures are taken, and that tables show.
pub const SHOWN: [usize; 6] = [1, 5, 10, 20, 50, 100];

/// A mean, or a ratio of sums, while it is added up.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Mean {
    /// What was added.
    pub sum: f64,
    /// What it is divided by.
    pub weight: f64,
}

impl Mean {
    /// Adds a value that counts as much as `weight`.
    pub fn add(&mut self, value: f64, weight: f64) {
        self.sum += value;
        self.weight += weight;
    }

    /// The mean; NaN when nothing was added.
    pub fn value(&self) -> f64 {
        self.sum / self.weight
    }

    fn merge(&mut self, other: &Self) {
        self.add(other.sum, other.weight);
    }
}

/// Measures at one frame ahead, added up over windows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Physics {
    /// Share of the mass that is in another place than in the truth, on a lattice of four spacings.
    pub misplaced: Mean,
    /// |K - K'| over K', the kinetic energy of the truth.
    pub kinetic_energy: Mean,
    /// Squared distance of the centres of mass (domain lengths^2).
    pub centre: Mean,
    /// Share of the particles that are beyond a wall in effect by more than half a spacing.
    pub outside: Mean,
    /// Area that liquid occupies over that in the truth.
    pub liquid_area: Mean,
    /// Distance of rest neighbours within rope over that in the first frame.
    pub rope_stretch: Mean,
    /// Squared deviation of that from 1.
    pub rope_distortion: Mean,
    /// As `rope_stretch`, of jelly.
    pub jelly_stretch: Mean,
    /// As `rope_distortion`, of jelly.
    pub jelly_distortion: Mean,
}

impl Physics {
    /// Adds the measures of other windows.
    pub fn merge(&mut self, other: &Self) {
        for (sum, other) in self.each_mut().into_iter().zip(other.each()) {
            sum.merge(other);
        }
    }

    fn each(&self) -> [&Mean; 9] {
        [
            &self.misplaced,
            &self.kinetic_energy,
            &self.centre,
            &self.outside,
            &self.liquid_area,
            &self.rope_stretch,
            &self.rope_distortion,
            &self.jelly_stretch,
            &self.jelly_distortion,
        ]
    }

    fn each_mut(&mut self) -> [&mut Mean; 9] {
        [
            &mut self.misplaced,
            &mut self.kinetic_energy,
            &mut self.centre,
            &mut self.outside,
            &mut self.liquid_area,
            &mut self.rope_stretch,
            &mut self.rope_distortion,
            &mut self.jelly_stretch,
            &mut self.jelly_distortion,
        ]
    }
}

/// What is known of a scene before anything is measured in it.
pub(super) struct Rest {
    lattice: density::Lattice,
    rope: stretch::Solids,
    jelly: stretch::Solids,
}

impl Rest {
    /// The scene of a stream, whose first frame is its rest shape.
    pub(super) fn new(arena: &Arena, stream: &Stream) -> Self {
        let position = &stream.states[0].position;
        let solids = |solid| stretch::Solids::new(position, &stream.material, solid, arena.spacing);
        Self {
            lattice: density::Lattice::new(arena.domain, arena.spacing),
            rope: solids(Material::Rope),
            jelly: solids(Material::Jelly),
        }
    }
}

/// The true side of one window.
pub(super) struct Window<'a> {
    /// The states after the start, up to the horizon or the end of the stream.
    pub(super) truth: &'a [State],
    shown: Vec<Shown>,
}

/// The truth at one of [`SHOWN`].
struct Shown {
    ahead: usize,
    map: Vec<f32>,
    kinetic_energy: f64,
    centre: [f64; 2],
    liquid_area: f64,
}

impl<'a> Window<'a> {
    /// The window after frame `start` of a stream. Nothing is measured without `rest`.
    pub(super) fn new(
        arena: &Arena,
        stream: &'a Stream,
        start: usize,
        rest: Option<&Rest>,
    ) -> Self {
        let end = stream.states.len().min(start + 1 + arena.settings.horizon);
        let truth = &stream.states[start + 1..end];
        let Some(rest) = rest else { return Self { truth, shown: Vec::new() } };
        let shown = SHOWN.into_iter().filter(|&ahead| ahead <= truth.len());
        let shown = shown.map(|ahead| {
            let state = &truth[ahead - 1];
            Shown {
                ahead,
                map: rest.lattice.map(&state.position),
                kinetic_energy: bulk::kinetic_energy(&state.velocity),
                centre: bulk::mean(state.position.iter()),
                liquid_area: liquid_area(arena, &stream.material, state),
            }
        });
        Self { truth, shown: shown.collect() }
    }

    /// Adds the measures of predicted states to those at each of [`SHOWN`].
    pub(super) fn measure(
        &self,
        arena: &Arena,
        material: &[Material],
        rest: &Rest,
        predicted: &[State],
        sums: &mut [Physics],
    ) {
        let walls = [arena.ballistic.lower, arena.ballistic.upper];
        for (shown, sums) in self.shown.iter().zip(sums) {
            let state = &predicted[shown.ahead - 1];
            let map = rest.lattice.map(&state.position);
            sums.misplaced.add(density::misplaced(&map, &shown.map), 1.0);
            let energy = bulk::kinetic_energy(&state.velocity);
            let apart = (energy - shown.kinetic_energy).abs();
            sums.kinetic_energy.add(apart, shown.kinetic_energy);
            let centre = bulk::mean(state.position.iter());
            let apart = [centre[0] - shown.centre[0], centre[1] - shown.centre[1]];
            sums.centre.add(square(apart), 1.0);
            let outside = bulk::share_outside(&state.position, walls, 0.5 * arena.spacing);
            sums.outside.add(outside, 1.0);
            sums.liquid_area.add(liquid_area(arena, material, state), shown.liquid_area);
            rest.rope.add(&state.position, &mut sums.rope_stretch, &mut sums.rope_distortion);
            rest.jelly.add(&state.position, &mut sums.jelly_stretch, &mut sums.jelly_distortion);
        }
    }
}

fn liquid_area(arena: &Arena, material: &[Material], state: &State) -> f64 {
    let all = state.position.iter().zip(material);
    let liquid = all.filter(|(_, material)| **material == Material::Liquid);
    area::occupied(liquid.map(|(position, _)| position), arena.domain, arena.spacing)
}
