//! Errors over the frames ahead.

use super::{Entry, Report, Role, error, error_axis, frames_ahead};
use eddy_pages::{LinePlot, Section, Series, Table};

/// An error curve: name with unit, and accessor.
type Curve = (&'static str, fn(&Entry) -> &Vec<f64>);

const CURVES: [Curve; 4] = [
    ("position RMSE (domain lengths)", |entry| &entry.curves.position_rmse),
    ("velocity RMSE (domain lengths/s)", |entry| &entry.curves.velocity_rmse),
    ("MinMax MSE", |entry| &entry.curves.minmax_mse),
    ("z-score MSE", |entry| &entry.curves.zscore_mse),
];

impl Report {
    pub(super) fn error_curves(&self, section: &mut Section) {
        section.paragraph(
            "Free rollouts over all scenes. Normalised errors are errors of x, y, vx and vy, each divided by its range \
             (MinMax) or standard deviation (z-score) in the first checkpoint's training data.",
        );
        let plots = CURVES.map(|(title, of)| {
            let drawn = |entry: &Entry| Series::ahead(&entry.name, self.drawn(of(entry)));
            let series = self.fallible().map(drawn);
            let title = title.to_owned();
            LinePlot { y: error_axis(&title), title, x: frames_ahead(), series: series.collect() }
        });
        section.plots(&plots);
        self.error_tables().iter().for_each(|table| _ = section.table(table));
    }

    pub(in super::super) fn error_tables(&self) -> [Table; 4] {
        CURVES.map(|(title, of)| {
            let mut table = self.frame_table(title, &[]);
            for entry in self.fallible() {
                table.row(entry.name.as_str(), self.at_shown(of(entry), error));
            }
            table
        })
    }

    pub(super) fn step_errors(&self, section: &mut Section) {
        section.paragraph(
            "Position RMSE of three predictions of the same frames. One-step: from the true frame before. Accumulated: \
             the sum of the one-step errors since the start, as if teacher-forced steps were concatenated. Free rollout: \
             from the predictor's own output; all other sections use it.",
        );
        let models = self.predictors.iter().filter(|entry| entry.role == Role::Model);
        let plots: Vec<LinePlot> = models
            .filter(|entry| entry.steps.is_some())
            .map(|entry| LinePlot {
                title: entry.name.clone(),
                x: frames_ahead(),
                y: error_axis("position RMSE (domain lengths)"),
                series: step_curves(entry)
                    .map(|(name, curve)| Series::ahead(name, self.drawn(curve)))
                    .collect(),
            })
            .collect();
        section.plots(&plots).table(&self.step_table());
    }

    /// One-step, accumulated and free-rollout errors of all predictors that make one-step predictions.
    pub(in super::super) fn step_table(&self) -> Table {
        let mut table =
            self.frame_table("Position RMSE (domain lengths) by type of prediction", &[]);
        for entry in self.fallible().filter(|entry| entry.steps.is_some()) {
            for (name, curve) in step_curves(entry) {
                table.row(format!("{}, {name}", entry.name), self.at_shown(curve, error));
            }
        }
        table
    }
}

/// The position RMSE curves of a predictor by type of prediction.
fn step_curves(entry: &Entry) -> impl Iterator<Item = (&'static str, &Vec<f64>)> {
    let steps = entry.steps.iter().flat_map(|steps| {
        [("one-step", &steps.one_step_rmse), ("accumulated", &steps.cumulated_rmse)]
    });
    steps.chain([("free rollout", &entry.curves.position_rmse)])
}
