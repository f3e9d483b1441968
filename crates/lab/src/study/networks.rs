//! Results of the networks on a preset, as tables and plots.

use super::{Comparison, Trained, Variant};
use eddy_evaluation::{
    Entry, Interval, Report, Role,
    bootstrap::{MIN_SCENES, bootstrap},
};
use eddy_inference::checkpoint::Core;
use eddy_pages::{Axis, Cell, LinePlot, Series, Table};

/// Networks on one preset: every variant with every seed, evaluated on the same scenes.
pub struct Networks<'a> {
    /// What is compared.
    pub comparison: Comparison,
    /// The variants.
    pub variants: &'a [Variant],
    /// The seeds.
    pub seeds: &'a [u64],
    /// Trainings: all variants with the first seed, then all with the second, and so on.
    pub trained: Vec<Trained>,
    /// The evaluation report, with the networks first and in the same order, and then all of them again, joined late.
    pub report: Report,
}

impl Networks<'_> {
    /// Indices of a variant's networks among all, one per seed.
    fn places(&self, variant: usize) -> impl Iterator<Item = usize> {
        let count = self.variants.len();
        (0..self.seeds.len()).map(move |seed| seed * count + variant)
    }

    /// Indices of a variant's networks among the predictors of the report, one per seed: each has observed as many frames as in
    /// training, as in the paper.
    fn predictors(&self, variant: usize) -> impl Iterator<Item = usize> {
        self.places(variant).map(|place| self.trained.len() + place)
    }

    fn entries(&self, variant: usize) -> impl Iterator<Item = &Entry> {
        self.predictors(variant).map(|place| &self.report.predictors[place])
    }

    /// The same networks after all frames of the stream up to the start of the rollout.
    fn after_stream(&self, variant: usize) -> impl Iterator<Item = &Entry> {
        self.places(variant).map(|place| &self.report.predictors[place])
    }

    /// The trivial predictors.
    fn trivial(&self) -> impl Iterator<Item = (usize, &Entry)> {
        let trivial = |(_, entry): &(usize, &Entry)| {
            matches!(entry.role, Role::Baseline | Role::Mean | Role::LinearFit)
        };
        self.report.predictors.iter().enumerate().filter(trivial)
    }

    /// Mean over the frames ahead of a predictor's MinMax MSE in each scene.
    fn by_scene(&self, place: usize) -> Vec<f64> {
        let scenes = self.report.scenes.iter();
        scenes.map(|scene| mean(scene.errors[place].minmax_mse.iter().copied())).collect()
    }

    /// MinMax MSE of a predictor at the last frame in each scene.
    fn at_the_end(&self, place: usize) -> Vec<f64> {
        let scenes = self.report.scenes.iter();
        scenes.map(|scene| last(&scene.errors[place].minmax_mse)).collect()
    }

    /// A row per variant: size, errors with their range over seeds, skill, time per frame.
    pub fn summary(&self) -> Table {
        let horizon = self.report.horizon;
        let end = format!("RMSE at {horizon} (domain lengths)");
        let mut table = Table::new(
            format!(
                "Free rollouts: mean over seeds, and lowest to highest seed; {} scenes, {} rollouts",
                self.report.streams, self.report.windows
            ),
            [
                "",
                "parameters",
                "MSE, mean of frames",
                "lowest to highest",
                &end,
                "skill at 1",
                &format!("skill at {horizon}"),
                &format!("skill at {horizon} after the whole stream"),
                "ms per frame",
            ],
        );
        for (number, variant) in self.variants.iter().enumerate() {
            let errors: Vec<f64> =
                self.predictors(number).map(|at| mean(self.by_scene(at).into_iter())).collect();
            let [lowest, highest] = extremes(&errors);
            let of = |value: fn(&Entry) -> f64| mean(self.entries(number).map(value));
            let cells = [
                self.trained[number].parameters.to_string(),
                scientific(mean(errors.iter().copied())),
                format!("{} to {}", scientific(lowest), scientific(highest)),
                format!("{:.4}", of(|entry| last(&entry.curves.position_rmse))),
                format!("{:+.3}", of(|entry| entry.skill[0])),
                format!("{:+.3}", of(|entry| last(&entry.skill))),
                format!("{:+.3}", mean(self.after_stream(number).map(|entry| last(&entry.skill)))),
                milliseconds(of(|entry| entry.cost.as_ref().map_or(f64::NAN, |cost| cost.p50))),
            ];
            table.row(variant.setting.as_str(), cells);
        }
        for (place, entry) in self.trivial() {
            let has_skill = entry.role != Role::Mean;
            let skill = |skill: f64| if has_skill { format!("{skill:+.3}") } else { "-".into() };
            let cells = [
                "-".to_owned(),
                scientific(mean(self.by_scene(place).into_iter())),
                "-".to_owned(),
                format!("{:.4}", last(&entry.curves.position_rmse)),
                skill(entry.skill[0]),
                skill(last(&entry.skill)),
                "-".to_owned(),
                "-".to_owned(),
            ];
            table.row(entry.name.as_str(), cells);
        }
        table
    }

    /// A row per frame ahead: the skill of every variant, and of the predictors beside them.
    pub fn skills(&self) -> Table {
        let beside: Vec<&Entry> = self.trivial().map(|(_, entry)| entry).collect();
        let beside = beside.into_iter().filter(|entry| entry.role != Role::Mean);
        let names = self.variants.iter().map(|variant| variant.setting.clone());
        let mut table = Table::new(
            "Skill by frames ahead: mean over seeds (lowest to highest seed)",
            std::iter::once("frames ahead".to_owned())
                .chain(names)
                .chain(beside.clone().map(|entry| entry.name.clone())),
        );
        for frame in 0..self.report.horizon {
            let networks = (0..self.variants.len()).map(|variant| {
                let seeds: Vec<f64> =
                    self.entries(variant).map(|entry| entry.skill[frame]).collect();
                let [lowest, highest] = extremes(&seeds);
                let mean = mean(seeds.into_iter());
                format!("{mean:+.3} ({lowest:+.3} to {highest:+.3})")
            });
            let beside = beside.clone().map(|entry| format!("{:+.3}", entry.skill[frame]));
            let cells: Vec<String> = networks.chain(beside).collect();
            table.row((frame + 1).to_string(), cells);
        }
        table
    }

    /// The paper's Tables 2 and 3: MinMax MSE by scene, mean over the frames and at the last; mean over seeds.
    pub fn by_scenes(&self) -> [Table; 2] {
        let end = format!("MinMax MSE at frame {}", self.report.horizon);
        [
            self.of_scenes("MinMax MSE, mean over the frames ahead", Self::by_scene),
            self.of_scenes(&end, Self::at_the_end),
        ]
    }

    fn of_scenes(&self, caption: &str, errors: fn(&Self, usize) -> Vec<f64>) -> Table {
        let trivial = self.trivial().map(|(_, entry)| entry.name.clone());
        let names = self.variants.iter().map(|variant| variant.setting.clone()).chain(trivial);
        let mut table = Table::new(
            format!("{caption}; mean over {} seeds, the lowest in bold", self.seeds.len()),
            std::iter::once("scene".to_owned()).chain(names),
        );
        let networks = (0..self.variants.len()).map(|variant| {
            let seeds: Vec<Vec<f64>> =
                self.predictors(variant).map(|place| errors(self, place)).collect();
            (0..self.report.scenes.len())
                .map(|scene| mean(seeds.iter().map(|s| s[scene])))
                .collect()
        });
        let trivial = self.trivial().map(|(place, _)| errors(self, place));
        let columns: Vec<Vec<f64>> = networks.chain(trivial).collect();
        for (number, scene) in self.report.scenes.iter().enumerate() {
            let row: Vec<f64> = columns.iter().map(|column| column[number]).collect();
            table.row(scene.title(), Cell::lowest_bold(&row, scientific));
        }
        let row: Vec<f64> = columns.iter().map(|column| mean(column.iter().copied())).collect();
        table.row("mean", Cell::lowest_bold(&row, scientific));
        table
    }

    /// Ratios of errors of two variants, with intervals over scenes and seeds.
    pub fn ratios(&self) -> Table {
        let mut table = Table::new(
            "MinMax MSE relative to another; below 1 is better",
            ["", "mean of frames", "95 %", "last frame", "95 %"],
        );
        for [mine, other] in self.comparison.pairs(self.variants) {
            let cells = [Self::by_scene, Self::at_the_end].into_iter().flat_map(|errors| {
                let of = |variant| -> Vec<Vec<f64>> {
                    self.predictors(variant).map(|place| errors(self, place)).collect()
                };
                let (ratio, interval) = ratio(&of(mine), &of(other));
                let words = |Interval { lower, upper }| format!("{lower:.3} to {upper:.3}");
                [format!("{ratio:.3}"), interval.map_or("-".to_owned(), words)]
            });
            let [mine, other] = [mine, other].map(|number| &self.variants[number].setting);
            table.row(format!("{mine} / {other}"), cells.collect::<Vec<_>>());
        }
        table
    }

    /// The paper's Table 4 for these trainings: means over the seeds.
    pub fn training(&self) -> Table {
        let at_once = self.trained.iter().map(|trained| trained.at_once).max().unwrap_or(1);
        // Reached by every network.
        let best = self.trained.iter().filter_map(Trained::best);
        let common = best.map(|best| best.validation_loss).fold(f64::NAN, f64::max);
        let common = (1e3 * common).ceil() / 1e3;
        let mut table = Table::new(
            format!("Training, up to {at_once} in parallel: means over seeds"),
            [
                "",
                "epochs",
                "best epoch",
                "time (s)",
                "time per sample (ms)",
                "time per epoch (s)",
                "validation loss",
                "on training scenes",
                &format!("time to loss {common:.3} (s)"),
            ],
        );
        for (number, variant) in self.variants.iter().enumerate() {
            let runs: Vec<&Trained> =
                self.places(number).map(|place| &self.trained[place]).collect();
            let of = |value: fn(&Trained) -> f64| mean(runs.iter().map(|run| value(run)));
            let cells = [
                format!("{:.0}", of(|run| run.epochs.len() as f64)),
                format!(
                    "{:.1}",
                    of(|run| run.best().map_or(f64::NAN, |best| f64::from(best.epoch)))
                ),
                format!("{:.0}", of(|run| run.seconds)),
                format!("{:.2}", of(|run| 1e3 * run.seconds / run.samples as f64)),
                format!("{:.1}", of(|run| run.seconds / run.epochs.len() as f64)),
                format!(
                    "{:.4}",
                    of(|run| run.best().map_or(f64::NAN, |best| best.validation_loss))
                ),
                format!("{:.4}", of(|run| run.losses.seen)),
                seconds(mean(runs.iter().filter_map(|run| run.time_to(common)))),
            ];
            table.row(variant.setting.as_str(), cells);
        }
        // The same for all networks with as long a warm-up.
        if let Some(loss) = self.trained.first().and_then(|trained| trained.losses.linear_fit) {
            let mut cells = [(); 8].map(|()| "-".to_owned());
            cells[5] = format!("{loss:.4}");
            table.row("linear fit", cells);
        }
        table
    }

    /// Errors over the frames ahead (the paper's Figs. 4, 8 and 9), and validation losses over the epochs.
    pub fn plots(&self) -> [LinePlot; 2] {
        let seeds = |variant: usize, curves: Vec<Vec<f64>>| {
            spread(&self.variants[variant].setting, &curves)
        };
        let variants = 0..self.variants.len();
        let errors = |variant: usize| {
            let entries = self.entries(variant);
            seeds(variant, entries.map(|entry| entry.curves.minmax_mse.clone()).collect())
        };
        let trivial =
            self.trivial().map(|(_, entry)| Series::ahead(&entry.name, &entry.curves.minmax_mse));
        let errors = variants.clone().map(errors).chain(trivial);
        let loss = |place: usize| -> Vec<f64> {
            self.trained[place].epochs.iter().map(|epoch| epoch.validation_loss).collect()
        };
        let losses = |variant: usize| seeds(variant, self.places(variant).map(loss).collect());
        [
            LinePlot {
                title: "Free rollouts, all scenes; bands: lowest to highest seed".into(),
                x: Axis::linear("frames ahead"),
                y: Axis::logarithmic("MinMax MSE"),
                series: errors.collect(),
            },
            LinePlot {
                title: "Validation".into(),
                x: Axis::linear("epoch"),
                y: Axis::linear("error / best baseline error"),
                series: variants.map(losses).collect(),
            },
        ]
    }
}

