//! Time per frame.

use super::{Report, Role, at, milliseconds};
use crate::KindCost;
use eddy_pages::{Axis, LinePlot, Section, Series, Table};

/// The frame ahead at which errors are compared.
const AHEAD: usize = 20;

impl Report {
    pub(super) fn cost(&self, section: &mut Section) {
        section.paragraph(
            "Median time per predicted frame on one thread of this machine, on one scene of each kind. The rows of solvers \
             are the reference for the surrogate.",
        );
        section.table(&self.cost_table());
        section.plots(&[self.cost_plot()]);
    }

    pub(in super::super) fn cost_table(&self) -> Table {
        let kinds = self.kinds.iter().map(|kind| kind.kind.name().to_owned());
        let titles = std::iter::once(String::new()).chain(kinds);
        let titles = titles.chain(["mean".to_owned(), "99th percentile".to_owned()]);
        let mut table = Table::new("ms per frame", titles);
        for entry in &self.predictors {
            let Some(cost) = &entry.cost else { continue };
            let of = |kind| cost.kinds.iter().find(|cost| cost.kind == kind);
            let ms = |cost: &KindCost| milliseconds(cost.p50);
            let kinds = self.kinds.iter().map(|kind| of(kind.kind).map_or("-".to_owned(), ms));
            let all = kinds.chain([cost.p50, cost.p99].map(milliseconds));
            table.row(entry.name.as_str(), all);
        }
        table
    }

    /// 1 - skill at frame 20 (or at the horizon) over the time per frame.
    pub(in super::super) fn cost_plot(&self) -> LinePlot {
        let ahead = AHEAD.min(self.horizon);
        let series = self.predictors.iter().map(|entry| {
            let shown = !matches!(entry.role, Role::Baseline | Role::LinearFit | Role::Truth);
            let cost = entry.cost.as_ref().filter(|_| shown);
            let point = cost.map(|cost| [cost.p50, 1.0 - at(&entry.skill, ahead)]);
            Series {
                name: entry.name.clone(),
                points: point.into_iter().collect(),
                scattered: true,
                ..Series::default()
            }
        });
        LinePlot {
            title: format!("Error at frame {ahead} over time per frame"),
            x: Axis::logarithmic("ms per frame on one thread"),
            y: Axis::logarithmic("1 - skill"),
            series: series.collect(),
        }
    }
}
