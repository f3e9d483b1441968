//! Physical measures of predicted states beside true ones.
//!
//! 1. `density`: where the mass is.
//! 2. `bulk`: kinetic energy, centre of mass, share outside the walls, at every frame ahead.
//! 3. `flight`: momentum and spin of bodies in free flight.
//! 4. `area`: the area that liquids occupy.
//! 5. `stretch`: stretch and distortion of rope and jelly.
//! 6. `blow_up`: rollouts that diverge, gain energy or end far from the truth.
//! 7. `settled`: what becomes of slow and settled states in a long rollout.

mod area;
mod blow_up;
pub(super) mod bulk;
mod density;
mod flight;
mod settled;
mod stretch;

use super::{Context, Rollout, errors::square};
use eddy_dataset::Stream;
use eddy_frames::{Material, State, mean_squared_distance};

pub use blow_up::BlowUps;
pub(super) use blow_up::energy_limit;
pub use bulk::Bulk;
pub use flight::FlightSums;
pub(super) use flight::Flights;
pub use settled::{SETTLED_AVERAGED, SETTLED_FRAMES, SETTLED_START, Settled, SettledState};

/// The frames ahead at which measures are computed and tables show values.
pub const SHOWN_FRAMES: [usize; 6] = [1, 5, 10, 20, 50, 100];

/// Accumulator of a weighted mean or a ratio of sums.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Mean {
    /// Sum of values.
    pub sum: f64,
    /// Divisor.
    pub weight: f64,
}

impl Mean {
    /// Adds a value and its weight.
    pub fn add(&mut self, value: f64, weight: f64) {
        self.sum += value;
        self.weight += weight;
    }

    /// The mean; NaN if empty.
    pub fn value(&self) -> f64 {
        self.sum / self.weight
    }

    fn merge(&mut self, other: &Self) {
        self.add(other.sum, other.weight);
    }
}

/// Measures at one frame ahead, accumulated over windows.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Physics {
    /// Share of the mass that is misplaced relative to the truth, on a lattice with cells of four spacings.
    pub misplaced: Mean,
    /// |K - K'| / K', where K' is the kinetic energy of the truth.
    pub kinetic_energy: Mean,
    /// Squared distance of the centres of mass (domain lengths^2).
    pub centre: Mean,
    /// Share of the particles beyond an effective wall by more than half a spacing.
    pub outside: Mean,
    /// Ratio of the area that liquid occupies to the true area.
    pub liquid_area: Mean,
    /// Squared deviation of that ratio from 1, window by window.
    pub liquid_area_off: Mean,
    /// Ratio of the distance of neighbouring rope particles to their rest distance (first frame).
    pub rope_stretch: Mean,
    /// Squared deviation of that ratio from 1.
    pub rope_distortion: Mean,
    /// As `rope_stretch`, for jelly.
    pub jelly_stretch: Mean,
    /// As `rope_distortion`, for jelly.
    pub jelly_distortion: Mean,
    /// Mean squared displacement of the particles since the start (domain lengths^2), in settled windows.
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

/// Geometry of a scene at rest, which its measures refer to.
pub(super) struct RestGeometry {
    lattice: density::Lattice,
    rope: stretch::NeighbourPairs,
    jelly: stretch::NeighbourPairs,
}

impl RestGeometry {
    /// Takes the first frame of a stream as its rest shape.
    pub(super) fn new(context: &Context, stream: &Stream) -> Self {
        let position = &stream.states[0].position;
        let pairs = |solid| {
            stretch::NeighbourPairs::new(position, &stream.material, solid, context.spacing)
        };
        Self {
            lattice: density::Lattice::new(context.domain, context.spacing),
            rope: pairs(Material::Rope),
            jelly: pairs(Material::Jelly),
        }
    }
}

/// The truth in one window, to compare rollouts with.
pub(super) struct TruthWindow<'a> {
    /// The states after the start, up to the horizon or the end of the stream.
    pub(super) truth: &'a [State],
    observed: &'a State,
    limits: blow_up::Limits,
    /// Whether the truth moves less than a spacing (root mean square) from the start to each of
    /// [`SHOWN_FRAMES`].
    settled: bool,
    shown: Vec<ShownTruth>,
    /// Centre of mass of each of the true states (domain lengths).
    centres: Vec<[f64; 2]>,
}

/// The truth at one of [`SHOWN_FRAMES`].
struct ShownTruth {
    ahead: usize,
    map: Vec<f32>,
    kinetic_energy: f64,
    centre: [f64; 2],
    liquid_area: f64,
}