/// The mean of curves over 1, 2, 3, ..., with a band from the lowest to the highest.
pub(super) fn spread(name: &str, curves: &[Vec<f64>]) -> Series {
    let length = curves.iter().map(Vec::len).min().unwrap_or(0);
    let at = |index: usize| curves.iter().map(move |curve| curve[index]);
    let middle: Vec<f64> = (0..length).map(|index| mean(at(index))).collect();
    let band = (0..length).map(|index| {
        let [lowest, highest] = extremes(&at(index).collect::<Vec<_>>());
        [(index + 1) as f64, lowest, highest]
    });
    let band = if curves.len() > 1 { band.collect() } else { Vec::new() };
    Series { band, ..Series::ahead(name, &middle) }
}

impl Comparison {
    /// Pairs of variants whose errors are compared as ratios.
    fn pairs(self, variants: &[Variant]) -> Vec<[usize; 2]> {
        let all = 0..variants.len();
        let of = |number: usize| (variants[number].config.core, frames(&variants[number]));
        // The paper's questions: each minimal core beside its model, and every core beside none, after as many frames.
        let cores = || {
            let pair = |[mine, other]: [Core; 2], number: usize| {
                let (core, frames) = of(number);
                let mut others = all.clone();
                let beside = others.find(|&beside| {
                    other == of(beside).0 && (other == Core::Mlp || frames == of(beside).1)
                });
                beside.filter(|_| core == mine).map(|beside| [number, beside])
            };
            all.clone()
                .flat_map(move |number| PAIRS.into_iter().filter_map(move |p| pair(p, number)))
        };
        match self {
            Self::Cores => cores().collect(),
            Self::Window => {
                let shortest = |number: usize| {
                    let first = all.clone().find(|&first| of(first).0 == of(number).0)?;
                    (first != number).then_some([number, first])
                };
                cores().chain(all.clone().filter_map(shortest)).collect()
            }
            _ => all.skip(1).map(|number| [number, 0]).collect(),
        }
    }
}

