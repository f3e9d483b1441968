//! `eddy eval --compare`: reports side by side.

use std::path::{Path, PathBuf};

use anyhow::Context;

use eddy_evaluation::{Comparison, Report, page::Provenance, short_names};

/// Prints a comparison of reports, and writes it to `output` as HTML.
pub(super) fn run(paths: &[PathBuf], output: Option<&Path>) -> anyhow::Result<()> {
    let reports = paths.iter().map(|path| Report::load(path)).collect::<Result<Vec<_>, _>>()?;
    let comparison = Comparison::new(names(paths).into_iter().zip(reports).collect())?;
    println!("{}", comparison.tables());
    if let Some(output) = output {
        let page = comparison.page(&Provenance::here());
        page.save(output).with_context(|| format!("cannot write {}", output.display()))?;
        println!("{}", output.display());
    }
    Ok(())
}

/// Names of reports: their directories.
fn names(paths: &[PathBuf]) -> Vec<String> {
    let folder = |path: &PathBuf| {
        let folder = if path.is_dir() { Some(path.as_path()) } else { path.parent() };
        let folder = folder.filter(|folder| folder.file_name().is_some());
        folder.unwrap_or(path).display().to_string()
    };
    short_names(&paths.iter().map(folder).collect::<Vec<_>>())
}
