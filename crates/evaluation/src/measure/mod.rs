//! Physical measures of predicted states beside true ones.
//!
//! 1. `density`: where the mass is.
//! 2. `bulk`: kinetic energy, centre of mass, what is outside the walls, at every frame ahead.
//! 3. `flight`: momentum and spin of bodies that nothing touches.
//! 4. `area`: the area that liquids occupy.
//! 5. `stretch`: how far rope and jelly are stretched and distorted.
//! 6. `blow_up`: rollouts that are worse than no model, or livelier than any truth.

mod area;
mod blow_up;
pub(super) mod bulk;
mod density;
mod flight;
mod stretch;

use super::{
    Arena, Rollout,
    errors::{mean_squared_distance, square},
};
use crate::dataset::{State, Stream};
use eddy_frames::Material;

pub use blow_up::BlowUps;
pub(super) use blow_up::most_energy;
pub use bulk::Bulk;
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
    /// Squared deviation of that ratio from 1, window by window.
    pub liquid_area_off: Mean,
    /// Distance of rest neighbours within rope over that in the first frame.
    pub rope_stretch: Mean,
    /// Squared deviation of that from 1.
    pub rope_distortion: Mean,
    /// As `rope_stretch`, of jelly.
    pub jelly_stretch: Mean,
    /// As `rope_distortion`, of jelly.
    pub jelly_distortion: Mean,
    /// Mean squared way of the particles since the start (domain lengths^2), of settled windows.
    pub settled: Mean,
}

impl Physics {
    /// Adds the measures of other windows.
    pub fn merge(&mut self, other: &Self) {
        let Self {
            misplaced,
            kinetic_energy,
            centre,
            outside,
            liquid_area,
            liquid_area_off,
            rope_stretch,
            rope_distortion,
            jelly_stretch,
            jelly_distortion,
            settled,
        } = self;
        for (sum, other) in [
            (misplaced, &other.misplaced),
            (kinetic_energy, &other.kinetic_energy),
            (centre, &other.centre),
            (outside, &other.outside),
            (liquid_area, &other.liquid_area),
            (liquid_area_off, &other.liquid_area_off),
            (rope_stretch, &other.rope_stretch),
            (rope_distortion, &other.rope_distortion),
            (jelly_stretch, &other.jelly_stretch),
            (jelly_distortion, &other.jelly_distortion),
            (settled, &other.settled),
        ] {
            sum.merge(other);
        }
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
    observed: &'a State,
    tolerance: blow_up::Tolerance,
    /// Whether the truth moves less than a spacing (root mean square) from the start to any of the frames
    /// shown.
    settled: bool,
    shown: Vec<Shown>,
    /// Centre of mass of each of the true states (domain lengths).
    centres: Vec<[f64; 2]>,
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
    /// The window after frame `start` of a stream, which has another frame after it. Nothing is measured
    /// without `rest`; `most_energy` is that of the stream.
    pub(super) fn new(
        arena: &Arena,
        stream: &'a Stream,
        start: usize,
        rest: Option<&Rest>,
        most_energy: f64,
    ) -> Self {
        let observed = &stream.states[start];
        let end = stream.states.len().min(start + 1 + arena.settings.horizon);
        let truth = &stream.states[start + 1..end];
        let tolerance = blow_up::Tolerance::new(arena, observed, truth, most_energy);
        let Some(rest) = rest else {
            let (shown, centres) = (Vec::new(), Vec::new());
            return Self { truth, observed, tolerance, settled: false, shown, centres };
        };
        let shown = SHOWN.into_iter().filter(|&ahead| ahead <= truth.len());
        let spacing = f64::from(arena.spacing);
        let settled = shown.clone().all(|ahead| {
            let way = mean_squared_distance(&truth[ahead - 1].position, &observed.position);
            way < spacing * spacing
        });
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
        let centres = truth.iter().map(|state| bulk::mean(state.position.iter())).collect();
        Self { truth, observed, tolerance, settled, shown: shown.collect(), centres }
    }

    /// Counts a rollout if it blew up.
    pub(super) fn count_blow_ups(&self, rollout: &Rollout, sums: &mut BlowUps) {
        self.tolerance.count(rollout, self.truth, sums);
    }

    /// Adds what predicted particles have together to the sums of each frame ahead.
    pub(super) fn measure_bulk(&self, arena: &Arena, predicted: &[State], sums: &mut [Bulk]) {
        let walls = [arena.ballistic.lower, arena.ballistic.upper];
        for ((state, centre), sums) in predicted.iter().zip(&self.centres).zip(sums) {
            sums.add(state, *centre, walls, 0.5 * arena.spacing);
        }
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
            let area = liquid_area(arena, material, state);
            sums.liquid_area.add(area, shown.liquid_area);
            if shown.liquid_area > 0.0 {
                let off = area / shown.liquid_area - 1.0;
                sums.liquid_area_off.add(off * off, 1.0);
            }
            if self.settled {
                let way = mean_squared_distance(&state.position, &self.observed.position);
                sums.settled.add(way, 1.0);
            }
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
