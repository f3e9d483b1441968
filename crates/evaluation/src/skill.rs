//! Skill: the share of the best trivial predictor's squared error that a predictor removes.

use serde::{Deserialize, Serialize};

use super::{
    Kind, SceneResult,
    bootstrap::{MIN_SCENES, bootstrap},
    numbers,
};
use eddy_dataset::Bounds;
use eddy_frames::{State, mean_squared_distance};
use eddy_inference::engine::{Ballistic, Baseline};

/// A skill with a sign and two decimals; what rounds to zero is `+0.00`.
pub fn skill_text(skill: f64) -> String {
    // The sum makes a negative zero positive.
    format!("{:+.2}", (100.0 * skill).round() / 100.0 + 0.0)
}

/// Squared position errors of the scenes of one kind.
struct KindErrors {
    kind: Kind,
    /// `[scene][predictor][frame]`: sums over particles and windows (domain lengths^2).
    scenes: Vec<Vec<Vec<f64>>>,
}

/// Position errors of all scenes, for skills and their intervals.
pub struct Skills {
    kinds: Vec<KindErrors>,
    baselines: std::ops::Range<usize>,
    horizon: usize,
}

/// A 95 % interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Interval {
    /// Lower end.
    #[serde(deserialize_with = "numbers::one")]
    pub lower: f64,
    /// Upper end.
    #[serde(deserialize_with = "numbers::one")]
    pub upper: f64,
}

impl Skills {
    /// Collects the errors of evaluated scenes; `baselines` are the indices of the trivial predictors.
    pub fn of(scenes: &[SceneResult], baselines: std::ops::Range<usize>, horizon: usize) -> Self {
        let of_kind = |kind: Kind| {
            let of_scene = |scene: &SceneResult| {
                let accumulators = scene.accumulators.iter();
                accumulators
                    .map(|t| t.errors.total().iter().map(|e| e.position).collect())
                    .collect()
            };
            let evaluated = scenes.iter().filter(|s| s.kind == kind && s.windows() > 0);
            KindErrors { kind, scenes: evaluated.map(of_scene).collect() }
        };
        let kinds = Kind::ALL.into_iter().map(of_kind).filter(|k| !k.scenes.is_empty()).collect();
        Self { kinds, baselines, horizon }
    }

    /// The kinds that occur.
    pub fn kinds(&self) -> impl Iterator<Item = Kind> {
        self.kinds.iter().map(|kind| kind.kind)
    }

    /// Skill of a predictor in scenes of one kind, one number per frame ahead: 1 - its squared position error / the
    /// squared position error of the best baseline at that frame, both summed over windows. NaN without truth.
    pub fn of_kind(&self, kind: Kind, predictor: usize) -> Vec<f64> {
        let found = self.kinds.iter().find(|errors| errors.kind == kind);
        let skill = |errors: &KindErrors| {
            let all: Vec<usize> = (0..errors.scenes.len()).collect();
            (0..self.horizon).map(|k| self.skill(errors, &all, predictor, k)).collect()
        };
        found.map(skill).unwrap_or_default()
    }

    /// Mean skill over the kinds that occur, one number per frame ahead.
    pub fn mean(&self, predictor: usize) -> Vec<f64> {
        let all: Vec<Vec<f64>> = self.kinds().map(|kind| self.of_kind(kind, predictor)).collect();
        let mean = |k: usize| all.iter().map(|skill| skill[k]).sum::<f64>() / all.len() as f64;
        (0..self.horizon).map(mean).collect()
    }

    /// 95 % intervals of the skill averaged over kinds and `predictors`, at `frames` ahead (from 1), by bootstrap over
    /// the scenes of each kind. `None` when a kind has fewer than five scenes.
    pub fn intervals(&self, predictors: &[usize], frames: &[usize]) -> Option<Vec<Interval>> {
        intervals(self, &self.kinds, &mean_of(predictors, 1.0), frames)
    }

    /// As [`Skills::intervals`], of the difference between the mean skills of `predictors` and of `others`, both from the same
    /// resamples of the scenes.
    pub fn gain_intervals(
        &self,
        predictors: &[usize],
        others: &[usize],
        frames: &[usize],
    ) -> Option<Vec<Interval>> {
        let difference = [mean_of(predictors, 1.0), mean_of(others, -1.0)].concat();
        intervals(self, &self.kinds, &difference, frames)
    }

    /// As [`Skills::intervals`], for the scenes of one kind.
    pub fn intervals_of_kind(
        &self,
        kind: Kind,
        predictors: &[usize],
        frames: &[usize],
    ) -> Option<Vec<Interval>> {
        let at = self.kinds.iter().position(|errors| errors.kind == kind)?;
        intervals(self, &self.kinds[at..=at], &mean_of(predictors, 1.0), frames)
    }

    /// Skill over the chosen scenes of a kind at frame `k`, from 0.
    fn skill(&self, errors: &KindErrors, chosen: &[usize], predictor: usize, k: usize) -> f64 {
        let sum = |predictor: usize| -> f64 {
            chosen.iter().map(|&scene| errors.scenes[scene][predictor][k]).sum()
        };
        let best = self.baselines.clone().map(sum).fold(f64::INFINITY, f64::min);
        1.0 - sum(predictor) / best
    }
}