/// Cores that are compared with each other.
const PAIRS: [[Core; 2]; 6] = [
    [Core::MinLstm, Core::Lstm],
    [Core::MinGru, Core::Gru],
    [Core::MinLstm, Core::Mlp],
    [Core::MinGru, Core::Mlp],
    [Core::Lstm, Core::Mlp],
    [Core::Gru, Core::Mlp],
];

/// Observed frames of a training window.
fn frames(variant: &Variant) -> usize {
    variant.config.windows.warm_up
}

/// Ratio of two variants' means over seeds and scenes, and its bootstrap interval over scenes (the same for both) and seeds;
/// no interval for fewer than five scenes.
fn ratio(mine: &[Vec<f64>], other: &[Vec<f64>]) -> (f64, Option<Interval>) {
    let scenes = mine.first().map_or(0, Vec::len);
    let over = |runs: &[Vec<f64>], seeds: &[usize], scenes: &[usize]| {
        mean(seeds.iter().flat_map(|&seed| scenes.iter().map(move |&scene| runs[seed][scene])))
    };
    let all = |count: usize| (0..count).collect::<Vec<_>>();
    let of = |a: &[usize], b: &[usize], c: &[usize]| over(mine, a, c) / over(other, b, c);
    let whole = of(&all(mine.len()), &all(other.len()), &all(scenes));
    if scenes < MIN_SCENES {
        return (whole, None);
    }
    let interval = bootstrap(|draw| {
        let [a, b, c] = [mine.len(), other.len(), scenes].map(|count| draw.of(count));
        vec![of(&a, &b, &c)]
    });
    (whole, interval.into_iter().next())
}

