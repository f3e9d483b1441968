//! Writes the report of a comparison: `report.html`, and `tables.md` for use in documents.

use std::path::{Path, PathBuf};

use anyhow::Context;

use super::{
    Comparison, Curve, Networks, Speed, StudyReport,
    command_lines::shown,
    run::{StudyOutcome, Work, write_settings},
};
use eddy_evaluation::Report;
use eddy_pages::Provenance;

/// Both files in the folder of a comparison; the page is written last.
pub(crate) fn files(folder: &Path) -> [PathBuf; 2] {
    ["tables.md", "report.html"].map(|name| folder.join(name))
}

/// Writes both files.
pub(super) fn write(work: &Work) -> anyhow::Result<StudyOutcome> {
    let folder = work.folders.report(work.comparison);
    let mut report = StudyReport::new(work.comparison, work.study);
    for set in &work.data_sets {
        let set = set.name.as_str();
        match work.comparison {
            Comparison::Activations => {
                report.curves(set, work.study, &curves(work, set)?);
            }
            comparison => {
                let trained = work.trained(set)?.into_iter().map(|(_, trained)| trained);
                let networks = Networks {
                    comparison,
                    variants: &work.variants,
                    seeds: &work.study.seeds,
                    trained: trained.collect(),
                    report: Report::load(&work.folders.evaluation(comparison, set))?,
                };
                report.networks(set, work.study, &networks);
            }
        }
    }
    if let Some(speed) =
        Speed::find(&folder, work.device, work.gpu_precision(), &work.study.step_frames)?
    {
        report.speed(&speed);
    }
    let summaries = report.summaries();
    let summaries = summaries.map(|(heading, table)| (heading.to_owned(), table.clone())).collect();
    let [tables, html] = files(&folder);
    write_settings(&tables, &report.markdown())?;
    let page = report.page(&Provenance::here(), &work.command_lines().all());
    page.save(&html).with_context(|| shown(&html))?;
    Ok(StudyOutcome { summaries, page: html })
}

/// The learning curves of a data set.
fn curves(work: &Work, set: &str) -> anyhow::Result<Vec<Curve>> {
    let mut curves = Vec::new();
    for &seed in &work.study.seeds {
        for activation in &work.study.activations {
            let file = work.folders.curve(set, activation.name(), seed);
            let curve = Curve::find(&file, &work.study.dense, work.device, work.gpu_precision())?;
            curves.push(
                curve.with_context(|| format!("{}: no learning curve found", file.display()))?,
            );
        }
    }
    Ok(curves)
}
