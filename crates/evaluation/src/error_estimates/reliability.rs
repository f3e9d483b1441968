//! How well estimates hold.

use serde::{Deserialize, Serialize};

use crate::numbers;
use eddy_inference::error_model::{CalibratedHorizon, LEVELS, UPPER_LEVEL, log_square};
use eddy_pages::Table;

use super::Sample;

/// Intervals of estimated probabilities, of equal width.
const BINS: usize = 10;
/// Fewest predictions that were worse than ballistic ones, and that were not, for an AUROC; fewest predictions of a pooled bin.
const MIN_EVENTS: usize = 10;

/// An estimate beside the error that it is about.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Outcome {
    /// Frames ahead.
    pub horizon: u32,
    /// ln(root mean square position error / its estimated median).
    pub log_ratio: f64,
    /// The level of the error in its estimated distribution, [`Regression::level`](eddy_inference::error_model::Regression::level):
    /// uniform between the stored quantiles if the estimate holds.
    pub level: f64,
    /// Estimated probability that a ballistic prediction is better.
    pub probability: f64,
    /// Whether it was better.
    pub worse_than_ballistic: bool,
}

impl Outcome {
    /// The estimate of a calibrated horizon; `None` for a sample of another horizon.
    pub fn new(at: &CalibratedHorizon, sample: &Sample) -> Option<Self> {
        if at.frames != sample.horizon {
            return None;
        }
        let Sample { horizon, features, error, ballistic_error } = sample;
        let value = log_square(*error);
        Some(Self {
            horizon: *horizon,
            log_ratio: f64::from(0.5 * (value - at.error.quantile(features, 0.5))),
            level: at.error.level(features, value).into(),
            probability: at.worse_than_ballistic.probability(features).into(),
            worse_than_ballistic: error > ballistic_error,
        })
    }
}

/// How well the estimates for one number of frames ahead hold.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Reliability {
    /// Frames ahead.
    pub horizon: u32,
    /// Number of estimates.
    pub estimates: usize,
    /// Half of the errors are within this factor of their estimated median.
    #[serde(deserialize_with = "numbers::one")]
    pub factor: f64,
    /// Share of errors below the estimated bound, whose level is [`UPPER_LEVEL`].
    #[serde(deserialize_with = "numbers::one")]
    pub within_bound: f64,
    /// Share of errors below the estimated quantile at each of [`LEVELS`].
    #[serde(deserialize_with = "numbers::list")]
    pub coverage: Vec<f64>,
    /// Share of predictions that were worse than ballistic ones.
    #[serde(deserialize_with = "numbers::one")]
    pub worse_than_ballistic: f64,
    /// Area under the receiver operating characteristic of "worse than ballistic": the probability that a prediction that was
    /// worse has a higher estimate than one that was not; NaN if fewer than ten were worse or fewer than ten were not.
    #[serde(deserialize_with = "numbers::one")]
    pub auroc: f64,
    /// Mean squared difference between the estimated probability and what happened, 0 or 1 (Brier score).
    #[serde(deserialize_with = "numbers::one")]
    pub brier: f64,
    /// Estimated probabilities beside shares; only intervals with estimates.
    pub bins: Vec<Bin>,
}

/// Predictions whose estimated probability of being worse than ballistic is in one interval.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Bin {
    /// Mean estimated probability.
    pub estimated: f64,
    /// Share that was worse.
    pub observed: f64,
    /// Number of predictions.
    pub count: usize,
}

impl Reliability {
    /// The reliability for each number of frames ahead that occurs, in increasing order.
    pub fn by_horizon(outcomes: &[Outcome]) -> Vec<Self> {
        let mut horizons: Vec<u32> = outcomes.iter().map(|outcome| outcome.horizon).collect();
        horizons.sort_unstable();
        horizons.dedup();
        let of = |horizon: u32| {
            let of_it = outcomes.iter().filter(|outcome| outcome.horizon == horizon);
            Self::of(horizon, &of_it.copied().collect::<Vec<_>>())
        };
        horizons.into_iter().map(of).collect()
    }

