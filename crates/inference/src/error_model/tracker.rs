//! The features of a stream from which the error of a prediction is estimated.

use super::{ErrorEstimate, ErrorModel};
use crate::{checkpoint::Description, engine::Ballistic};
use eddy_frames::{Domain, Frame, FrameView, Material, mean_squared_distance, squared_distance};

/// Number of features.
pub const FEATURES: usize = 7;

/// Number of comparisons that are averaged with equal weights; from then on the average is exponential with this time constant.
const AVERAGED_FRAMES: u32 = 8;

/// Added to squared lengths before their logarithm is taken (domain lengths squared): a thousandth of a particle's distance to
/// its neighbours is far below any error that matters.
const SMALL: f64 = 1e-10;

/// The natural logarithm of a mean square (domain lengths squared), finite also for 0.
pub fn log_square(square: f64) -> f32 {
    (square + SMALL).ln() as f32
}

/// Features of a prediction, in this order:
///
/// - natural logarithms of mean squares over the particles (domain lengths squared): the position errors of recent one-step
///   predictions; recent departures of the truth from a ballistic step; the distance of the prediction from a ballistic
///   extrapolation of the last observed frame, and from that frame;
/// - the shares of liquid, snow and jelly among the particles; sand counts as rope.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Features(pub [f32; FEATURES]);

/// Mean squared distances (domain lengths squared).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct Squares {
    /// Of one-step predictions.
    error: f64,
    /// Of the truth from a ballistic step.
    departure: f64,
}

/// What a stream has shown so far.
#[derive(Clone, Debug)]
pub struct ErrorTracker {
    ballistic: Ballistic,
    shares: [f32; 3],
    /// The last observed frame, `[N, 2]` each.
    observed: Motion,
    /// Its ballistic extrapolation.
    extrapolated: Motion,
    /// Frames that it is ahead.
    ahead: u32,
    /// Averages over the last predictions that could be compared with the truth.
    pub(super) recent: Squares,
    /// Number of them, up to [`AVERAGED_FRAMES`].
    pub(super) compared: u32,
}

/// Positions and velocities, `[N, 2]` each.
#[derive(Clone, Debug, Default)]
struct Motion {
    position: Vec<[f32; 2]>,
    velocity: Vec<[f32; 2]>,
}

impl ErrorTracker {
    /// For a stream of the described model's predictions with these particles.
    pub fn new(description: &Description, domain: &Domain, material: &[Material]) -> Self {
        let share = |wanted: Material| {
            let found = material.iter().filter(|&&kind| kind == wanted).count();
            found as f32 / material.len().max(1) as f32
        };
        Self {
            ballistic: Ballistic::new(description).for_domain(&description.domain, domain),
            shares: [Material::Liquid, Material::Snow, Material::Jelly].map(share),
            observed: Motion::default(),
            extrapolated: Motion::default(),
            ahead: 0,
            recent: Squares::default(),
            compared: 0,
        }
    }

    /// Forgets what was observed: for a stream that was interrupted.
    pub fn forget(&mut self) {
        (self.recent, self.compared, self.ahead) = (Squares::default(), 0, 0);
    }

    /// Observes the next frame. `predicted` is the prediction of this frame from the frame before it, if both exist.
    pub fn observe(&mut self, frame: &FrameView<'_>, predicted: Option<&Frame>) {
        let motions = || (0..frame.particles.len()).map(|n| frame.particles.motion(n));
        if let Some(predicted) = predicted
            && self.observed.position.len() == frame.particles.len()
            && predicted.len() == frame.particles.len()
        {
            self.compare(motions(), predicted);
        }
        let Motion { position, velocity } = &mut self.observed;
        position.clear();
        velocity.clear();
        position.extend(motions().map(|motion| motion.0));
        velocity.extend(motions().map(|motion| motion.1));
        self.ahead = 0;
    }

    fn compare(&mut self, truth: impl Iterator<Item = ([f32; 2], [f32; 2])>, predicted: &Frame) {
        let mut sums = Squares::default();
        let last = self.observed.position.iter().zip(&self.observed.velocity);
        for (((x, _), (&last_x, &last_v)), &predicted) in truth.zip(last).zip(&predicted.position) {
            sums.error += squared_distance(predicted, x);
            sums.departure += squared_distance(self.ballistic.step(last_x, last_v).0, x);
        }
        // A prediction that was not finite was not published, either.
        if !sums.error.is_finite() {
            return;
        }
        self.compared = (self.compared + 1).min(AVERAGED_FRAMES);
        let weight = 1.0 / f64::from(self.compared);
        let count = self.observed.position.len() as f64;
        let Squares { error, departure } = &mut self.recent;
        *error += weight * (sums.error / count - *error);
        *departure += weight * (sums.departure / count - *departure);
    }

    /// The features of a prediction `horizon` frames after the last observed one. Predictions after the same frame are cheapest
    /// in the order of time. `None` before a prediction was compared with the truth, or if the numbers of particles differ.
    pub fn features(&mut self, predicted: &Frame, horizon: u32) -> Option<Features> {
        if self.compared == 0 || predicted.len() != self.observed.position.len() {
            return None;
        }
        self.extrapolate(horizon);
        let distance = |from: &Motion| mean_squared_distance(&from.position, &predicted.position);
        let Squares { error, departure } = self.recent;
        let [ballistic, travelled] = [&self.extrapolated, &self.observed].map(distance);
        let [a, b, c, d] = [error, departure, ballistic, travelled].map(log_square);
        let [liquid, snow, jelly] = self.shares;
        Some(Features([a, b, c, d, liquid, snow, jelly]))
    }

    /// The estimate for a prediction `horizon` frames after the last observed one; `None` beyond the calibrated numbers of frames,
    /// and as [`ErrorTracker::features`].
    pub fn estimate(
        &mut self,
        model: &ErrorModel,
        predicted: &Frame,
        horizon: u32,
    ) -> Option<ErrorEstimate> {
        let calibrated = model.at(horizon)?;
        Some(calibrated.estimate(&self.features(predicted, horizon)?))
    }

    /// Mean squared distance of positions, `[N, 2]`, from the ballistic extrapolation `horizon` frames after the last observed
    /// frame (domain lengths squared).
    pub fn ballistic_error(&mut self, truth: &[[f32; 2]], horizon: u32) -> f64 {
        self.extrapolate(horizon);
        mean_squared_distance(&self.extrapolated.position, truth)
    }

    fn extrapolate(&mut self, horizon: u32) {
        if self.ahead == 0 || self.ahead > horizon {
            let Motion { position, velocity } = &mut self.extrapolated;
            position.clone_from(&self.observed.position);
            velocity.clone_from(&self.observed.velocity);
            self.ahead = 0;
        }
        let Motion { position, velocity } = &mut self.extrapolated;
        for _ in self.ahead..horizon {
            self.ballistic.step_all(position, velocity);
        }
        self.ahead = horizon;
    }
}
