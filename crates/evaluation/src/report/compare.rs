//! Several reports side by side.

use super::{
    Entry, Report, ReportError, Role,
    page::{at, error, milliseconds, skill},
    scenes::SceneEntry,
    tables::of_page,
};
use crate::{
    Interval,
    bootstrap::{FEWEST, bootstrap},
    page::{Axis, Cell, LinePlot, Page, Provenance, Series, Table},
};

/// Frames ahead at which errors are divided: scenes are kept up to the paper's twentieth.
const DIVIDED: [usize; 3] = [1, 10, 20];

/// Reports of the same data.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// The reports with their names.
    reports: Vec<(String, Report)>,
    /// What has to be said before anything is compared.
    notes: Vec<String>,
    /// Frames ahead that all of them compared with the truth.
    horizon: usize,
    /// Whether normalised errors have the same units.
    same_units: bool,
    /// Whether they have the same rollouts in the same order.
    same_scenes: bool,
}

/// Who is compared.
struct Row<'a> {
    name: String,
    entry: &'a Entry,
    report: &'a Report,
    /// Its place among the predictors of its report.
    number: usize,
}

impl Comparison {
    /// Puts reports side by side; each has a name of its own.
    ///
    /// # Errors
    /// [`ReportError::Few`] for less than two, [`ReportError::Different`] for reports of other data: errors of
    /// different scenes say nothing about who is better.
    pub fn new(reports: Vec<(String, Report)>) -> Result<Self, ReportError> {
        let [(first_name, first), others @ ..] = &reports[..] else {
            return Err(ReportError::Few { found: 0 });
        };
        if others.is_empty() {
            return Err(ReportError::Few { found: 1 });
        }
        for (name, other) in others {
            let fields = [
                ("data_digest", first.data_digest.clone(), other.data_digest.clone()),
                ("dt", first.dt.to_string(), other.dt.to_string()),
            ];
            if let Some((field, first, second)) = fields.into_iter().find(|(_, a, b)| a != b) {
                return Err(ReportError::Different {
                    field,
                    first,
                    first_name: first_name.clone(),
                    second,
                    second_name: name.clone(),
                });
            }
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
        differ("The horizons differ, the shortest is what is compared", &|report| {
            format!("{} frames", report.horizon)
        });
        differ("Rollouts start from other frames, errors are means over others", &|report| {
            format!("{} rollouts", report.windows)
        });
        differ("The warm-ups differ, rollouts start from other frames", &|report| {
            let first = report.scenes.first().and_then(|scene| scene.starts.first());
            first.map_or("none".into(), |start| format!("the first from frame {start}"))
        });
        let other_units =
            differ("Normalised errors have other units and are left out", &|report| {
                format!("{:.4?}", report.units.ranges)
            });
        differ("The programs differ", &|report| format!("eddy {}", report.made.version));
        differ("Times of a frame are from other machines", &|report| {
            report.made.machine.processor.clone()
        });
        let key =
            |scene: &SceneEntry| (scene.id, scene.name.clone(), scene.kind, scene.starts.clone());
        let keys = |report: &Report| report.scenes.iter().map(key).collect::<Vec<_>>();
        let same_scenes = others.iter().all(|(_, other)| keys(other) == keys(first));
        if !same_scenes {
            notes.push("Scenes, or the frames that their rollouts start from, are not the same: errors are not divided".to_owned());
        }
        Ok(Self { reports, notes, horizon, same_units: !other_units, same_scenes })
    }

    /// Everyone of every report; what learns nothing comes once, at the end.
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

    /// What there is to compare.
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
            tables.push(self.over_frames("95 % interval of it, over scenes", |row, ahead| {
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
            "Time of a frame and blow-ups",
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

    /// Position errors divided by those of the first model, with intervals over the scenes.
    fn ratios(&self) -> Option<Table> {
        let rows = self.rows();
        let first = rows.first().filter(|_| self.same_scenes)?;
        let frames: Vec<usize> = DIVIDED.into_iter().filter(|&f| f <= self.horizon).collect();
        let titles = frames.iter().flat_map(|ahead| [format!("frame {ahead}"), "95 %".to_owned()]);
        let mut table = Table::new(
            format!("Position RMSE over that of {}; below 1 is better", first.name),
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

    /// The tables for a terminal, what has to be said first.
    pub fn tables(&self) -> String {
        let notes = self.notes.iter().map(|note| format!("{note}\n"));
        let tables = self.all_tables();
        let tables = tables.iter().map(|table| format!("{}\n", of_page(table)));
        notes.chain(tables).collect()
    }

    /// The comparison as a page.
    pub fn page(&self, made: &Provenance) -> Page {
        let names: Vec<&str> = self.reports.iter().map(|(name, _)| name.as_str()).collect();
        let lead = format!(
            "{} reports of the same streams, compared for {} frames: {}.",
            names.len(),
            self.horizon,
            names.join(", ")
        );
        let mut page = Page::new("Reports compared", lead);
        let section = page.section("Side by side");
        self.notes.iter().for_each(|note| _ = section.note(note));
        section.plots(&self.plots());
        self.all_tables().iter().for_each(|table| _ = section.table(table));
        section.paragraph(
            "Intervals hold 95 % of 1,000 draws of the scenes with replacement, both of a ratio from the same scenes; \
             there is none for fewer than five scenes.",
        );
        let section = page.section("How to make this again");
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
                    let curve = of(row.entry);
                    Series::ahead(&row.name, &curve[..curve.len().min(self.horizon)])
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

/// Squared position errors of each scene at a frame ahead, summed over its particles and rollouts.
fn squared(row: &Row<'_>, ahead: usize) -> Vec<f64> {
    let of_scene = |scene: &SceneEntry| {
        let errors = scene.errors.get(row.number)?;
        Some(at(&errors.position_rmse, ahead).powi(2) * at(&errors.count, ahead))
    };
    row.report.scenes.iter().map(|scene| of_scene(scene).unwrap_or(f64::NAN)).collect()
}

/// Root of the ratio of sums over scenes, with its interval by bootstrap over the scenes; scenes without
/// truth at that frame are left out.
fn ratio(mine: &[f64], first: &[f64]) -> (f64, Option<Interval>) {
    let pairs = mine.iter().zip(first).filter(|(a, b)| a.is_finite() && b.is_finite());
    let pairs: Vec<(f64, f64)> = pairs.map(|(&a, &b)| (a, b)).collect();
    let of = |chosen: &[usize]| {
        let add = |(a, b), &k: &usize| (a + pairs[k].0, b + pairs[k].1);
        let (a, b) = chosen.iter().fold((0.0, 0.0), add);
        (a / b).sqrt()
    };
    let all = of(&(0..pairs.len()).collect::<Vec<_>>());
    if pairs.len() < FEWEST {
        return (all, None);
    }
    let interval = bootstrap(|draw| vec![of(&draw.of(pairs.len()))]).pop();
    (all, interval)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ratio_of_scenes_that_agree_has_no_spread_and_another_holds_it() {
        let first = [4.0, 1.0, 9.0, 2.0, 5.0];
        let (all, interval) = ratio(&first.map(|x| 4.0 * x), &first);
        assert_eq!((all, interval), (2.0, Some(Interval { lower: 2.0, upper: 2.0 })));
        let (all, interval) = ratio(&[1.0, 8.0, 1.0, 8.0, 1.0, 8.0], &[4.0; 6]);
        let Interval { lower, upper } = interval.unwrap();
        assert!(lower < all && all < upper && lower < 1.0 && upper > 1.0, "{lower} {all} {upper}");
    }

    #[test]
    fn few_scenes_have_no_interval_and_those_without_truth_do_not_count() {
        assert_eq!(ratio(&[1.0, f64::NAN, 3.0], &[1.0, 5.0, 0.0]), (2.0, None));
        assert!(ratio(&[], &[]).0.is_nan());
    }
}
