//! The report's tables for a terminal.

use comfy_table::{CellAlignment, Table as TerminalTable, presets::UTF8_BORDERS_ONLY};

use super::{
    Report,
    page::{at, milliseconds, skill},
};
use crate::page::Table;

impl Report {
    /// The skill of all predictors, their blow-ups and the remarks: what fits a terminal of 80 columns.
    pub fn first_table(&self) -> String {
        let mut table = TerminalTable::new();
        table.load_style(UTF8_BORDERS_ONLY);
        let time = self.has_costs().then(|| "ms a frame".to_owned());
        let frames = self.shown.iter().map(usize::to_string);
        table.set_header(std::iter::once("frames ahead".to_owned()).chain(frames).chain(time));
        if self.compared.iter().any(|&rollouts| rollouts < self.windows) {
            let rollouts = self.compared.iter().map(usize::to_string);
            table.add_row(std::iter::once("rollouts with truth".to_owned()).chain(rollouts));
        }
        for entry in self.skilled() {
            let skills = self.shown.iter().map(|&ahead| skill(at(&entry.skill, ahead)));
            let cost = entry.cost.as_ref().map_or("-".to_owned(), |cost| milliseconds(cost.p50));
            let cost = self.has_costs().then_some(cost);
            table.add_row(std::iter::once(entry.name.clone()).chain(skills).chain(cost));
        }
        for column in table.column_iter_mut().skip(1) {
            column.set_cell_alignment(CellAlignment::Right);
        }
        let kinds = match self.kinds.len() {
            0 | 1 => String::new(),
            kinds => format!(", mean of {kinds} kinds of scenes"),
        };
        let mut text =
            format!("skill (1 is perfect, 0 as good as the best baseline){kinds}\n{table}\n");
        if self.has_seeds() {
            let seeds = self.seed_table().map(|table| format!("{}\n", terminal(&table)));
            text.extend(seeds);
        }
        for entry in self.skilled().filter(|entry| entry.blow_ups.any > 0) {
            let (count, all) = (entry.blow_ups.any, self.windows);
            text.push_str(&format!("blow-ups: {count} of {all} rollouts of {}\n", entry.name));
        }
        text.extend(self.notes.iter().map(|note| format!("{note}\n")));
        text
    }

    /// All tables and remarks for a terminal.
    pub fn tables(&self) -> String {
        let mut tables = vec![self.skill_table()];
        tables.extend(self.seed_table());
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
