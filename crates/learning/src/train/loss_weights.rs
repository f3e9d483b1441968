//! The weight of each particle's squared error.
//!
//! Mean squared error: 1 / range^2 of each feature, averaged over particles, frames and features.
//!
//! Relative error: divided by the error of the best trivial predictor for the same material and number of frames ahead, so
//! that 1 means "no better than trivial" for every frame. The divisor is between the error of the window and the mean over all
//! windows: with the former alone, windows at rest, where nothing remains to be learned, would count as much as a splash;
//! with the latter alone, they would hardly count. Errors below the resolution are not distinguished, nor, in a window with
//! noise, errors below that. For a network that is conditioned on the stiffness, the mean is over windows of about the same
//! stiffness, since trivial errors depend on it.

use std::borrow::Cow;

use super::{LossConfig, LossKind, NoiseConfig, window::Window};
use eddy_frames::{Material, State};
use eddy_inference::engine::Baseline;
use eddy_inference::{checkpoint::Normalization, engine::Ballistic};

/// The powers of ten at which trivial errors are averaged by stiffness (Young's modulus in density x velocity^2); between
/// them they are interpolated.
const DECADES: [f64; 5] = [2.0, 3.0, 4.0, 5.0, 6.0];
/// What a window of any stiffness counts for at each of [`DECADES`], beside its own share there.
const OF_ALL: f64 = 0.05;

/// Squared errors of a material: position, velocity.
type Pair = [f64; 2];

/// Mean squared errors of the best trivial predictor, by frame ahead and material.
pub(super) type TrivialErrors = Vec<[Pair; Material::COUNT]>;

/// What the weights of a window depend on beside its motion.
pub(super) struct WindowKind<'a> {
    /// Materials, `[N]`.
    pub(super) material: &'a [Material],
    /// Its stream's stiffness, if it is known (density x velocity^2).
    pub(super) stiffness: Option<f32>,
    /// Whether the network observes the last state with noise.
    pub(super) noisy: bool,
}

/// Computes the weights.
pub(super) struct LossScale<'a> {
    pub(super) loss: &'a LossConfig,
    pub(super) noise: &'a NoiseConfig,
    pub(super) normalization: &'a Normalization,
    /// For the trivial predictors.
    pub(super) ballistic: Ballistic,
    /// Trivial errors over many windows; for a network that is conditioned on the stiffness, at each of [`DECADES`], one
    /// after the other.
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
                let kind = WindowKind {
                    material: &window.material,
                    stiffness: window.stiffness,
                    noisy: window.noisy.is_some(),
                };
                let frames = self.relative(&kind, own.as_ref(), unroll);
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

    /// Weights of squared errors of positions and velocities in the relative loss, by frame ahead and material; `own` are the
    /// trivial errors in the window, needed only if the divisor depends on them.
    pub(super) fn relative(
        &self,
        &WindowKind { material, stiffness, noisy }: &WindowKind,
        own: Option<&TrivialErrors>,
        unroll: usize,
    ) -> Vec<[[f32; Material::COUNT]; 2]> {
        let sums = self.shares();
        let common = self.common_at(stiffness, unroll);
        let own = own.map_or(&*common, Vec::as_slice);
        let counts = counts(material);
        let present = counts.iter().filter(|&&count| count > 0.0).count() as f64;
        let share = f64::from(self.loss.common_share);
        let frame = |(own, common): (&[Pair; Material::COUNT], &[Pair; Material::COUNT])| {
            [0, 1].map(|part| {
                let floor = self.floor(part, noisy);
                std::array::from_fn(|m| {
                    let error = (own[m][part] + floor).powf(1.0 - share)
                        * (common[m][part] + floor).powf(share);
                    let even = counts[m] * present * unroll as f64 * (sums[0] + sums[1]);
                    (sums[part] / (error * even)) as f32
                })
            })
        };
        own.iter().zip(&*common).map(frame).collect()
    }

    /// Trivial errors over many windows of about this stiffness, by frame ahead.
    fn common_at(
        &self,
        stiffness: Option<f32>,
        unroll: usize,
    ) -> Cow<'_, [[Pair; Material::COUNT]]> {
        if self.common.len() <= unroll {
            return Cow::Borrowed(&self.common);
        }
        let stiffness = stiffness.expect("checked before a training begins");
        let shares = shares_of_decades(stiffness);
        let mut mean = vec![[[0.0; 2]; Material::COUNT]; unroll];
        for (share, errors) in shares.into_iter().zip(self.common.chunks(unroll)) {
            for (mean, errors) in mean.as_flattened_mut().iter_mut().zip(errors.as_flattened()) {
                for (mean, error) in mean.iter_mut().zip(errors) {
                    *mean += share * error;
                }
            }
        }
        Cow::Owned(mean)
    }

    /// Weights of positions and velocities.
    fn shares(&self) -> [f64; 2] {
        [self.loss.position_weight, self.loss.velocity_weight].map(f64::from)
    }

    /// The smallest relevant squared error, of positions or velocities: no network can tell motion from noise.
    fn floor(&self, part: usize, noisy: bool) -> f64 {
        let resolution = self.loss.resolution;
        let NoiseConfig { position, velocity, .. } = *self.noise;
        let (resolution, noise) =
            [(resolution, position), (resolution / self.ballistic.dt, velocity)][part];
        f64::from(if noisy { resolution.max(noise) } else { resolution }).powi(2)
    }

    /// Errors of the best trivial predictor over the last `unroll` frames of a window.
    pub(super) fn trivial(&self, window: &Window, unroll: usize) -> TrivialErrors {
        let mut sums = TrivialSums::new(unroll);
        sums.add(window, &self.ballistic);
        sums.best()
    }
}