/// The mean, ignoring NaN.
pub(super) fn mean(numbers: impl Iterator<Item = f64>) -> f64 {
    let (mut sum, mut count) = (0.0, 0);
    for number in numbers.filter(|number| !number.is_nan()) {
        sum += number;
        count += 1;
    }
    sum / f64::from(count)
}

fn last(numbers: &[f64]) -> f64 {
    numbers.last().copied().unwrap_or(f64::NAN)
}

pub(super) fn extremes(numbers: &[f64]) -> [f64; 2] {
    let lowest = numbers.iter().copied().fold(f64::INFINITY, f64::min);
    [lowest, numbers.iter().copied().fold(f64::NEG_INFINITY, f64::max)]
}

pub(super) fn scientific(number: f64) -> String {
    format!("{number:.2e}")
}

/// A time (s); none for NaN.
fn seconds(number: f64) -> String {
    if number.is_nan() { "-".to_owned() } else { format!("{number:.0}") }
}

fn milliseconds(number: f64) -> String {
    if number.is_nan() { "-".to_owned() } else { format!("{number:.2}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ratio_lies_in_its_interval_which_widens_with_the_spread_of_scenes_and_seeds() {
        let other = vec![vec![1.0, 2.0, 4.0, 3.0, 1.0, 2.0]; 3];
        let twice: Vec<Vec<f64>> =
            other.iter().map(|seed| seed.iter().map(|x| 2.0 * x).collect()).collect();
        let (all, interval) = ratio(&twice, &other);
        assert_eq!((all, interval), (2.0, Some(Interval { lower: 2.0, upper: 2.0 })));

        let mut uneven = twice;
        uneven[0].iter_mut().for_each(|x| *x *= 0.25);
        let (all, interval) = ratio(&uneven, &other);
        let Interval { lower, upper } = interval.unwrap();
        assert_eq!(all, 1.5);
        assert!(lower < 1.0 && upper > 1.9, "{lower} {upper}");
        assert_eq!(ratio(&[vec![2.0; 4]], &[vec![1.0; 4]]), (2.0, None));
    }

    #[test]
    fn a_spread_goes_from_the_lowest_to_the_highest() {
        let series = spread("a", &[vec![1.0, 2.0, 9.0], vec![3.0, 2.0]]);
        assert_eq!(series.points, [[1.0, 2.0], [2.0, 2.0]]);
        assert_eq!(series.band, [[1.0, 1.0, 3.0], [2.0, 2.0, 2.0]]);
        assert!(spread("a", &[vec![1.0]]).band.is_empty());
    }

    #[test]
    fn what_is_no_number_has_no_part_in_a_mean() {
        assert_eq!(mean([1.0, f64::NAN, 3.0].into_iter()), 2.0);
        assert!(mean(std::iter::empty()).is_nan());
    }
}
