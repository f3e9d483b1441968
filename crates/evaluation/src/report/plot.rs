//! The cost-error plot: how wrong a predictor is for what a frame of it costs.

use super::{Report, Role};
use crate::picture::{Canvas, Mark, Scatter, ScatterPoint};

/// The frame ahead at which errors are compared.
const AHEAD: usize = 20;

impl Report {
    /// 1 - skill at frame 20 (at the horizon, if that comes sooner) over the time of a frame, both on
    /// logarithmic axes; nothing where no cost was measured.
    pub(super) fn plot(&self) -> Option<Canvas> {
        let ahead = AHEAD.min(self.horizon);
        let shown = self
            .predictors
            .iter()
            .filter(|entry| !matches!(entry.role, Role::Baseline | Role::Mean));
        let points: Vec<ScatterPoint> = shown
            .filter_map(|entry| {
                let mark = match entry.role {
                    Role::Model => Mark::Disc(0),
                    Role::JoinedLate => Mark::Disc(1),
                    Role::Solver => Mark::Square(2),
                    _ => Mark::Square(3),
                };
                let place = [entry.cost.as_ref()?.p50, 1.0 - entry.skill[ahead - 1]];
                Some(ScatterPoint { name: entry.name.clone(), place, mark })
            })
            .collect();
        let scatter = Scatter {
            title: format!("cost and error, {} streams, {} rollouts", self.streams, self.windows),
            x: "ms a frame on one thread (median of a kind, mean of kinds)".to_owned(),
            y: format!("1 - skill at frame {ahead} (squared error / best baseline)"),
            points,
        };
        scatter.draw()
    }
}
