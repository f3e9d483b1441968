//! Time of a frame.

use super::{Report, Role, at, milliseconds};
use crate::{
    KindCost,
    page::{Axis, LinePlot, Section, Series, Table},
};

/// The frame ahead at which errors are compared.
const AHEAD: usize = 20;

impl Report {
    pub(super) fn cost(&self, section: &mut Section) {
        section.paragraph(
            "Median time of a predicted frame on one thread, measured here, one scene of each kind; \
             models, trivial predictors and solvers alike. A solver's row says what the surrogate is measured by.",
        );
        let kinds = self.kinds.iter().map(|kind| kind.kind.name().to_owned());
        let titles = std::iter::once(String::new()).chain(kinds);
        let titles = titles.chain(["mean".to_owned(), "99th percentile".to_owned()]);
        let mut table = Table::new("ms a frame", titles);
        for entry in &self.predictors {
            let Some(cost) = &entry.cost else { continue };
            let of = |kind| cost.kinds.iter().find(|cost| cost.kind == kind);
            let ms = |cost: &KindCost| milliseconds(cost.p50);
            let kinds = self.kinds.iter().map(|kind| of(kind.kind).map_or("-".to_owned(), ms));
            let all = kinds.chain([cost.p50, cost.p99].map(milliseconds));
            table.row(entry.name.as_str(), all);
        }
        section.table(&table);
        let ahead = AHEAD.min(self.horizon);
        let series = self.predictors.iter().map(|entry| {
            let shown = !matches!(entry.role, Role::Baseline | Role::Truth);
            let cost = entry.cost.as_ref().filter(|_| shown);
            let point = cost.map(|cost| [cost.p50, 1.0 - at(&entry.skill, ahead)]);
            Series {
                name: entry.name.clone(),
                points: point.into_iter().collect(),
                scattered: true,
                ..Series::default()
            }
        });
        section.plots(&[LinePlot {
            title: format!("Error at frame {ahead} over the time of a frame"),
            x: Axis::logarithmic("ms a frame on one thread"),
            y: Axis::logarithmic("1 - skill"),
            series: series.collect(),
        }]);
    }
}