    fn of(horizon: u32, outcomes: &[Outcome]) -> Self {
        let count = outcomes.len() as f64;
        let share = |is: &dyn Fn(&Outcome) -> bool| {
            outcomes.iter().filter(|outcome| is(outcome)).count() as f64 / count
        };
        let below = |level: f32| share(&|outcome| outcome.level <= level.into());
        let mut factors: Vec<f64> = outcomes.iter().map(|o| o.log_ratio.abs()).collect();
        factors.sort_by(f64::total_cmp);
        let happened = |outcome: &Outcome| f64::from(u8::from(outcome.worse_than_ballistic));
        let squares = outcomes.iter().map(|o| (o.probability - happened(o)).powi(2));
        Self {
            horizon,
            estimates: outcomes.len(),
            factor: factors.get(factors.len() / 2).map_or(f64::NAN, |factor| factor.exp()),
            within_bound: below(UPPER_LEVEL),
            coverage: LEVELS.map(below).to_vec(),
            worse_than_ballistic: share(&|outcome| outcome.worse_than_ballistic),
            auroc: auroc(outcomes, MIN_EVENTS),
            brier: squares.sum::<f64>() / count,
            bins: bins(outcomes),
        }
    }
    /// Bins over all numbers of frames ahead, those with enough predictions to say something.
    pub fn pooled_bins(all: &[Self]) -> Vec<Bin> {
        let bins = || all.iter().flat_map(|at| &at.bins);
        let pooled = |number: usize| {
            let of_it = || bins().filter(|bin| interval(bin.estimated) == number);
            let count = of_it().map(|bin| bin.count).sum();
            let mean = |of: fn(&Bin) -> f64| {
                of_it().map(|bin| of(bin) * bin.count as f64).sum::<f64>() / count as f64
            };
            let bin =
                Bin { estimated: mean(|b| b.estimated), observed: mean(|b| b.observed), count };
            (count >= MIN_EVENTS).then_some(bin)
        };
        (0..BINS).filter_map(pooled).collect()
    }

    /// A table with a row for each number of frames ahead of each model; a single model needs no name.
    pub fn table<'a>(models: impl IntoIterator<Item = (Option<String>, &'a [Self])>) -> Table {
        let bound = format!("below the {:.0} % bound", 100.0 * UPPER_LEVEL);
        let titles = [
            "frames ahead",
            "rollouts",
            "half within a factor of",
            bound.as_str(),
            "worse than ballistic",
            "AUROC",
            "Brier score",
        ];
        let mut table = Table::new("estimates of the error", titles);
        for (model, rows) in models {
            for found in rows {
                let frame = found.horizon.to_string();
                let name =
                    model.as_ref().map_or(frame.clone(), |model| format!("{model}, {frame}"));
                table.row(name, found.cells());
            }
        }
        table
    }

    fn cells(&self) -> [String; 6] {
        let percent = |share: f64| format!("{:.1} %", 100.0 * share);
        let auroc = if self.auroc.is_nan() { "-".into() } else { format!("{:.2}", self.auroc) };
        [
            self.estimates.to_string(),
            format!("{:.2}", self.factor),
            percent(self.within_bound),
            percent(self.worse_than_ballistic),
            auroc,
            format!("{:.3}", self.brier),
        ]
    }
}

/// The number of the interval with this probability.
fn interval(probability: f64) -> usize {
    ((probability * BINS as f64) as usize).min(BINS - 1)
}

fn bins(outcomes: &[Outcome]) -> Vec<Bin> {
    let of = |number: usize| {
        let is_in = |outcome: &&Outcome| interval(outcome.probability) == number;
        let found: Vec<&Outcome> = outcomes.iter().filter(is_in).collect();
        let count = found.len() as f64;
        let worse = found.iter().filter(|outcome| outcome.worse_than_ballistic).count() as f64;
        let estimated = found.iter().map(|outcome| outcome.probability).sum::<f64>() / count;
        let bin = Bin { estimated, observed: worse / count, count: found.len() };
        (!found.is_empty()).then_some(bin)
    };
    (0..BINS).filter_map(of).collect()
}

