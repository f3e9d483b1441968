//! Comparison of several reports.

use super::{
    Entry, Report, ReportError, Role,
    page::{at, error, milliseconds, skill},
    scenes::SceneEntry,
};
use crate::{
    Interval,
    bootstrap::{MIN_SCENES, bootstrap},
};
use eddy_pages::{Axis, Cell, LinePlot, Page, Provenance, Series, Table};

/// Frames ahead with error ratios: errors by scene end at the paper's twentieth frame.
const RATIO_FRAMES: [usize; 3] = [1, 10, 20];

/// Reports of the same data.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// The reports and their names.
    reports: Vec<(String, Report)>,
    /// Remarks on differences between the evaluations.
    notes: Vec<String>,
    /// The shortest horizon.
    horizon: usize,
    /// Whether normalised errors have the same units.
    same_units: bool,
    /// Whether the rollouts are the same, in the same order.
    same_scenes: bool,
}

/// A predictor of one of the reports.
struct Row<'a> {
    name: String,
    entry: &'a Entry,
    report: &'a Report,
    /// Its index among the predictors of its report.
    number: usize,
}

/// Checks that the errors of two reports are comparable.
fn same_data(
    (first_name, first): (&str, &Report),
    (second_name, second): (&str, &Report),
) -> Result<(), ReportError> {
    let fields = [
        ("data_digest", first.data_digest.clone(), second.data_digest.clone()),
        ("dt", first.dt.to_string(), second.dt.to_string()),
    ];
    match fields.into_iter().find(|(_, first, second)| first != second) {
        None => Ok(()),
        Some((field, first, second)) => Err(ReportError::Different {
            field,
            first,
            first_name: first_name.to_owned(),
            second,
            second_name: second_name.to_owned(),
        }),
    }
}

impl Comparison {
    /// Compares reports with distinct names.
    ///
    /// # Errors
    /// [`ReportError::Few`] for fewer than two, [`ReportError::Different`] for reports on different data, whose errors are
    /// not comparable.
    pub fn new(reports: Vec<(String, Report)>) -> Result<Self, ReportError> {
        let [(first_name, first), others @ ..] = &reports[..] else {
            return Err(ReportError::Few { found: 0 });
        };
        if others.is_empty() {
            return Err(ReportError::Few { found: 1 });
        }
        for (name, other) in others {
            same_data((first_name, first), (name, other))?;
        }
        let horizon = reports.iter().map(|(_, report)| report.horizon).min().unwrap_or(0);
        let mut notes = Vec::new();
        let mut differ = |words: &str, of: &dyn Fn(&Report) -> String| {
            let all: Vec<String> = reports.iter().map(|(_, report)| of(report)).collect();
            let differ = all.iter().any(|one| *one != all[0]);
            if differ {
                let each: Vec<String> = reports
                    .iter()
                    .zip(&all)
                    .map(|((name, _), value)| format!("{value} in {name}"))
                    .collect();
                notes.push(format!("{words}: {}", each.join(", ")));
            }
            differ
        };
        differ("Horizons differ, comparing up to the shortest", &|report| {
            format!("{} frames", report.horizon)
        });
        differ("Start frames differ, so the means cover different rollouts", &|report| {
            format!("{} rollouts", report.windows)
        });
        differ("Warm-ups differ, so the start frames differ", &|report| {
            let first = report.scenes.first().and_then(|scene| scene.starts.first());
            first.map_or("none".into(), |start| format!("the first from frame {start}"))
        });
        let other_units =
            differ("Normalised errors have different units and are omitted", &|report| {
                format!("{:.4?}", report.units.ranges)
            });
        differ("Program versions differ", &|report| format!("eddy {}", report.made.version));
        differ("Times were measured on different machines", &|report| {
            report.made.machine.processor.clone()
        });
        let key =
            |scene: &SceneEntry| (scene.id, scene.name.clone(), scene.kind, scene.starts.clone());
        let keys = |report: &Report| report.scenes.iter().map(key).collect::<Vec<_>>();
        let same_scenes = others.iter().all(|(_, other)| keys(other) == keys(first));
        if !same_scenes {
            notes.push("Scenes or start frames differ: no error ratios shown".to_owned());
        }
        Ok(Self { reports, notes, horizon, same_units: !other_units, same_scenes })
    }

