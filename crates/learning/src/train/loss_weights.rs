//! The weight of each particle's squared error.
//!
//! Mean squared error: 1 / range^2 of each feature, averaged over particles, frames and features.
//!
//! Relative error: divided by the error of the best trivial predictor for the same material and number of frames ahead, so
//! that 1 means "no better than trivial" for every frame. The divisor is between the error of the window and the mean over all
//! windows: with the former alone, windows at rest, where nothing remains to be learned, would count as much as a splash;
//! with the latter alone, they would hardly count. Errors below [`RESOLUTION`] are not distinguished.

use super::{LossConfig, LossKind, window::Window};
use eddy_evaluation::{Baseline, dataset::State};
use eddy_frames::Material;
use eddy_inference::{checkpoint::Normalization, engine::Ballistic};

/// Position error below which accuracy is irrelevant (domain lengths): a thirtieth of a cell.
const RESOLUTION: f64 = 5e-4;

/// Squared errors of a material: position, velocity.
type Pair = [f64; 2];

/// Mean squared errors of the best trivial predictor, by frame ahead and material.
pub(super) type TrivialErrors = Vec<[Pair; Material::COUNT]>;

/// Computes the weights.
pub(super) struct LossScale<'a> {
    pub(super) loss: &'a LossConfig,
    pub(super) normalization: &'a Normalization,
    /// For the trivial predictors.
    pub(super) ballistic: Ballistic,
    /// Trivial errors over many windows.
    pub(super) common: TrivialErrors,
}

impl LossScale<'_> {
    /// Weights of squared position and velocity errors for the last `unroll` frames of a window, `[K, N, 2]` each. Errors equal
    /// to the divisors give the sum 1.
    pub(super) fn weights(&self, window: &Window, unroll: usize) -> [Vec<f32>; 2] {
        let particles = window.material.len();
        match self.loss.kind {
            LossKind::Mse => {
                let [x, y, vx, vy] = self.squared(unroll * particles);
                [[x, y], [vx, vy]].map(|pair| pair.repeat(unroll * particles))
            }
            LossKind::Relative => {
                let own = self.needs_windows().then(|| self.trivial(window, unroll));
                let frames = self.relative(&window.material, own.as_ref(), unroll);
                [0, 1].map(|part| {
                    let kinds = |frame: &[[f32; Material::COUNT]; 2]| {
                        let weight = frame[part];
                        window.material.iter().flat_map(move |&kind| [weight[kind as usize]; 2])
                    };
                    frames.iter().flat_map(kinds).collect()
                })
            }
        }
    }

    /// Weights of squared errors of x, y, vx, vy in the mean squared error of `count` scaled states.
    pub(super) fn squared(&self, count: usize) -> [f32; 4] {
        let sums = self.shares();
        let even = (count * 2) as f64 * (sums[0] + sums[1]);
        std::array::from_fn(|feature| {
            let low = self.normalization.minimum[feature];
            let range = f64::from(self.normalization.maximum[feature] - low);
            (sums[feature / 2] / (range * range * even)) as f32
        })
    }

    /// Whether the divisor depends on the window, not on many windows alone.
    pub(super) fn needs_windows(&self) -> bool {
        self.loss.common_share < 1.0
    }

    /// Weights of squared errors of positions and velocities in the relative loss, by frame ahead and material, of a window of
    /// particles of these materials; `own` are the trivial errors in it, needed only if the divisor depends on them.
    pub(super) fn relative(
        &self,
        material: &[Material],
        own: Option<&TrivialErrors>,
        unroll: usize,
    ) -> Vec<[[f32; Material::COUNT]; 2]> {
        let sums = self.shares();
        let own = own.unwrap_or(&self.common);
        let counts = counts(material);
        let present = counts.iter().filter(|&&count| count > 0.0).count() as f64;
        let share = f64::from(self.loss.common_share);
        let frame = |(own, common): (&[Pair; Material::COUNT], &[Pair; Material::COUNT])| {
            [0, 1].map(|part| {
                let floor = self.floor(part);
                std::array::from_fn(|m| {
                    let error = (own[m][part] + floor).powf(1.0 - share)
                        * (common[m][part] + floor).powf(share);
                    let even = counts[m] * present * unroll as f64 * (sums[0] + sums[1]);
                    (sums[part] / (error * even)) as f32
                })
            })
        };
        own.iter().zip(&self.common).map(frame).collect()
    }

    /// Weights of positions and velocities.
    fn shares(&self) -> [f64; 2] {
        [self.loss.position_weight, self.loss.velocity_weight].map(f64::from)
    }

    /// The smallest relevant squared error, of positions or velocities.
    fn floor(&self, part: usize) -> f64 {
        let unit = if part == 0 { 1.0 } else { f64::from(self.ballistic.dt) };
        (RESOLUTION / unit).powi(2)
    }

    /// Errors of the best trivial predictor over the last `unroll` frames of a window.
    pub(super) fn trivial(&self, window: &Window, unroll: usize) -> TrivialErrors {
        let mut sums = TrivialSums::new(unroll);
        sums.add(window, &self.ballistic);
        sums.best()
    }
}

