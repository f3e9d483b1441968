//! The report for a terminal.

use std::fmt::Write as _;

use comfy_table::{Table, presets::UTF8_BORDERS_ONLY};

use super::{Entry, Report, Role, measures::Measures};
use crate::eval::Interval;

/// The frames ahead at which kinds are shown side by side.
const BY_KIND: [usize; 3] = [1, 20, 100];
/// The frame ahead at which measures are shown, and those at which the area of liquids is.
const MEASURED: usize = 20;
const AREAS: [usize; 3] = [20, 50, 100];

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
        add(self.steps());
        if self.predictors.iter().any(|entry| !entry.measures.is_empty()) {
            let ahead = MEASURED.min(self.shown.last().copied().unwrap_or(1));
            self.measures(ahead).into_iter().for_each(add);
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
        let mut table = self.over_frames(&title, &["blow-ups", "ms a frame"]);
        for entry in self.predictors.iter().filter(|entry| entry.role != Role::Truth) {
            let mut row = vec![entry.name.clone()];
            row.extend(self.at_shown(&entry.skill, skill));
            row.push(format!("{} of {}", entry.blown_up_windows, self.windows));
            row.push(entry.cost.map_or(String::new(), |cost| format!("{:.3}", cost.p50)));
            table.add_row(row);
        }
        for group in &self.groups {
            let seeds = group.members.len();
            if seeds > 1 {
                let name = format!("{}, mean of {seeds} seeds", group.name);
                table.add_row(row(name, self.at_shown(&group.skill, skill)));
                let spread = self.at_shown(&group.spread, |x| format!("{x:.2}"));
                table.add_row(row("  standard deviation".into(), spread));
            }
            let name = match seeds {
                1 => format!("{}: 95 % over scenes", group.name),
                _ => "  95 % over scenes".to_owned(),
            };
            let ends = group.skill_intervals.iter();
            let ends = ends.map(|Interval { lower, upper }| format!("{lower:.2} to {upper:.2}"));
            table.add_row(row(name, ends.collect()));
        }
        table
    }

    fn skills_by_kind(&self, ahead: usize) -> Table {
        let kinds = self.kinds.iter().map(|kind| kind.kind.name().to_owned());
        let title = format!("skill at frame {ahead}");
        let mut table = table(std::iter::once(title).chain(kinds).chain(["mean".to_owned()]));
        let shown = self.predictors.iter();
        for entry in shown.filter(|e| !matches!(e.role, Role::Baseline | Role::Truth)) {
            let skills = entry.kinds.iter().map(|kind| skill(kind.skill[ahead - 1]));
            let all = skills.chain([skill(entry.skill[ahead - 1])]);
            table.add_row(row(entry.name.clone(), all.collect()));
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

    /// Bulk at frame `ahead` with the free flight of next frames, then shapes.
    fn measures(&self, ahead: usize) -> [Table; 2] {
        let mut bulk = table(
            [
                &format!("frame {ahead}"),
                "mass elsewhere",
                "kinetic energy",
                "centre",
                "outside",
                "in flight, g dt",
                "at most",
                "rad/s",
                "bodies",
            ]
            .map(str::to_owned),
        );
        let areas = AREAS.into_iter().filter(|ahead| self.shown.contains(ahead));
        let areas: Vec<usize> = areas.collect();
        let area_titles = areas.iter().map(|ahead| format!("liquid area, {ahead}"));
        let mut shapes = table(
            std::iter::once(format!("frame {ahead}")).chain(area_titles).chain(
                ["rope stretch", "rope distortion", "jelly stretch", "jelly distortion"]
                    .map(str::to_owned),
            ),
        );
        for entry in &self.predictors {
            let at = |ahead: usize| entry.measures.iter().find(|m| m.frame == ahead);
            let Some(measures) = at(ahead) else { continue };
            let Measures { misplaced, kinetic_energy_error, centre_rmse, outside, .. } = measures;
            let flight = entry.flight.map_or([(); 4].map(|()| "-".to_owned()), |flight| {
                let [gain, most, spin] =
                    [flight.gain, flight.worst_gain, flight.spin].map(scientific);
                [gain, most, spin, flight.bodies.to_string()]
            });
            bulk.add_row(row(
                entry.name.clone(),
                [
                    percent(*misplaced),
                    percent(*kinetic_energy_error),
                    scientific(*centre_rmse),
                    percent(*outside),
                ]
                .into_iter()
                .chain(flight)
                .collect(),
            ));
            let areas = areas.iter().filter_map(|&ahead| at(ahead)).map(|m| ratio(m.liquid_area));
            let solids = [
                ratio(measures.rope_stretch),
                percent(measures.rope_distortion),
                ratio(measures.jelly_stretch),
                percent(measures.jelly_distortion),
            ];
            shapes.add_row(row(entry.name.clone(), areas.chain(solids).collect()));
        }
        [bulk, shapes]
    }
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