/// Number of lists of errors in [`LossScale::common`].
pub(super) fn parts_of_common(by_stiffness: bool) -> usize {
    if by_stiffness { DECADES.len() } else { 1 }
}

/// How much each of [`DECADES`] counts for a stiffness between two of them.
fn shares_of_decades(stiffness: f32) -> [f64; DECADES.len()] {
    let [lowest, .., highest] = DECADES;
    let power = f64::from(stiffness).log10().clamp(lowest, highest);
    DECADES.map(|decade| (1.0 - (power - decade).abs()).max(0.0))
}

/// Sums of the trivial predictors' squared errors over windows, from which [`LossScale::common`] is made.
pub(super) struct CommonSums {
    all: TrivialSums,
    /// For a network that is conditioned on the stiffness.
    decades: Option<[TrivialSums; DECADES.len()]>,
}

impl CommonSums {
    /// Empty sums for the last `unroll` frames of each window.
    pub(super) fn new(unroll: usize, by_stiffness: bool) -> Self {
        let empty = || TrivialSums::new(unroll);
        Self { all: empty(), decades: by_stiffness.then(|| DECADES.map(|_| empty())) }
    }

    /// Adds the errors of a window.
    pub(super) fn add(&mut self, window: &Window, ballistic: &Ballistic) {
        let (Some(decades), Some(stiffness)) = (&mut self.decades, window.stiffness) else {
            return self.all.add(window, ballistic);
        };
        let mut sums = TrivialSums::new(self.all.unroll());
        sums.add(window, ballistic);
        self.all.merge(&sums, 1.0);
        for (decade, share) in decades.iter_mut().zip(shares_of_decades(stiffness)) {
            decade.merge(&sums, share);
        }
    }

    /// Mean errors of the best predictor for each material and frame, and each of [`DECADES`].
    pub(super) fn best(self) -> TrivialErrors {
        let Self { all, decades } = self;
        match decades {
            None => all.best(),
            Some(decades) => {
                let of = |mut sums: TrivialSums| {
                    // Few windows of a kind would give an error by chance, none at all no error.
                    sums.merge(&all, OF_ALL);
                    sums.best()
                };
                decades.into_iter().flat_map(of).collect()
            }
        }
    }
}

