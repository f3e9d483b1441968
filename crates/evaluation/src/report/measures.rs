//! Physical measures with units.

use serde::{Deserialize, Serialize};

use crate::{FlightSums, Physics, numbers};

/// Physical measures at one frame ahead, means over windows.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Measures {
    /// The frame ahead.
    pub frame: usize,
    /// Share of the mass that is misplaced relative to the truth (0 to 1), on a lattice with cells of four spacings.
    #[serde(deserialize_with = "numbers::one")]
    pub misplaced: f64,
    /// Sum of |K - K'| / sum of K', where K' is the true kinetic energy.
    #[serde(deserialize_with = "numbers::one")]
    pub kinetic_energy_error: f64,
    /// Root mean square distance of the centres of mass (domain lengths).
    #[serde(deserialize_with = "numbers::one")]
    pub centre_rmse: f64,
    /// Share of the particles beyond an effective wall by more than half a spacing (0 to 1).
    #[serde(deserialize_with = "numbers::one")]
    pub outside: f64,
    /// Sum of the areas that liquid occupies / sum of the true areas.
    #[serde(deserialize_with = "numbers::one")]
    pub liquid_area: f64,
    /// Root mean square over windows of the deviation of that ratio from 1.
    #[serde(deserialize_with = "numbers::one")]
    pub liquid_area_off: f64,
    /// Mean ratio of the distance of neighbouring rope particles to their distance in the first frame.
    #[serde(deserialize_with = "numbers::one")]
    pub rope_stretch: f64,
    /// Root mean square deviation of that ratio from 1.
    #[serde(deserialize_with = "numbers::one")]
    pub rope_distortion: f64,
    /// As `rope_stretch`, for jelly.
    #[serde(deserialize_with = "numbers::one")]
    pub jelly_stretch: f64,
    /// As `rope_distortion`, for jelly.
    #[serde(deserialize_with = "numbers::one")]
    pub jelly_distortion: f64,
    /// Number of settled windows: the truth moves less than a spacing (root mean square) from the start to each of the
    /// frames shown.
    pub settled_windows: usize,
    /// Root mean square displacement of the particles since the start, in settled windows (domain lengths).
    #[serde(deserialize_with = "numbers::one")]
    pub settled_way: f64,
}

/// Errors of one-step predictions of bodies in free flight in the truth, over all frames: bodies of at least a hundred
/// particles with no other particle within 16 spacings and no wall within 8.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Flight {
    /// Mean momentum per mass gained per frame in excess of gravity (g dt).
    #[serde(deserialize_with = "numbers::one")]
    pub gain: f64,
    /// Maximum of that gain (g dt).
    #[serde(deserialize_with = "numbers::one")]
    pub worst_gain: f64,
    /// Root mean square change of spin per frame (rad/s).
    #[serde(deserialize_with = "numbers::one")]
    pub spin: f64,
    /// Number of bodies, counted in every frame.
    pub bodies: usize,
}

impl Flight {
    /// The measures from sums; `None` without bodies in flight.
    pub(super) fn new(sums: &FlightSums) -> Option<Self> {
        let FlightSums { gain, worst_gain, spin } = *sums;
        let bodies = gain.weight as usize;
        (bodies > 0).then(|| Self {
            gain: gain.value(),
            worst_gain,
            spin: spin.value().sqrt(),
            bodies,
        })
    }
}

impl Measures {
    /// The measures from sums.
    pub(super) fn new(frame: usize, sums: &Physics) -> Self {
        Self {
            frame,
            misplaced: sums.misplaced.value(),
            kinetic_energy_error: sums.kinetic_energy.value(),
            centre_rmse: sums.centre.value().sqrt(),
            outside: sums.outside.value(),
            liquid_area: sums.liquid_area.value(),
            liquid_area_off: sums.liquid_area_off.value().sqrt(),
            rope_stretch: sums.rope_stretch.value(),
            rope_distortion: sums.rope_distortion.value().sqrt(),
            jelly_stretch: sums.jelly_stretch.value(),
            jelly_distortion: sums.jelly_distortion.value().sqrt(),
            settled_windows: sums.settled.weight as usize,
            settled_way: sums.settled.value().sqrt(),
        }
    }
}
