//! The report for a terminal.

use std::fmt::Write as _;

use comfy_table::{Table, presets::UTF8_BORDERS_ONLY};

use super::{Entry, Report, Role, group::GroupSkill, measures::Measures};
use crate::{BlowUps, Interval, KindCost};

/// The frames ahead at which kinds are shown side by side.
const BY_KIND: [usize; 3] = [1, 20, 100];
/// The frames ahead at which measures are shown.
const MEASURED: [usize; 3] = [20, 50, 100];

/// How a measure is shown: its name, which it is, and in what form.
type Column = (&'static str, fn(&Measures) -> f64, fn(f64) -> String);

/// Measures that are shown side by side.
const MEASURES: [&[Column]; 5] = [
    &[
        ("mass elsewhere", |m| m.misplaced, percent),
        ("kinetic energy", |m| m.kinetic_energy_error, percent),
    ],
    &[("centre", |m| m.centre_rmse, scientific), ("outside", |m| m.outside, percent)],
    &[("liquid area", |m| m.liquid_area, ratio), ("rms off 1", |m| m.liquid_area_off, percent)],
    &[
        ("rope stretch", |m| m.rope_stretch, ratio),
        ("rope distortion", |m| m.rope_distortion, percent),
    ],
    &[
        ("jelly stretch", |m| m.jelly_stretch, ratio),
        ("jelly distortion", |m| m.jelly_distortion, percent),
    ],
];

impl Report {
    /// The tables for a terminal.
    pub fn tables(&self) -> String {
        let mut text = String::new();
        let mut add = |table: Table| _ = writeln!(text, "{table}");
        add(self.skills());
        for ahead in BY_KIND.into_iter().filter(|&ahead| ahead <= self.horizon) {
            add(self.skills_by_kind(ahead));
        }
        add(self.errors("position RMSE (domain lengths)", |e| &e.curves.position_rmse));
        add(self.errors("velocity RMSE (domain lengths/s)", |e| &e.curves.velocity_rmse));
        add(self.errors("MinMax MSE", |e| &e.curves.minmax_mse));
        add(self.errors("z-score MSE", |e| &e.curves.zscore_mse));
        add(self.steps());
        if self.predictors.iter().any(|entry| !entry.measures.is_empty()) {
            MEASURES.into_iter().for_each(|columns| add(self.measures(columns)));
            add(self.settled());
            add(self.flight());
        }
        if self.predictors.iter().any(|entry| entry.cost.is_some()) {
            add(self.costs());
        }
        for note in &self.notes {
            let _ = writeln!(text, "{note}");
        }
        text
    }

    /// A table with a column for each frame shown.
    fn over_frames(&self, title: &str, further: &[&str]) -> Table {
        let frames = self.shown.iter().map(|ahead| format!("frame {ahead}"));
        let further = further.iter().map(|&word| word.to_owned());
        table(std::iter::once(title.to_owned()).chain(frames).chain(further))
    }

    fn at_shown(&self, curve: &[f64], format: impl Fn(f64) -> String) -> Vec<String> {
        self.shown.iter().map(|&ahead| format(curve[ahead - 1])).collect()
    }

    fn skills(&self) -> Table {
        let title = format!("skill, mean of {} kinds", self.kinds.len());
        let mut table = self.over_frames(&title, &["blow-ups", "far off", "ms a frame"]);
        let compared = self.compared.iter().map(usize::to_string).collect();
        table.add_row(row("windows with truth".to_owned(), compared));
        let ms = |ms: Option<f64>| ms.map_or(String::new(), |ms| format!("{ms:.3}"));
        let skilled = |entry: &&Entry| !matches!(entry.role, Role::Mean | Role::Truth);
        for entry in self.predictors.iter().filter(skilled) {
            let mut row = row(entry.name.clone(), self.at_shown(&entry.skill, skill));
            row.extend(counts(&entry.blow_ups, self.windows));
            row.push(ms(entry.cost.as_ref().map(|cost| cost.p50)));
            table.add_row(row);
        }
        for group in &self.groups {
            let seeds = group.members.len();
            let GroupSkill { skill: mean, spread, skill_intervals } = &group.skill;
            if seeds > 1 {
                let mut cells = self.at_shown(mean, skill);
                cells.extend(counts(&group.blow_ups, seeds * self.windows));
                cells.push(ms(group.ms));
                table.add_row(row(format!("{}, mean of {seeds} seeds", group.name), cells));
                table.add_row(row(DEVIATION.into(), self.at_shown(spread, deviation)));
            }
            let intervals = (0..self.shown.len()).map(|at| interval(skill_intervals, at));
            table.add_row(row(of_interval(&group.name, seeds), intervals.collect()));
        }
        table
    }

    fn skills_by_kind(&self, ahead: usize) -> Table {
        let kinds = self.kinds.iter().map(|kind| kind.kind.name().to_owned());
        let title = format!("skill at frame {ahead}");
        let mut table = table(std::iter::once(title).chain(kinds).chain(["mean".to_owned()]));
        let Some(at) = self.shown.iter().position(|&shown| shown == ahead) else { return table };
        let compared = self.kinds.iter().map(|kind| kind.compared[at]);
        let compared = compared.chain([self.compared[at]]).map(|windows| windows.to_string());
        table.add_row(row("windows with truth".to_owned(), compared.collect()));
        let shown = self.predictors.iter();
        for entry in shown.filter(|e| !matches!(e.role, Role::Baseline | Role::Mean | Role::Truth))
        {
            let skills = entry.kinds.iter().map(|kind| skill(kind.skill[ahead - 1]));
            let all = skills.chain([skill(entry.skill[ahead - 1])]);
            table.add_row(row(entry.name.clone(), all.collect()));
        }
        for group in &self.groups {
            let seeds = group.members.len();
            let all = || group.kinds.iter().map(|(_, skill)| skill).chain([&group.skill]);
            if seeds > 1 {
                let means = all().map(|group| skill(group.skill[ahead - 1])).collect();
                table.add_row(row(format!("{}, mean of {seeds} seeds", group.name), means));
                let spreads = all().map(|group| deviation(group.spread[ahead - 1])).collect();
                table.add_row(row(DEVIATION.into(), spreads));
            }
            let intervals = all().map(|group| interval(&group.skill_intervals, at)).collect();
            table.add_row(row(of_interval(&group.name, seeds), intervals));
        }
        table
    }

    fn errors(&self, title: &str, curve: fn(&Entry) -> &Vec<f64>) -> Table {
        let mut table = self.over_frames(title, &[]);
        for entry in self.predictors.iter().filter(|entry| entry.role != Role::Truth) {
            table.add_row(row(entry.name.clone(), self.at_shown(curve(entry), scientific)));
        }
        table
    }

    fn steps(&self) -> Table {
        let mut table = self.over_frames("position RMSE by way of prediction", &[]);
        for entry in self.predictors.iter().filter(|entry| entry.role == Role::Model) {
            let Some(steps) = &entry.steps else { continue };
            for (way, curve) in [
                ("one step", &steps.one_step_rmse),
                ("steps added up", &steps.cumulated_rmse),
                ("free", &entry.curves.position_rmse),
            ] {
                let name = format!("{}, {way}", entry.name);
                table.add_row(row(name, self.at_shown(curve, scientific)));
            }
        }
        table
    }

    /// The frames ahead at which measures are shown: the last one there is, if the horizon is sooner.
    fn measured(&self) -> Vec<usize> {
        let measured = MEASURED.into_iter().filter(|ahead| self.shown.contains(ahead));
        let measured: Vec<usize> = measured.collect();
        if measured.is_empty() {
            self.shown.last().copied().into_iter().collect()
        } else {
            measured
        }
    }

    /// A table of measures, each at several frames ahead.
    fn measures(&self, columns: &[Column]) -> Table {
        let frames = self.measured();
        let title = |name: &str| {
            let mut titles: Vec<String> = frames.iter().map(usize::to_string).collect();
            if let Some(first) = titles.first_mut() {
                *first = format!("{name}, {first}");
            }
            titles
        };
        let titles = columns.iter().flat_map(|(name, ..)| title(name));
        let mut table = table(std::iter::once("at frame".to_owned()).chain(titles));
        for entry in &self.predictors {
            let of = |&(_, measure, format): &Column| {
                let at = |ahead: &usize| entry.measures.iter().find(|m| m.frame == *ahead);
                let cell = |ahead| at(ahead).map_or("-".to_owned(), |m| format(measure(m)));
                frames.iter().map(cell).collect::<Vec<String>>()
            };
            table.add_row(row(entry.name.clone(), columns.iter().flat_map(of).collect()));
        }
        table
    }

    /// How far particles get in windows in which the truth has settled.
    fn settled(&self) -> Table {
        let frames = self.measured();
        let titles = frames.iter().map(|ahead| format!("frame {ahead}"));
        let title = "way in settled windows (domain lengths)".to_owned();
        let mut table = table(std::iter::once(title).chain(titles));
        let at = |entry: &Entry, cell: fn(&Measures) -> String| {
            let shown = entry.measures.iter().filter(|m| frames.contains(&m.frame));
            shown.map(cell).collect()
        };
        if let Some(first) = self.predictors.first() {
            let windows = at(first, |m| m.settled_windows.to_string());
            table.add_row(row("settled windows".to_owned(), windows));
        }
        for entry in &self.predictors {
            table.add_row(row(entry.name.clone(), at(entry, |m| scientific(m.settled_way))));
        }
        table
    }

    /// What happens to bodies in free flight.
    fn flight(&self) -> Table {
        let titles =
            ["bodies in free flight", "gain of a frame, g dt", "at most", "rad/s", "bodies"];
        let mut table = table(titles.map(str::to_owned));
        for entry in &self.predictors {
            let Some(flight) = entry.flight else { continue };
            let numbers = [flight.gain, flight.worst_gain, flight.spin].map(scientific);
            let cells = numbers.into_iter().chain([flight.bodies.to_string()]).collect();
            table.add_row(row(entry.name.clone(), cells));
        }
        table
    }

    /// Time of a frame by the kind of the scene.
    fn costs(&self) -> Table {
        let kinds = self.kinds.iter().map(|kind| kind.kind.name().to_owned());
        let title = "ms a frame on one thread, median".to_owned();
        let mut table = table(std::iter::once(title).chain(kinds).chain(["mean".to_owned()]));
        for entry in &self.predictors {
            let Some(cost) = &entry.cost else { continue };
            let of = |kind| cost.kinds.iter().find(|cost| cost.kind == kind);
            let ms = |cost: &KindCost| format!("{:.3}", cost.p50);
            let kinds = self.kinds.iter().map(|kind| of(kind.kind).map_or("-".to_owned(), ms));
            let all = kinds.chain([format!("{:.3}", cost.p50)]);
            table.add_row(row(entry.name.clone(), all.collect()));
        }
        table
    }
}

/// The row below the mean of seeds.
const DEVIATION: &str = "  standard deviation";

/// How many of so many rollouts blew up, and how many ended far off.
fn counts(blow_ups: &BlowUps, windows: usize) -> [String; 2] {
    [blow_ups.any, blow_ups.far_off].map(|count| format!("{count} of {windows}"))
}

/// The name of the row of a group's intervals.
fn of_interval(group: &str, seeds: usize) -> String {
    match seeds {
        1 => format!("{group}: 95 % over scenes"),
        _ => "  95 % over scenes".to_owned(),
    }
}

/// The interval number `at` in words; nothing where there are none.
fn interval(intervals: &Option<Vec<Interval>>, at: usize) -> String {
    let found = intervals.as_ref().and_then(|all| all.get(at));
    found.map_or("-".to_owned(), |Interval { lower, upper }| {
        shown(lower + upper, |_| format!("{lower:.2} to {upper:.2}"))
    })
}

fn deviation(number: f64) -> String {
    shown(number, |x| format!("{x:.2}"))
}

/// A page's table for a terminal.
pub(super) fn of_page(of: &crate::page::Table) -> Table {
    let [_, titles @ ..] = of.header() else { return Table::new() };
    let mut table = table(std::iter::once(of.caption().to_owned()).chain(titles.iter().cloned()));
    table.add_rows(of.rows());
    table
}

fn table(header: impl IntoIterator<Item = String>) -> Table {
    let mut table = Table::new();
    table.load_style(UTF8_BORDERS_ONLY);
    table.set_header(header);
    table
}

fn row(name: String, cells: Vec<String>) -> Vec<String> {
    std::iter::once(name).chain(cells).collect()
}

/// A number in words that fit; nothing where there is none.
fn shown(number: f64, format: impl Fn(f64) -> String) -> String {
    if number.is_nan() { "-".to_owned() } else { format(number) }
}

fn skill(number: f64) -> String {
    shown(number, |x| format!("{x:+.2}"))
}

fn scientific(number: f64) -> String {
    shown(number, |x| format!("{x:.2e}"))
}

fn percent(number: f64) -> String {
    shown(number, |x| format!("{:.1} %", 100.0 * x))
}

fn ratio(number: f64) -> String {
    shown(number, |x| format!("{x:.3}"))
}