impl<'a> TruthWindow<'a> {
    /// The window after frame `start` of a stream, at least one frame long. Without `rest`, no measures are computed;
    /// `energy_limit` is the limit of the stream.
    pub(super) fn new(
        context: &Context,
        stream: &'a Stream,
        start: usize,
        rest: Option<&RestGeometry>,
        energy_limit: f64,
    ) -> Self {
        let observed = &stream.states[start];
        let end = stream.states.len().min(start + 1 + context.settings.horizon);
        let truth = &stream.states[start + 1..end];
        let limits = blow_up::Limits::new(context, stream, start, truth, energy_limit);
        let Some(rest) = rest else {
            let (shown, centres) = (Vec::new(), Vec::new());
            return Self { truth, observed, limits, settled: false, shown, centres };
        };
        let shown = SHOWN_FRAMES.into_iter().filter(|&ahead| ahead <= truth.len());
        let spacing = f64::from(context.spacing);
        let settled = shown.clone().all(|ahead| {
            let moved = mean_squared_distance(&truth[ahead - 1].position, &observed.position);
            moved < spacing * spacing
        });
        let shown = shown.map(|ahead| {
            let state = &truth[ahead - 1];
            ShownTruth {
                ahead,
                map: rest.lattice.map(&state.position),
                kinetic_energy: bulk::kinetic_energy(&state.velocity),
                centre: bulk::mean(state.position.iter()),
                liquid_area: liquid_area(context, &stream.material, state),
            }
        });
        let centres = truth.iter().map(|state| bulk::mean(state.position.iter())).collect();
        Self { truth, observed, limits, settled, shown: shown.collect(), centres }
    }

    /// Counts a rollout if it blew up.
    pub(super) fn count_blow_ups(&self, rollout: &Rollout, sums: &mut BlowUps) {
        self.limits.count(rollout, self.truth, sums);
    }

    /// Adds bulk quantities of predicted states to the sums of each frame ahead.
    pub(super) fn measure_bulk(&self, context: &Context, predicted: &[State], sums: &mut [Bulk]) {
        let walls = [context.ballistic.lower, context.ballistic.upper];
        for ((state, centre), sums) in predicted.iter().zip(&self.centres).zip(sums) {
            sums.add(state, *centre, walls, 0.5 * context.spacing);
        }
    }

    /// Adds the measures of predicted states to those at each of [`SHOWN_FRAMES`].
    pub(super) fn measure(
        &self,
        context: &Context,
        material: &[Material],
        rest: &RestGeometry,
        predicted: &[State],
        sums: &mut [Physics],
    ) {
        let walls = [context.ballistic.lower, context.ballistic.upper];
        for (shown, sums) in self.shown.iter().zip(sums) {
            let state = &predicted[shown.ahead - 1];
            let map = rest.lattice.map(&state.position);
            sums.misplaced.add(density::misplaced(&map, &shown.map), 1.0);
            let energy = bulk::kinetic_energy(&state.velocity);
            let error = (energy - shown.kinetic_energy).abs();
            sums.kinetic_energy.add(error, shown.kinetic_energy);
            let centre = bulk::mean(state.position.iter());
            let error = [centre[0] - shown.centre[0], centre[1] - shown.centre[1]];
            sums.centre.add(square(error), 1.0);
            let outside = bulk::share_outside(&state.position, walls, 0.5 * context.spacing);
            sums.outside.add(outside, 1.0);
            let area = liquid_area(context, material, state);
            sums.liquid_area.add(area, shown.liquid_area);
            if shown.liquid_area > 0.0 {
                let deviation = area / shown.liquid_area - 1.0;
                sums.liquid_area_off.add(deviation * deviation, 1.0);
            }
            if self.settled {
                let moved = mean_squared_distance(&state.position, &self.observed.position);
                sums.settled.add(moved, 1.0);
            }
            rest.rope.add(&state.position, &mut sums.rope_stretch, &mut sums.rope_distortion);
            rest.jelly.add(&state.position, &mut sums.jelly_stretch, &mut sums.jelly_distortion);
        }
    }
}

fn liquid_area(context: &Context, material: &[Material], state: &State) -> f64 {
    let all = state.position.iter().zip(material);
    let liquid = all.filter(|(_, material)| **material == Material::Liquid);
    area::occupied(liquid.map(|(position, _)| position), context.domain, context.spacing)
}