/// Sums of the trivial predictors' squared errors over the last frames of windows.
pub(super) struct TrivialSums {
    baselines: [TrivialErrors; Baseline::WITH_TOOLS.len()],
    /// Number of particles of each material.
    particles: [f64; Material::COUNT],
}

impl TrivialSums {
    /// Empty sums for the last `unroll` frames of each window.
    pub(super) fn new(unroll: usize) -> Self {
        let zero = vec![[[0.0; 2]; Material::COUNT]; unroll];
        let baselines = Baseline::WITH_TOOLS.map(|_| zero.clone());
        Self { baselines, particles: [0.0; Material::COUNT] }
    }

    /// Adds the errors of a window.
    pub(super) fn add(&mut self, window: &Window, ballistic: &Ballistic) {
        let unroll = self.unroll();
        for (baseline, sums) in Baseline::WITH_TOOLS.into_iter().zip(&mut self.baselines) {
            let (observed, truth) = window.states.split_at(window.states.len() - unroll);
            let (last, sweeps) = (&observed[observed.len() - 1], &window.sweeps);
            let predicted = baseline.roll_out(last, ballistic, &sweeps[observed.len() - 1..]);
            for ((sums, predicted), truth) in sums.iter_mut().zip(&predicted).zip(truth) {
                add(sums, &window.material, predicted, truth);
            }
        }
        for (total, count) in self.particles.iter_mut().zip(counts(&window.material)) {
            *total += count;
        }
    }

    /// Freely predicted frames of each window.
    fn unroll(&self) -> usize {
        self.baselines[0].len()
    }

