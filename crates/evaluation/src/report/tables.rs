//! The report's tables for a terminal.

use comfy_table::{Table as TerminalTable, presets::UTF8_BORDERS_ONLY};

use super::Report;
use crate::page::Table;

impl Report {
    /// The tables and remarks for a terminal.
    pub fn tables(&self) -> String {
        let mut tables = vec![self.skill_table(), self.seed_table()];
        tables.extend(self.skills_by_kind());
        tables.extend(self.error_tables());
        tables.push(self.step_table());
        if self.has_measures() {
            tables.extend(self.measure_tables());
            tables.push(self.flight_table());
        }
        if self.has_costs() {
            tables.push(self.cost_table());
        }
        let tables = tables.iter().map(|table| format!("{}\n", terminal(table)));
        tables.chain(self.notes.iter().map(|note| format!("{note}\n"))).collect()
    }
}

/// A page's table for a terminal.
pub(super) fn terminal(table: &Table) -> TerminalTable {
    let mut printed = TerminalTable::new();
    printed.load_style(UTF8_BORDERS_ONLY);
    let titles = table.header().iter().skip(1).cloned();
    printed.set_header(std::iter::once(table.caption().to_owned()).chain(titles));
    printed.add_rows(table.rows());
    printed
}