/// Skill of positions from any source, one number per frame ahead: 1 - their squared error / that of the best baseline at
/// that frame, both summed over windows. `starts` are the last observed states of W windows of N particles; `truth` and
/// `predicted` are `[W, T, N]`. The baselines' walls are the bounding box of the truth, as in an evaluation; `dt` is in s,
/// gravity in domain lengths per s^2.
///
/// # Panics
/// If the lengths do not agree, or there is no window.
pub fn position_skill(
    starts: &[State],
    truth: &[[f32; 2]],
    predicted: &[[f32; 2]],
    dt: f32,
    gravity: [f32; 2],
) -> Vec<f64> {
    let particles = starts[0].position.len();
    let horizon = truth.len() / (starts.len() * particles);
    assert_eq!([truth.len(), predicted.len()], [starts.len() * horizon * particles; 2]);
    let mut walls = Bounds::default();
    starts.iter().for_each(|state| walls.widen(state));
    truth.iter().for_each(|&at| walls.join(&Bounds { lower: at, upper: at }));
    let ballistic = Ballistic { gravity, dt, lower: walls.lower, upper: walls.upper };
    let mut errors = vec![([0.0; Baseline::ALL.len()], 0.0); horizon];
    let window = horizon * particles;
    let windows = truth.chunks_exact(window).zip(predicted.chunks_exact(window));
    for (start, (truth, predicted)) in starts.iter().zip(windows) {
        let mut trivial = Baseline::ALL.map(|_| start.clone());
        let frames = truth.chunks_exact(particles).zip(predicted.chunks_exact(particles));
        for ((truth, predicted), (baselines, error)) in frames.zip(&mut errors) {
            *error += mean_squared_distance(predicted, truth);
            for ((baseline, state), error) in Baseline::ALL.iter().zip(&mut trivial).zip(baselines)
            {
                baseline.step(state, &ballistic, None);
                *error += mean_squared_distance(&state.position, truth);
            }
        }
    }
    let skill = |(baselines, error): ([f64; 3], f64)| {
        1.0 - error / baselines.into_iter().fold(f64::INFINITY, f64::min)
    };
    errors.into_iter().map(skill).collect()
}

/// Weights of predictors in `factor` times their mean.
fn mean_of(predictors: &[usize], factor: f64) -> Vec<(usize, f64)> {
    predictors.iter().map(|&predictor| (predictor, factor / predictors.len() as f64)).collect()
}

