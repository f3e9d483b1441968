//! Output of benchmarks as tables, JSON or HTML.

use std::path::Path;

use anyhow::Context;
use serde::Serialize;

use eddy_pages::{LinePlot, Page, Provenance, Table};

/// Width of tables (characters): that of a terminal that nobody has widened, and of a log.
pub(super) const COLUMNS: usize = 80;

/// Results of a benchmark.
pub(super) struct BenchOutput {
    /// The command.
    pub(super) title: &'static str,
    /// Tables.
    pub(super) tables: Vec<Table>,
    /// Plots, for the page only.
    pub(super) plots: Vec<LinePlot>,
    /// Notes on the numbers, one sentence each.
    pub(super) notes: Vec<String>,
}

impl BenchOutput {
    /// Prints `report` as JSON if `json` is set, the tables otherwise, and writes the page to `html` if given.
    pub(super) fn show(
        &self,
        report: &impl Serialize,
        json: bool,
        html: Option<&Path>,
    ) -> anyhow::Result<()> {
        if json {
            println!("{}", serde_json::to_string_pretty(report)?);
        } else {
            let tables = self.tables.iter().map(|table| table.plain(COLUMNS));
            let tables: Vec<String> = tables.collect();
            println!("{}\n\n{}", tables.join("\n\n"), self.notes.join("\n"));
        }
        let Some(html) = html else { return Ok(()) };
        let page = self.page(&Provenance::here());
        page.save(html).with_context(|| format!("cannot write {}", html.display()))
    }

    fn page(&self, made: &Provenance) -> Page {
        let mut page = Page::new(self.title, "Measured on the machine below.");
        let section = page.section("Results");
        section.plots(&self.plots);
        self.tables.iter().for_each(|table| _ = section.table(table));
        self.notes.iter().for_each(|note| _ = section.paragraph(note));
        page.section("Reproduce").provenance(made);
        page
    }
}

/// A table from rows that start with their names.
pub(super) fn table<T: Into<String>>(
    caption: &str,
    header: impl IntoIterator<Item = T>,
    rows: impl IntoIterator<Item = Vec<String>>,
) -> Table {
    let mut table = Table::new(caption, header);
    for row in rows {
        let mut cells = row.into_iter();
        let name = cells.next().unwrap_or_default();
        table.row(name, cells);
    }
    table
}
