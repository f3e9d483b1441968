//! Errors scene by scene, as in the paper's Tables 2 and 3.

use serde::{Deserialize, Serialize};

use crate::{Errors, Kind, SceneResult, Settled, numbers};
use eddy_frames::Material;

/// Maximum number of frames ahead with errors by scene: the length of the paper's rollouts.
pub const SCENE_FRAMES: usize = 20;

/// Errors in one scene.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SceneEntry {
    /// Stream id.
    pub id: u64,
    /// Name of its bag.
    pub name: String,
    /// Kind of scene.
    pub kind: Kind,
    /// The materials that occur.
    pub materials: Vec<Material>,
    /// The frames of the stream that rollouts start from, from 0.
    pub starts: Vec<usize>,
    /// Errors of every predictor.
    pub errors: Vec<SceneErrors>,
    /// What becomes of the scene in a long rollout of every predictor, `null` for those without one; absent if the stream is too short.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub settled: Vec<Option<Settled>>,
}

/// Errors of free rollouts in one scene: means over windows and particles, one number per frame ahead, up to frame 20.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct SceneErrors {
    /// Particles summed over, of all windows.
    #[serde(deserialize_with = "numbers::list")]
    pub count: Vec<f64>,
    /// Root mean square of |x - x'| (domain lengths).
    #[serde(deserialize_with = "numbers::list")]
    pub position_rmse: Vec<f64>,
    /// Mean squared error of the features x, y, vx, vy, each divided by its range in the first checkpoint's training
    /// data.
    #[serde(deserialize_with = "numbers::list")]
    pub minmax_mse: Vec<f64>,
    /// As `minmax_mse`, divided by the standard deviation.
    #[serde(deserialize_with = "numbers::list")]
    pub zscore_mse: Vec<f64>,
}

impl SceneEntry {
    pub(super) fn new(scene: &SceneResult) -> Self {
        let errors = scene
            .accumulators
            .iter()
            .map(|accumulator| SceneErrors::new(&accumulator.errors.total()));
        Self {
            id: scene.id,
            name: scene.name.clone(),
            kind: scene.kind,
            materials: scene.materials.clone(),
            starts: scene.starts.clone(),
            errors: errors.collect(),
            settled: scene.settled.clone(),
        }
    }

    /// Its name in tables: bag and materials, as in the paper.
    pub fn title(&self) -> String {
        format!("{} {}", self.name, joined(&self.materials))
    }
}

/// Materials as the paper writes them: `liquid+snow`.
pub(super) fn joined(materials: &[Material]) -> String {
    let names: Vec<&str> = materials.iter().map(|material| material.name()).collect();
    names.join("+")
}

impl SceneErrors {
    fn new(errors: &[Errors]) -> Self {
        let errors = &errors[..errors.len().min(SCENE_FRAMES)];
        let curve = |f: fn(&Errors) -> f64| errors.iter().map(f).collect();
        Self {
            count: curve(|errors| errors.count),
            position_rmse: curve(Errors::position_rmse),
            minmax_mse: curve(Errors::minmax_mse),
            zscore_mse: curve(Errors::zscore_mse),
        }
    }
}

/// The mean over frames with truth.
pub(super) fn mean(numbers: &[f64]) -> f64 {
    let there: Vec<f64> = numbers.iter().copied().filter(|number| !number.is_nan()).collect();
    there.iter().sum::<f64>() / there.len() as f64
}

/// The number at the last frame ahead.
pub(super) fn last(numbers: &[f64]) -> f64 {
    numbers.last().copied().unwrap_or(f64::NAN)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_without_truth_do_not_count() {
        assert_eq!(mean(&[1.0, f64::NAN, 3.0]), 2.0);
        assert!(mean(&[]).is_nan() && last(&[]).is_nan());
        assert_eq!(joined(&[Material::Liquid, Material::Snow]), "liquid+snow");
    }

    #[test]
    fn a_scene_has_errors_of_at_most_twenty_frames() {
        let errors = vec![Errors { count: 2.0, position: 8.0, ..Errors::default() }; 30];
        let scene = SceneErrors::new(&errors);
        assert_eq!(scene.position_rmse, [2.0; 20]);
        assert_eq!(SceneErrors::new(&errors[..3]).count, [2.0; 3]);
    }
}