/// Intervals of a weighted sum of predictors' skills.
fn intervals(
    skills: &Skills,
    kinds: &[KindErrors],
    weights: &[(usize, f64)],
    frames: &[usize],
) -> Option<Vec<Interval>> {
    if kinds.is_empty() || kinds.iter().any(|kind| kind.scenes.len() < MIN_SCENES) {
        return None;
    }
    let intervals = bootstrap(|draw| {
        let choices: Vec<Vec<usize>> =
            kinds.iter().map(|kind| draw.of(kind.scenes.len())).collect();
        let mean = |&ahead: &usize| {
            let mut sum = 0.0;
            for (kind, chosen) in kinds.iter().zip(&choices) {
                let of = |&(predictor, weight): &(usize, f64)| {
                    weight * skills.skill(kind, chosen, predictor, ahead - 1)
                };
                sum += weights.iter().map(of).sum::<f64>();
            }
            sum / kinds.len() as f64
        };
        frames.iter().map(mean).collect()
    });
    Some(intervals)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One baseline with error 1 or 3, another with 2, and a predictor.
    fn skills(liquid: Vec<[f64; 3]>, rope: Vec<[f64; 3]>) -> Skills {
        let kind = |kind: Kind, scenes: Vec<[f64; 3]>| KindErrors {
            kind,
            scenes: scenes.iter().map(|s| s.iter().map(|&e| vec![e]).collect()).collect(),
        };
        let kinds = vec![kind(Kind::Liquid, liquid), kind(Kind::Rope, rope)];
        Skills { kinds, baselines: 0..2, horizon: 1 }
    }

    #[test]
    fn errors_are_summed_over_scenes_before_they_are_divided() {
        // The second scene is at rest: alone it would divide by zero.
        let skills = skills(vec![[1.0, 2.0, 0.1], [0.0, 0.0, 0.1]], vec![[3.0, 2.0, 1.0]]);
        assert!((skills.of_kind(Kind::Liquid, 2)[0] - 0.8).abs() < 1e-12);
        assert_eq!(skills.of_kind(Kind::Rope, 2), [0.5], "the second baseline is the best");
        assert!((skills.mean(2)[0] - 0.65).abs() < 1e-12);
        assert!(skills.of_kind(Kind::Snow, 2).is_empty());
    }

    #[test]
    fn scenes_that_agree_have_no_spread_and_others_an_interval_around_the_mean() {
        let same = skills(vec![[1.0, 2.0, 0.25]; 5], vec![[1.0, 2.0, 0.75]; 5]);
        let exactly = |x: f64| Some(vec![Interval { lower: x, upper: x }]);
        assert_eq!(same.intervals(&[2], &[1]), exactly(0.5));
        assert_eq!(same.intervals_of_kind(Kind::Rope, &[2], &[1]), exactly(0.25));

        // The error of each scene is drawn from 0..1: the standard error of the mean of 100 is 0.029.
        let spread = |n: usize| -> Vec<[f64; 3]> {
            (0..n).map(|k| [1.0, 2.0, (k as f64 * 0.618_034).fract()]).collect()
        };
        let skills = skills(spread(100), vec![[1.0, 2.0, 0.5]; 5]);
        let [Interval { lower, upper }] = skills.intervals(&[2], &[1]).unwrap()[..] else {
            panic!()
        };
        let expected = 2.0 * 1.96 * 0.0289 / 2.0;
        assert!((0.5 * (lower + upper) - 0.5).abs() < 0.01, "{lower}..{upper}");
        assert!(((upper - lower) / expected - 1.0).abs() < 0.15, "{lower}..{upper}");
    }

    #[test]
    fn a_skill_is_never_minus_zero() {
        assert_eq!(
            [-0.004, 0.004, -0.006, 0.5].map(skill_text),
            ["+0.00", "+0.00", "-0.01", "+0.50"]
        );
    }

    #[test]
    fn several_predictors_have_the_interval_of_their_mean() {
        let skills = skills(vec![[1.0, 2.0, 0.25]; 5], vec![[1.0, 2.0, 0.75]; 5]);
        // The first baseline itself has no skill.
        let expected = Interval { lower: 0.25, upper: 0.25 };
        assert_eq!(skills.intervals(&[0, 2], &[1]), Some(vec![expected]));
    }

    #[test]
    fn a_gain_is_taken_on_the_same_scenes() {
        // Errors differ from scene to scene, the difference of the two predictors does not.
        let scene = |number: u8| {
            let error = f64::from(number) / 20.0;
            [1.0, 1.0, error + 0.25, error]
        };
        let scenes: Vec<[f64; 4]> = (0..20).map(scene).collect();
        let kind = KindErrors {
            kind: Kind::Liquid,
            scenes: scenes.iter().map(|s| s.iter().map(|&e| vec![e]).collect()).collect(),
        };
        let skills = Skills { kinds: vec![kind], baselines: 0..2, horizon: 1 };
        let [alone] = skills.intervals(&[3], &[1]).unwrap()[..] else { panic!("one frame") };
        let [gain] = skills.gain_intervals(&[3], &[2], &[1]).unwrap()[..] else { panic!() };
        assert!(alone.upper - alone.lower > 0.1, "{alone:?}");
        assert!((gain.lower - 0.25).abs() < 1e-12 && (gain.upper - 0.25).abs() < 1e-12, "{gain:?}");
        let [both] = skills.gain_intervals(&[2, 3], &[2], &[1]).unwrap()[..] else { panic!() };
        assert!((both.lower - 0.125).abs() < 1e-12, "half of it: {both:?}");
    }

    #[test]
    fn positions_from_any_source_are_compared_with_the_best_baseline() {
        // Two windows of one particle that falls freely for three frames: the ballistic step is exact.
        let (dt, gravity) = (0.1, [0.0, -1.0]);
        let start = |x: f32| State { position: vec![[x, 0.5]], velocity: vec![[1.0, 0.0]] };
        let starts = [start(0.1), start(0.3)];
        let free = Ballistic { gravity, dt, lower: [-9.0; 2], upper: [9.0; 2] };
        let fall = |start: &State| Baseline::Ballistic.roll_out(start, &free, &[const { None }; 3]);
        let truth: Vec<[f32; 2]> =
            starts.iter().flat_map(fall).flat_map(|state| state.position).collect();
        // Displaced sideways, the truth has an exact baseline no more: constant velocity and ballistic err alike by it.
        let displaced: Vec<[f32; 2]> = truth.iter().map(|[x, y]| [x + 0.25, *y]).collect();
        let skill = position_skill(&starts, &displaced, &displaced, dt, gravity);
        assert_eq!(skill, [1.0; 3]);
        let skill = position_skill(&starts, &displaced, &truth, dt, gravity);
        assert!(
            skill.iter().all(|skill| skill.abs() < 1e-6),
            "as good as the ballistic step: {skill:?}"
        );
        let half: Vec<[f32; 2]> = truth.iter().map(|[x, y]| [x + 0.125, *y]).collect();
        let skill = position_skill(&starts, &displaced, &half, dt, gravity);
        assert!(skill.iter().all(|skill| (skill - 0.75).abs() < 1e-5), "half the error: {skill:?}");
    }

    #[test]
    fn fewer_than_five_scenes_of_a_kind_have_no_interval() {
        let skills = skills(vec![[1.0, 2.0, 0.25]; 5], vec![[1.0, 2.0, 0.75]; 4]);
        assert_eq!(skills.intervals(&[2], &[1]), None);
        assert_eq!(skills.intervals_of_kind(Kind::Rope, &[2], &[1]), None);
        assert!(skills.intervals_of_kind(Kind::Liquid, &[2], &[1]).is_some());
    }
}