    /// Adds other sums, multiplied by a weight.
    fn merge(&mut self, other: &Self, weight: f64) {
        for (sums, others) in self.baselines.iter_mut().zip(&other.baselines) {
            let sums = sums.as_flattened_mut().as_flattened_mut();
            let others = others.as_flattened().as_flattened();
            for (sum, other) in sums.iter_mut().zip(others) {
                *sum += weight * other;
            }
        }
        for (count, other) in self.particles.iter_mut().zip(other.particles) {
            *count += weight * other;
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
                        *best = best.min(error / count.max(f64::MIN_POSITIVE));
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

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::{super::TrainConfig, *};
    use eddy_frames::Domain;
    use eddy_inference::checkpoint::{Architecture, Core, Description, Sizes};

    const UNROLL: usize = 2;

    /// A particle that is pushed after the first frame, `error` domain lengths per second faster each frame.
    fn window(stiffness: f32, material: Material, error: f32) -> Window {
        let state = |frame: f32| State {
            position: vec![[0.5 + 0.016 * frame, 0.5]],
            velocity: vec![[1.0 + error * frame, 0.0]],
        };
        Window {
            stream: 0,
            start: 0,
            material: vec![material],
            rest: vec![[0.5; 2]],
            stiffness: Some(stiffness),
            states: (0..=UNROLL).map(|frame| state(frame as f32)).collect(),
            sweeps: vec![None; UNROLL],
            noisy: None,
        }
    }

    fn description() -> Description {
        let sizes = Sizes { encoder: 4, hidden: 4, layers: 1, particles: None };
        Description {
            domain: Domain::UNIT,
            gravity: [0.0; 2],
            ..Description::untrained(Architecture::Particle, Core::MinGru, sizes)
        }
    }

    /// Squared velocity error of a material at frame 1 that is taken as trivial at a stiffness.
    fn divisor(windows: &[Window], by_stiffness: bool, stiffness: f32, material: Material) -> f64 {
        let (config, description) = (TrainConfig::defaults(Architecture::Particle), description());
        let ballistic = Ballistic::new(&description);
        let mut sums = CommonSums::new(UNROLL, by_stiffness);
        windows.iter().for_each(|window| sums.add(window, &ballistic));
        let normalization = &description.normalization;
        let (loss, noise) = (&config.loss, &config.windows.noise);
        let scale = LossScale { loss, noise, normalization, ballistic, common: sums.best() };
        assert_eq!(scale.common.len(), UNROLL * parts_of_common(by_stiffness));
        scale.common_at(Some(stiffness), UNROLL)[0][material as usize][1]
    }

    #[test]
    fn the_trivial_error_is_that_at_the_stiffness_of_a_window() {
        let soft: Vec<_> = (0..50).map(|_| window(1e3, Material::Snow, 0.1)).collect();
        let stiff = (0..50).map(|_| window(1e5, Material::Snow, 1.0));
        let both: Vec<_> = soft.iter().cloned().chain(stiff).collect();
        let pooled = divisor(&both, false, 1e3, Material::Snow);
        assert!((pooled - 0.505).abs() < 1e-3, "the mean of .01 and 1: {pooled}");
        // Half of the windows, and a twentieth of all.
        let mixed = |own: f64| (0.5 * own + OF_ALL * 0.505) / (0.5 + OF_ALL);
        for (stiffness, own) in [(1e3, 0.01), (1e5, 1.0)] {
            let found = divisor(&both, true, stiffness, Material::Snow);
            assert!((found - mixed(own)).abs() < 1e-3, "{stiffness}: {found}, {}", mixed(own));
        }
        // No window is near: the mean of all.
        let far = divisor(&both, true, 1e2, Material::Snow);
        assert!((far - 0.505).abs() < 1e-3, "{far}");
        // A material that is rare at a stiffness has the error of all of its windows.
        let rope = [both, vec![window(1e5, Material::Rope, 0.3)]].concat();
        let found = divisor(&rope, true, 1e3, Material::Rope);
        assert!((found - 0.09).abs() < 1e-3, "{found}");
    }

    /// Weight of the squared velocity error in the first frame of a window, among slow and fast ones.
    fn weight(error: f32, resolution: f32, noisy: bool) -> f32 {
        let (mut config, description) =
            (TrainConfig::defaults(Architecture::Particle), description());
        config.loss.common_share = 0.5;
        config.loss.resolution = resolution;
        let ballistic = Ballistic::new(&description);
        let mut common = CommonSums::new(UNROLL, false);
        for error in [1e-4, 1.0] {
            common.add(&window(1e3, Material::Snow, error), &ballistic);
        }
        let scale = LossScale {
            loss: &config.loss,
            noise: &config.windows.noise,
            normalization: &description.normalization,
            ballistic,
            common: common.best(),
        };
        let mut window = window(1e3, Material::Snow, error);
        window.noisy = noisy.then(|| window.states[0].clone());
        scale.weights(&window, UNROLL)[1][0]
    }

    #[test]
    fn a_slow_window_counts_for_more_down_to_the_resolution_and_the_noise() {
        // Its trivial error is 1e-4; the resolutions are 3.1e-3 and 3.1e-2.
        let fast = weight(1.0, 5e-5, false);
        let (fine, coarse) = (weight(1e-4, 5e-5, false), weight(1e-4, 5e-4, false));
        assert!(fine > 100.0 * fast, "{fine}, {fast}");
        let ratio = fine / coarse;
        assert!((8.0..11.0).contains(&ratio), "the ratio of the resolutions is 10: {ratio}");
        // Noise has .02: errors below that say nothing, and are not made more of.
        let noisy = weight(1e-4, 5e-5, true);
        let as_coarse = weight(1e-4, 0.02 * 0.016, false);
        assert!((noisy / as_coarse - 1.0).abs() < 1e-3, "{noisy}, {as_coarse}");
    }

    proptest! {
        #[test]
        fn neighbouring_powers_of_ten_share_a_stiffness(power in 0.0f64..8.0) {
            let shares = shares_of_decades(10f64.powf(power) as f32);
            prop_assert!((shares.iter().sum::<f64>() - 1.0).abs() < 1e-6);
            let mean: f64 = shares.iter().zip(DECADES).map(|(share, decade)| share * decade).sum();
            prop_assert!((mean - power.clamp(2.0, 6.0)).abs() < 1e-5);
        }
    }
}
