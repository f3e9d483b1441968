//! How well estimates of errors hold.

use super::{Entry, Report};
use crate::Reliability;
use eddy_inference::error_model::LEVELS;
use eddy_pages::{Axis, LinePlot, Section, Series, Table};

impl Report {
    pub(super) fn reliability(&self, section: &mut Section) {
        section.paragraph(
            "A calibrated model estimates the error of each of its predictions when it makes them. Left: the share of errors below \
             each estimated quantile. Right: the estimated probability that a ballistic prediction is better beside the share of \
             predictions for which it was; its walls are those that the checkpoint knows. Estimates that hold are on the diagonal. Those between calibrated numbers of frames are interpolated.",
        );
        let plots = self.estimating().flat_map(|entry| {
            let title = |what: &str| format!("{}: {what}", entry.name);
            let curve = |found: &Reliability| Series {
                name: format!("frame {}", found.horizon),
                points: coverage(found),
                ..Series::default()
            };
            let pooled = Reliability::pooled_bins(&entry.reliability);
            [
                LinePlot {
                    title: title("quantiles of the error"),
                    x: Axis::linear("level of the estimated quantile"),
                    y: Axis::linear("share of errors below it"),
                    series: entry.reliability.iter().map(curve).collect(),
                },
                LinePlot {
                    title: title("worse than ballistic"),
                    x: Axis::linear("estimated probability"),
                    y: Axis::linear("share of predictions"),
                    series: vec![Series {
                        name: "all frames ahead".to_owned(),
                        points: pooled.iter().map(|bin| [bin.estimated, bin.observed]).collect(),
                        ..Series::default()
                    }],
                },
            ]
        });
        section.plots(&plots.collect::<Vec<_>>()).table(&self.reliability_table());
    }

    fn estimating(&self) -> impl Iterator<Item = &Entry> {
        self.predictors.iter().filter(|entry| !entry.reliability.is_empty())
    }

    pub(in super::super) fn reliability_table(&self) -> Table {
        let all: Vec<&Entry> = self.estimating().collect();
        let name = |entry: &Entry| (all.len() > 1).then(|| entry.name.clone());
        Reliability::table(all.iter().map(|entry| (name(entry), &entry.reliability[..])))
    }
}

/// Level and share.
fn coverage(found: &Reliability) -> Vec<[f64; 2]> {
    let level = |(&level, &share): (&f32, &f64)| [level.into(), share];
    LEVELS.iter().zip(&found.coverage).map(level).collect()
}