/// By ranks (Mann and Whitney 1947): equal estimates share the mean of their ranks. NaN for fewer than `least` of either outcome.
fn auroc(outcomes: &[Outcome], least: usize) -> f64 {
    let worse = outcomes.iter().filter(|outcome| outcome.worse_than_ballistic).count();
    let better = outcomes.len() - worse;
    if worse.min(better) < least {
        return f64::NAN;
    }
    let mut sorted: Vec<&Outcome> = outcomes.iter().collect();
    sorted.sort_by(|a, b| a.probability.total_cmp(&b.probability));
    let (mut rank, mut ranks_of_worse) = (0.0, 0.0);
    for equal in sorted.chunk_by(|a, b| a.probability == b.probability) {
        let worse = equal.iter().filter(|outcome| outcome.worse_than_ballistic).count() as f64;
        ranks_of_worse += worse * (rank + 0.5 * (equal.len() as f64 + 1.0));
        rank += equal.len() as f64;
    }
    let (worse, better) = (worse as f64, better as f64);
    (ranks_of_worse - 0.5 * worse * (worse + 1.0)) / (worse * better)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn outcome(probability: f64, worse_than_ballistic: bool) -> Outcome {
        Outcome { horizon: 5, log_ratio: 0.0, level: 0.5, probability, worse_than_ballistic }
    }

    fn reliability(outcomes: &[Outcome]) -> Reliability {
        let [found] = &Reliability::by_horizon(outcomes)[..] else { panic!("one horizon") };
        found.clone()
    }

    #[test]
    fn the_area_under_the_curve_is_the_share_of_pairs_in_the_right_order() {
        let of = |all: &[(f64, bool)]| {
            auroc(&all.iter().map(|&(p, worse)| outcome(p, worse)).collect::<Vec<_>>(), 1)
        };
        assert_eq!(of(&[(0.1, false), (0.2, false), (0.3, true)]), 1.0);
        assert_eq!(of(&[(0.1, true), (0.2, false)]), 0.0);
        assert_eq!(of(&[(0.1, false), (0.2, true), (0.3, false), (0.4, true)]), 0.75);
        assert_eq!(of(&[(0.5, true), (0.5, false), (0.5, false)]), 0.5, "all the same");
        assert!(of(&[(0.5, true)]).is_nan());
    }

    #[test]
    fn shares_are_counted_by_horizon_and_interval_of_probability() {
        let mut outcomes = Vec::new();
        for (number, level) in [0.05, 0.3, 0.85, 1.0].into_iter().enumerate() {
            let log_ratio = [-0.1, 0.2, -0.3, 0.4][number];
            let (probability, worse) =
                [(0.22, true), (0.28, false), (0.91, true), (1.0, true)][number];
            outcomes.push(Outcome { level, log_ratio, ..outcome(probability, worse) });
        }
        let found = reliability(&outcomes);
        assert_eq!((found.horizon, found.estimates), (5, 4));
        assert!((found.factor - 0.3f64.exp()).abs() < 1e-12);
        assert_eq!((found.within_bound, found.worse_than_ballistic), (0.75, 0.75));
        let coverage = [0, 10, 20].map(|at| found.coverage[at]);
        assert_eq!(coverage, [0.0, 0.5, 0.75], "one error is above the last quantile");
        assert!(found.auroc.is_nan(), "one prediction that was not worse says nothing");
        let squares = [0.78f64, 0.28, 0.09, 0.0].map(|x| x * x);
        assert!((found.brier - squares.iter().sum::<f64>() / 4.0).abs() < 1e-12);
        let bins: Vec<_> = found.bins.iter().map(|bin| (bin.observed, bin.count)).collect();
        assert_eq!(bins, [(0.5, 2), (1.0, 2)]);
        assert!((found.bins[0].estimated - 0.25).abs() < 1e-12);

        let many = vec![found.clone(); 5];
        let pooled = Reliability::pooled_bins(&many);
        assert_eq!((pooled.len(), pooled[0].count, pooled[1].count), (2, 10, 10));
        assert!((pooled[0].estimated - 0.25).abs() < 1e-12 && pooled[0].observed == 0.5);
        assert!(Reliability::pooled_bins(&many[1..]).is_empty(), "too few to say something");

        outcomes.push(Outcome { horizon: 1, ..outcomes[0] });
        let horizons = Reliability::by_horizon(&outcomes);
        assert_eq!(horizons.iter().map(|at| at.horizon).collect::<Vec<_>>(), [1, 5]);
        assert_eq!((horizons[1].estimates, &horizons[1].coverage), (4, &found.coverage));
    }
}
