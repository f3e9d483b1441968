//! Physical measures as numbers with units.

use serde::{Deserialize, Serialize};

use crate::{FlightSums, Physics, numbers};

/// Physical measures at one frame ahead, means over windows.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Measures {
    /// The frame ahead.
    pub frame: usize,
    /// Share of the mass that is in another place than in the truth (0 to 1), on a lattice of four
    /// spacings.
    #[serde(deserialize_with = "numbers::one")]
    pub misplaced: f64,
    /// Sum of |K - K'| over the sum of K', K' being the true kinetic energy.
    #[serde(deserialize_with = "numbers::one")]
    pub kinetic_energy_error: f64,
    /// Root mean square distance of the centres of mass (domain lengths).
    #[serde(deserialize_with = "numbers::one")]
    pub centre_rmse: f64,
    /// Share of the particles beyond a wall in effect by more than half a spacing (0 to 1).
    #[serde(deserialize_with = "numbers::one")]
    pub outside: f64,
    /// Sum of the areas that liquid occupies over the sum of those in the truth.
    #[serde(deserialize_with = "numbers::one")]
    pub liquid_area: f64,
    /// Root mean square over windows of what that ratio is away from 1 in each.
    #[serde(deserialize_with = "numbers::one")]
    pub liquid_area_off: f64,
    /// Mean distance of rest neighbours within rope over that in the first frame of the stream.
    #[serde(deserialize_with = "numbers::one")]
    pub rope_stretch: f64,
    /// Root mean square deviation of that ratio from 1.
    #[serde(deserialize_with = "numbers::one")]
    pub rope_distortion: f64,
    /// As `rope_stretch`, of jelly.
    #[serde(deserialize_with = "numbers::one")]
    pub jelly_stretch: f64,
    /// As `rope_distortion`, of jelly.
    #[serde(deserialize_with = "numbers::one")]
    pub jelly_distortion: f64,
    /// Settled windows that are measured here: those in which the truth moves less than a spacing (root mean
    /// square) from the start to any of the frames shown.
    pub settled_windows: usize,
    /// Root mean square way of the particles since the start in settled windows (domain lengths).
    #[serde(deserialize_with = "numbers::one")]
    pub settled_way: f64,
}

/// What predictions of the next frame do to bodies that are in free flight in the truth, over all
/// frames: bodies of a hundred particles or more with nothing within 16 spacings and no wall within 8.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct Flight {
    /// Momentum per mass gained in a frame beside that of gravity, the mean (g dt).
    #[serde(deserialize_with = "numbers::one")]
    pub gain: f64,
    /// The largest of all.
    #[serde(deserialize_with = "numbers::one")]
    pub worst_gain: f64,
    /// Root mean square change of spin in a frame (rad/s).
    #[serde(deserialize_with = "numbers::one")]
    pub spin: f64,
    /// Bodies, one a frame.
    pub bodies: usize,
}

impl Flight {
    /// The measures of sums; `None` where nothing flew.
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
    /// The measures of sums.
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