    /// The predictors of all reports, then the trivial ones, which are the same in all. Linear fits are not: each report has one
    /// to the training data of its first model.
    fn rows(&self) -> Vec<Row<'_>> {
        let is_trivial = |role: Role| matches!(role, Role::Baseline | Role::Mean);
        let mut rows = Vec::new();
        for (name, report) in &self.reports {
            for (number, entry) in report.predictors.iter().enumerate() {
                if entry.role != Role::Truth && !is_trivial(entry.role) {
                    let name = format!("{} ({name})", entry.name);
                    rows.push(Row { name, entry, report, number });
                }
            }
        }
        if let Some((_, report)) = self.reports.first() {
            for (number, entry) in report.predictors.iter().enumerate() {
                if is_trivial(entry.role) {
                    rows.push(Row { name: entry.name.clone(), entry, report, number });
                }
            }
        }
        rows
    }

    /// The frames that all reports show.
    fn shown(&self) -> Vec<usize> {
        let shown = self.reports.first().map(|(_, report)| &report.shown[..]).unwrap_or_default();
        shown.iter().copied().filter(|&ahead| ahead <= self.horizon).collect()
    }

    fn over_frames(&self, caption: &str, of: impl Fn(&Row<'_>, usize) -> Cell) -> Table {
        let shown = self.shown();
        let titles = shown.iter().map(|ahead| format!("frame {ahead}"));
        let mut table = Table::new(caption, std::iter::once(String::new()).chain(titles));
        for row in self.rows() {
            let cells = shown.iter().map(|&ahead| of(&row, ahead));
            table.row(row.name.as_str(), cells.collect::<Vec<_>>());
        }
        table
    }

    /// All tables.
    fn all_tables(&self) -> Vec<Table> {
        let curve = |caption: &str, of: fn(&Entry) -> &Vec<f64>| {
            self.over_frames(caption, |row, ahead| error(at(of(row.entry), ahead)).into())
        };
        let mut tables =
            vec![self.over_frames("Skill, mean of kinds", |row, ahead| match row.entry.role {
                Role::Mean => "-".into(),
                _ => skill(at(&row.entry.skill, ahead)).into(),
            })];
        if self.rows().iter().any(|row| row.entry.skill_intervals.is_some()) {
            tables.push(self.over_frames("Skill, 95 % interval over scenes", |row, ahead| {
                let place = row.report.shown.iter().position(|&shown| shown == ahead);
                let intervals = row.entry.skill_intervals.as_ref();
                place.map_or("-".into(), |place| super::page::between(intervals, place)).into()
            }));
        }
        tables.extend([
            curve("Position RMSE (domain lengths)", |e| &e.curves.position_rmse),
            curve("Velocity RMSE (domain lengths/s)", |e| &e.curves.velocity_rmse),
        ]);
        if self.same_units {
            tables.push(curve("MinMax MSE", |e| &e.curves.minmax_mse));
            tables.push(curve("z-score MSE", |e| &e.curves.zscore_mse));
        }
        tables.extend(self.ratios());
        let mut cost = Table::new(
            "Time per frame and blow-ups",
            ["", "ms, median", "ms, 99 %", "blow-ups", "far off"],
        );
        for row in self.rows() {
            let ms = row.entry.cost.as_ref().map_or([f64::NAN; 2], |cost| [cost.p50, cost.p99]);
            let of = |count: usize| format!("{count} of {}", row.report.windows);
            let counts = [of(row.entry.blow_ups.any), of(row.entry.blow_ups.far_off)];
            cost.row(row.name.as_str(), ms.map(milliseconds).into_iter().chain(counts));
        }
        tables.push(cost);
        tables
    }

    /// Ratios of position errors to those of the first model, with intervals over scenes.
    fn ratios(&self) -> Option<Table> {
        let rows = self.rows();
        let first = rows.first().filter(|_| self.same_scenes)?;
        let frames: Vec<usize> = RATIO_FRAMES.into_iter().filter(|&f| f <= self.horizon).collect();
        let titles = frames.iter().flat_map(|ahead| [format!("frame {ahead}"), "95 %".to_owned()]);
        let mut table = Table::new(
            format!("Position RMSE relative to {}; below 1 is better", first.name),
            std::iter::once(String::new()).chain(titles),
        );
        for row in rows.iter().skip(1) {
            let cells = frames.iter().flat_map(|&ahead| {
                let (ratio, interval) = ratio(&squared(row, ahead), &squared(first, ahead));
                let number = |x: f64| if x.is_nan() { "-".to_owned() } else { format!("{x:.3}") };
                let words = interval.map_or("-".to_owned(), |Interval { lower, upper }| {
                    format!("{} to {}", number(lower), number(upper))
                });
                [number(ratio), words]
            });
            table.row(row.name.as_str(), cells.collect::<Vec<_>>());
        }
        Some(table)
    }

    /// The remarks and the first table, in lines of at most `columns` characters.
    pub fn first_table(&self, columns: usize) -> String {
        self.text(1, columns)
    }

    /// The remarks and all tables, in lines of at most `columns` characters.
    pub fn tables(&self, columns: usize) -> String {
        self.text(usize::MAX, columns)
    }

    fn text(&self, tables: usize, columns: usize) -> String {
        let notes = self.notes.iter().map(|note| format!("{note}\n"));
        let all = self.all_tables();
        let tables = all.iter().take(tables).map(|table| format!("{}\n", table.framed(columns)));
        notes.chain(tables).collect()
    }

    /// The comparison as an HTML page.
    pub fn page(&self, made: &Provenance) -> Page {
        let names: Vec<&str> = self.reports.iter().map(|(name, _)| name.as_str()).collect();
        let lead = format!(
            "{} reports on the same streams, compared over {} frames: {}.",
            names.len(),
            self.horizon,
            names.join(", ")
        );
        let mut page = Page::new("Comparison of reports", lead);
        let section = page.section("Comparison");
        self.notes.iter().for_each(|note| _ = section.note(note));
        section.plots(&self.plots());
        self.all_tables().iter().for_each(|table| _ = section.table(table));
        section.paragraph(
            "Intervals are 95 % percentile bootstrap intervals: 1,000 resamples of the scenes, the same for both sides of a \
             ratio. With fewer than five scenes there is none.",
        );
        let section = page.section("Reproduce");
        section.provenance(made);
        for (name, report) in &self.reports {
            section.heading(name).provenance(&report.made);
            let digests = report.predictors.iter().filter_map(|entry| {
                Some((entry.name.clone(), format!("digest {}", entry.digest.as_ref()?)))
            });
            let data = ("Data".to_owned(), format!("digest {}", report.data_digest));
            section.facts(&std::iter::once(data).chain(digests).collect::<Vec<_>>());
        }
        page
    }

    fn plots(&self) -> [LinePlot; 2] {
        let rows = self.rows();
        let plot = |title: &str, y: Axis, of: fn(&Entry) -> &Vec<f64>| LinePlot {
            title: title.into(),
            x: Axis::linear("frames ahead"),
            y,
            series: rows
                .iter()
                .map(|row| {
                    let drawn = row.report.drawn(of(row.entry));
                    Series::ahead(&row.name, &drawn[..drawn.len().min(self.horizon)])
                })
                .collect(),
        };
        [
            plot(
                "Position error of free rollouts",
                Axis::logarithmic("RMSE (domain lengths)"),
                |e| &e.curves.position_rmse,
            ),
            plot(
                "Velocity error of free rollouts",
                Axis::logarithmic("RMSE (domain lengths/s)"),
                |e| &e.curves.velocity_rmse,
            ),
        ]
    }
}

