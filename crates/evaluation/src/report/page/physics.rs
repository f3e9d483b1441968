//! Density, kinetic energy, centre of mass, share outside the walls.

use super::{
    super::{curves::BulkCurves, measures::Measures},
    Entry, Report, error, error_axis, frames_ahead, percent, ratio,
};
use eddy_pages::{Axis, LinePlot, Section, Series, Table};

/// A measure: name with unit, accessor, format.
type Column = (&'static str, fn(&Measures) -> f64, fn(f64) -> String);

/// A curve of a bulk quantity.
type Curve = fn(&BulkCurves) -> &Vec<f64>;

/// Measures of all scenes.
const COMMON: [Column; 4] = [
    ("misplaced mass", |m| m.misplaced, percent),
    ("kinetic energy, |K - K'| / K'", |m| m.kinetic_energy_error, percent),
    ("centre of mass, RMSE (domain lengths)", |m| m.centre_rmse, error),
    ("particles outside the walls", |m| m.outside, percent),
];

/// Measures of single materials and of settled rollouts.
const SPECIAL: [Column; 7] = [
    ("liquid: area / true area", |m| m.liquid_area, ratio),
    ("liquid: RMS deviation of that ratio from 1", |m| m.liquid_area_off, percent),
    ("rope: neighbour distance / rest distance", |m| m.rope_stretch, ratio),
    ("rope: RMS deviation of that ratio from 1", |m| m.rope_distortion, percent),
    ("jelly: neighbour distance / rest distance", |m| m.jelly_stretch, ratio),
    ("jelly: RMS deviation of that ratio from 1", |m| m.jelly_distortion, percent),
    ("settled rollouts: RMS displacement (domain lengths)", |m| m.settled_way, error),
];

impl Report {
    pub(super) fn physics(&self, section: &mut Section) {
        section.paragraph(
            "Density: the share of the mass that is misplaced relative to the truth, on a lattice with cells of four \
             particle spacings. Outside: beyond an effective wall by more than half a spacing. Energies are per mass; \
             the truth is included for comparison.",
        );
        let measured = |entry: &Entry, of: fn(&Measures) -> f64| -> Vec<[f64; 2]> {
            let drawn = entry.measures.iter().filter(|m| m.frame <= self.drawn_frames());
            drawn.map(|m| [m.frame as f64, of(m)]).collect()
        };
        let density = self.fallible().map(|entry| Series {
            name: entry.name.clone(),
            points: measured(entry, |m| m.misplaced),
            ..Series::default()
        });
        let mut plots = vec![LinePlot {
            title: "Density: misplaced mass".into(),
            x: frames_ahead(),
            y: Axis::linear("share of the mass"),
            series: density.collect(),
        }];
        let curves: [(&str, Axis, Curve); 3] = [
            ("Kinetic energy per mass", Axis::linear("K (lengths²/s²)"), |b| &b.kinetic_energy),
            ("Centre of mass", error_axis("RMSE (domain lengths)"), |b| &b.centre_rmse),
            ("Outside the walls", Axis::linear("share of the particles"), |b| &b.outside),
        ];
        for (title, y, of) in curves {
            // The truth is last, so that predictors keep their styles.
            let series = self.predictors.iter().map(|entry| {
                let curve = entry.bulk.as_ref().map_or(&[][..], |bulk| of(bulk));
                Series::ahead(&entry.name, self.drawn(curve))
            });
            plots.push(LinePlot {
                title: title.into(),
                x: frames_ahead(),
                y,
                series: series.collect(),
            });
        }
        section.plots(&plots);
        let (common, special) = self.measure_tables_by_scope();
        common.iter().for_each(|table| _ = section.table(table));
        section.folded("Liquid, rope and jelly; settled rollouts; free flight", |inner| {
            special.iter().for_each(|table| _ = inner.table(table));
            inner.table(&self.flight_table());
        });
    }

    /// Tables of all measures that have values.
    pub(in super::super) fn measure_tables(&self) -> Vec<Table> {
        let (common, special) = self.measure_tables_by_scope();
        [common, special].concat()
    }

    fn measure_tables_by_scope(&self) -> (Vec<Table>, Vec<Table>) {
        let has_values = |&(_, of, _): &Column| {
            let measures = self.predictors.iter().flat_map(|entry| &entry.measures);
            measures.into_iter().any(|measures| !of(measures).is_nan())
        };
        let special = SPECIAL.into_iter().filter(has_values);
        (
            COMMON.map(|column| self.measure(column)).into(),
            special.map(|c| self.measure(c)).collect(),
        )
    }

    fn measure(&self, (name, of, format): Column) -> Table {
        let mut table = self.frame_table(name, &[]);
        for entry in self.predictors.iter().filter(|entry| !entry.measures.is_empty()) {
            let cells = entry.measures.iter().map(|measures| format(of(measures)));
            table.row(entry.name.as_str(), cells);
        }
        table
    }

    pub(in super::super) fn flight_table(&self) -> Table {
        let mut table = Table::new(
            "Bodies in free flight: errors of one-step predictions",
            ["", "momentum gained (g dt)", "maximum", "spin (rad/s)", "bodies"],
        );
        for entry in &self.predictors {
            let Some(flight) = entry.flight else { continue };
            let numbers = [flight.gain, flight.worst_gain, flight.spin].map(error);
            table.row(entry.name.as_str(), numbers.into_iter().chain([flight.bodies.to_string()]));
        }
        table
    }
}
