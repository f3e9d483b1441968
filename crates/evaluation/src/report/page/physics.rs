//! Density, kinetic energy, centre of mass, what is outside.

use super::{
    super::{curves::BulkCurves, measures::Measures},
    Entry, Report, error, frames_ahead, of_errors, percent, shown,
};
use crate::page::{Axis, LinePlot, Section, Series, Table};

/// How a measure is shown: its name with its unit, which it is, in what form.
type Column = (&'static str, fn(&Measures) -> f64, fn(f64) -> String);

/// A curve of what all particles have together.
type Curve = fn(&BulkCurves) -> &Vec<f64>;

/// Measures of every scene.
const COMMON: [Column; 4] = [
    ("mass in another place than in the truth", |m| m.misplaced, percent),
    ("kinetic energy, |K - K'| / K'", |m| m.kinetic_energy_error, percent),
    ("centre of mass, RMSE (domain lengths)", |m| m.centre_rmse, error),
    ("particles outside the walls", |m| m.outside, percent),
];

/// Measures of some materials.
const OF_MATERIALS: [Column; 6] = [
    ("area of liquid over the true one", |m| m.liquid_area, ratio),
    ("area of liquid, RMS off 1", |m| m.liquid_area_off, percent),
    ("rope: distance of rest neighbours over that at rest", |m| m.rope_stretch, ratio),
    ("rope: RMS off 1", |m| m.rope_distortion, percent),
    ("jelly: distance of rest neighbours over that at rest", |m| m.jelly_stretch, ratio),
    ("jelly: RMS off 1", |m| m.jelly_distortion, percent),
];

impl Report {
    pub(super) fn physics(&self, section: &mut Section) {
        section.paragraph(
            "Density: the share of the mass that lies elsewhere than in the truth, on a lattice of four particle \
             spacings. Outside: beyond a wall in effect by more than half a spacing. The truth is there for \
             comparison; the energies are per mass.",
        );
        let measured = |entry: &Entry, of: fn(&Measures) -> f64| -> Vec<[f64; 2]> {
            entry.measures.iter().map(|m| [m.frame as f64, of(m)]).collect()
        };
        let density = self.fallible().map(|entry| Series {
            name: entry.name.clone(),
            points: measured(entry, |m| m.misplaced),
            ..Series::default()
        });
        let mut plots = vec![LinePlot {
            title: "Density: mass in another place than in the truth".into(),
            x: frames_ahead(),
            y: Axis::linear("share of the mass"),
            series: density.collect(),
        }];
        let curves: [(&str, Axis, Curve); 3] = [
            ("Kinetic energy per mass", Axis::linear("K (lengths²/s²)"), |b| &b.kinetic_energy),
            ("Centre of mass", of_errors("RMSE (domain lengths)"), |b| &b.centre_rmse),
            ("Outside the walls", Axis::linear("share of the particles"), |b| &b.outside),
        ];
        for (title, y, of) in curves {
            // The truth comes last: everyone keeps the style of the other plots.
            let series = self.predictors.iter().map(|entry| {
                let curve = entry.bulk.as_ref().map_or(&[][..], |bulk| of(bulk));
                Series::ahead(&entry.name, curve)
            });
            plots.push(LinePlot {
                title: title.into(),
                x: frames_ahead(),
                y,
                series: series.collect(),
            });
        }
        section.plots(&plots);
        for column in COMMON {
            section.table(&self.measure(column));
        }
        section.folded("What liquid, rope and jelly keep; settled scenes; free flight", |inner| {
            for column in OF_MATERIALS {
                let of = column.1;
                let is_there = |entry: &Entry| entry.measures.iter().any(|m| !of(m).is_nan());
                if self.predictors.iter().any(is_there) {
                    inner.table(&self.measure(column));
                }
            }
            let settled: Column = (
                "way of the particles in settled rollouts, RMS (domain lengths)",
                |m| m.settled_way,
                error,
            );
            inner.table(&self.measure(settled)).table(&self.flight_table());
        });
    }

    fn measure(&self, (name, of, format): Column) -> Table {
        let mut table = self.frame_table(name, &[]);
        for entry in self.predictors.iter().filter(|entry| !entry.measures.is_empty()) {
            let cells = entry.measures.iter().map(|measures| format(of(measures)));
            table.row(entry.name.as_str(), cells);
        }
        table
    }

    fn flight_table(&self) -> Table {
        let mut table = Table::new(
            "Bodies in free flight: what a predicted frame does to them",
            ["", "momentum gained (g dt)", "at most", "spin (rad/s)", "bodies"],
        );
        for entry in &self.predictors {
            let Some(flight) = entry.flight else { continue };
            let numbers = [flight.gain, flight.worst_gain, flight.spin].map(error);
            table.row(entry.name.as_str(), numbers.into_iter().chain([flight.bodies.to_string()]));
        }
        table
    }
}

fn ratio(number: f64) -> String {
    shown(number, |x| format!("{x:.3}"))
}
