//! Errors over the frames ahead.

use super::{Entry, Report, Role, error, frames_ahead, of_errors};
use crate::page::{LinePlot, Section, Series, Table};

/// An error curve: its name with its unit, and which it is.
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
            "Free rollouts over all scenes. Normalised errors are those of x, y, vx and vy, each divided by its range \
             (MinMax) or by its standard deviation (z-score) in the training of the first checkpoint.",
        );
        let plots = CURVES.map(|(title, of)| {
            let series = self.fallible().map(|entry| Series::ahead(&entry.name, of(entry)));
            let title = title.to_owned();
            LinePlot { y: of_errors(&title), title, x: frames_ahead(), series: series.collect() }
        });
        section.plots(&plots);
        for (title, of) in CURVES {
            let mut table = self.frame_table(title, &[]);
            for entry in self.fallible() {
                table.row(entry.name.as_str(), self.words_at_shown(of(entry), error));
            }
            section.table(&table);
        }
    }

    /// One step, steps added up and free rollouts side by side.
    pub(super) fn ways(&self, section: &mut Section) {
        section.paragraph(
            "Position RMSE of three ways to predict the same frames. One step: from the true frame before. Steps \
             added up: those errors put end to end, as a running sum of teacher-forced predictions would have them. \
             Free: fed with its own output from the start on; this is what everything else here is about.",
        );
        let mut table = Table::new(
            "Position RMSE (domain lengths) by way of prediction",
            ["", "frame", "one step", "steps added up", "free rollout"],
        );
        let mut plots = Vec::new();
        for entry in self.predictors.iter().filter(|entry| entry.role != Role::Truth) {
            let Some(steps) = &entry.steps else { continue };
            let ways = [&steps.one_step_rmse, &steps.cumulated_rmse, &entry.curves.position_rmse];
            for (place, &ahead) in self.shown.iter().enumerate() {
                let name = if place == 0 { entry.name.as_str() } else { "" };
                let cells = ways.map(|curve| error(super::at(curve, ahead)));
                table.row(name, std::iter::once(ahead.to_string()).chain(cells));
            }
            if entry.role == Role::Model {
                let names = ["one step", "steps added up", "free rollout"];
                let series =
                    names.into_iter().zip(ways).map(|(name, curve)| Series::ahead(name, curve));
                plots.push(LinePlot {
                    title: entry.name.clone(),
                    x: frames_ahead(),
                    y: of_errors("position RMSE (domain lengths)"),
                    series: series.collect(),
                });
            }
        }
        section.plots(&plots).table(&table);
    }
}
