//! `eddy eval --compare`: reports side by side.

use std::path::PathBuf;

use anyhow::Context;

use crate::cli::EvalArgs;
use eddy_cli::{Output, OutputKind, terminal};
use eddy_evaluation::{Comparison, Report, short_names};
use eddy_pages::Provenance;

/// Prints a comparison of reports, and writes it to `output` as HTML.
pub(super) fn run(args: &EvalArgs) -> anyhow::Result<()> {
    let paths = &args.compare;
    let room = |output: &PathBuf| Output::at(output, OutputKind::Page, args.force, &[]);
    let room = args.output.as_ref().map(room).transpose()?;
    let reports = paths.iter().map(|path| Report::load(path)).collect::<Result<Vec<_>, _>>()?;
    let comparison = Comparison::new(names(paths).into_iter().zip(reports).collect())?;
    let columns = terminal::columns();
    let tables = match args.tables {
        true => comparison.tables(columns),
        false => comparison.first_table(columns),
    };
    print!("{tables}");
    if let Some(output) = &args.output {
        let page = comparison.page(&Provenance::here());
        page.save(output).with_context(|| format!("cannot write {}", output.display()))?;
        println!("report: {}", output.display());
    }
    room.into_iter().for_each(Output::replaced);
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