/// Sums of the trivial predictors' squared errors over the last frames of windows.
pub(super) struct TrivialSums {
    baselines: [TrivialErrors; Baseline::ALL.len()],
    /// Number of particles of each material.
    particles: [f64; Material::COUNT],
}

impl TrivialSums {
    /// Empty sums for the last `unroll` frames of each window.
    pub(super) fn new(unroll: usize) -> Self {
        let zero = vec![[[0.0; 2]; Material::COUNT]; unroll];
        Self { baselines: Baseline::ALL.map(|_| zero.clone()), particles: [0.0; Material::COUNT] }
    }

    /// Adds the errors of a window.
    pub(super) fn add(&mut self, window: &Window, ballistic: &Ballistic) {
        for (baseline, sums) in Baseline::ALL.into_iter().zip(&mut self.baselines) {
            let unroll = sums.len();
            let (observed, truth) = window.states.split_at(window.states.len() - unroll);
            let predicted = baseline.roll_out(&observed[observed.len() - 1], unroll, ballistic);
            for ((sums, predicted), truth) in sums.iter_mut().zip(&predicted).zip(truth) {
                add(sums, &window.material, predicted, truth);
            }
        }
        for (total, count) in self.particles.iter_mut().zip(counts(&window.material)) {
            *total += count;
        }
    }

    /// Mean errors of the best predictor for each material and frame.
    pub(super) fn best(self) -> TrivialErrors {
        let Self { baselines, particles } = self;
        let mut best = vec![[[f64::INFINITY; 2]; Material::COUNT]; baselines[0].len()];
        for errors in &baselines {
            for (best, errors) in best.iter_mut().zip(errors) {
                for ((best, errors), count) in best.iter_mut().zip(errors).zip(particles) {
                    for (best, error) in best.iter_mut().zip(errors) {
                        *best = best.min(error / count.max(1.0));
                    }
                }
            }
        }
        best
    }
}

fn add(sums: &mut [Pair; Material::COUNT], material: &[Material], found: &State, truth: &State) {
    let squared = |a: [f32; 2], b: [f32; 2]| {
        let (x, y) = (f64::from(a[0] - b[0]), f64::from(a[1] - b[1]));
        x * x + y * y
    };
    for (particle, &kind) in material.iter().enumerate() {
        sums[kind as usize][0] += squared(found.position[particle], truth.position[particle]);
        sums[kind as usize][1] += squared(found.velocity[particle], truth.velocity[particle]);
    }
}

fn counts(material: &[Material]) -> [f64; Material::COUNT] {
    let mut counts = [0.0; Material::COUNT];
    for &kind in material {
        counts[kind as usize] += 1.0;
    }
    counts
}