/// Squared position error of each scene at a frame ahead, summed over its particles and rollouts.
fn squared(row: &Row<'_>, ahead: usize) -> Vec<f64> {
    let of_scene = |scene: &SceneEntry| {
        let errors = scene.errors.get(row.number)?;
        Some(at(&errors.position_rmse, ahead).powi(2) * at(&errors.count, ahead))
    };
    row.report.scenes.iter().map(|scene| of_scene(scene).unwrap_or(f64::NAN)).collect()
}

/// Square root of the ratio of sums over scenes, with its bootstrap interval over scenes; scenes without truth at that
/// frame are excluded.
fn ratio(mine: &[f64], first: &[f64]) -> (f64, Option<Interval>) {
    let pairs = mine.iter().zip(first).filter(|(a, b)| a.is_finite() && b.is_finite());
    let pairs: Vec<(f64, f64)> = pairs.map(|(&a, &b)| (a, b)).collect();
    let of = |chosen: &[usize]| {
        let add = |(a, b), &k: &usize| (a + pairs[k].0, b + pairs[k].1);
        let (a, b) = chosen.iter().fold((0.0, 0.0), add);
        (a / b).sqrt()
    };
    let all = of(&(0..pairs.len()).collect::<Vec<_>>());
    if pairs.len() < MIN_SCENES {
        return (all, None);
    }
    let interval = bootstrap(|draw| vec![of(&draw.of(pairs.len()))]).pop();
    (all, interval)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ratio_of_equal_scenes_has_no_spread_and_others_lie_in_their_interval() {
        let first = [4.0, 1.0, 9.0, 2.0, 5.0];
        let (all, interval) = ratio(&first.map(|x| 4.0 * x), &first);
        assert_eq!((all, interval), (2.0, Some(Interval { lower: 2.0, upper: 2.0 })));
        let (all, interval) = ratio(&[1.0, 8.0, 1.0, 8.0, 1.0, 8.0], &[4.0; 6]);
        let Interval { lower, upper } = interval.unwrap();
        assert!(lower < all && all < upper && lower < 1.0 && upper > 1.0, "{lower} {all} {upper}");
    }

    #[test]
    fn few_scenes_have_no_interval_and_scenes_without_truth_do_not_count() {
        assert_eq!(ratio(&[1.0, f64::NAN, 3.0], &[1.0, 5.0, 0.0]), (2.0, None));
        assert!(ratio(&[], &[]).0.is_nan());
    }
}
