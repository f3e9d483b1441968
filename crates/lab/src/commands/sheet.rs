//! What a benchmark has to say: in a terminal, as JSON, as a page.

use std::path::Path;

use anyhow::Context;
use comfy_table::{CellAlignment, Table as Printed, presets};
use serde::Serialize;

use eddy_evaluation::page::{LinePlot, Page, Provenance, Table};

/// Tables of this machine, with plots where a curve is natural.
pub(super) struct Sheet {
    /// What was measured.
    pub(super) title: &'static str,
    /// Tables, in their order.
    pub(super) tables: Vec<Table>,
    /// Curves, for the page only.
    pub(super) plots: Vec<LinePlot>,
    /// What the numbers are, one sentence each.
    pub(super) notes: Vec<String>,
}

impl Sheet {
    /// Prints `json` if that is wanted, the tables otherwise, and writes the page if `html` says where.
    pub(super) fn show(
        &self,
        report: &impl Serialize,
        json: bool,
        html: Option<&Path>,
    ) -> anyhow::Result<()> {
        if json {
            println!("{}", serde_json::to_string_pretty(report)?);
        } else {
            let tables: Vec<String> = self.tables.iter().map(printed).collect();
            println!("{}\n\n{}", tables.join("\n\n"), self.notes.join("\n"));
        }
        let Some(html) = html else { return Ok(()) };
        let page = self.page(&Provenance::here());
        page.save(html).with_context(|| format!("cannot write {}", html.display()))
    }

    fn page(&self, made: &Provenance) -> Page {
        let mut page = Page::new(self.title, "Measured on the machine that is named below.");
        let section = page.section("Measured");
        section.plots(&self.plots);
        self.tables.iter().for_each(|table| _ = section.table(table));
        self.notes.iter().for_each(|note| _ = section.paragraph(note));
        page.section("How to make this again").provenance(made);
        page
    }
}

/// A table without lines.
pub(crate) fn printed(of: &Table) -> String {
    let mut table = Printed::new();
    table.load_style(presets::NOTHING);
    table.set_header(of.header());
    table.add_rows(of.rows());
    for column in table.column_iter_mut() {
        column.set_cell_alignment(CellAlignment::Right);
    }
    table.trim_fmt()
}

/// The rows of a table, each with its name first.
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
