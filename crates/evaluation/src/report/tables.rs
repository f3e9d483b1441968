//! The report's tables for a terminal.

use super::{
    Report,
    page::{at, milliseconds},
};
use crate::skill_text;
use eddy_pages::Table;

impl Report {
    /// The skill of all predictors, their blow-ups and the remarks, in lines of at most `columns` characters.
    pub fn first_table(&self, columns: usize) -> String {
        let time = self.has_costs().then(|| "ms/frame".to_owned());
        let frames = self.shown.iter().map(usize::to_string);
        let titles = std::iter::once("frames ahead".to_owned()).chain(frames).chain(time);
        let kinds = match self.kinds.len() {
            0 | 1 => String::new(),
            kinds => format!(", mean of {kinds} kinds of scenes"),
        };
        let caption =
            format!("skill (1 is perfect, 0 as good as the best trivial predictor){kinds}");
        let mut table = Table::new(caption, titles);
        if self.compared.iter().any(|&rollouts| rollouts < self.windows) {
            table.row("rollouts with truth", self.compared.iter().map(usize::to_string));
        }
        for entry in self.skilled() {
            let skills = self.shown.iter().map(|&ahead| rounded(at(&entry.skill, ahead)));
            let cost = entry.cost.as_ref().map_or("-".to_owned(), |cost| milliseconds(cost.p50));
            let cost = self.has_costs().then_some(cost);
            table.row(entry.name.as_str(), skills.chain(cost));
        }
        let mut text = table.framed(columns) + "\n";
        if self.has_several_models() {
            let seeds = self.seed_table().map(|table| format!("{}\n", table.framed(columns)));
            text.extend(seeds);
        }
        for entry in self.skilled().filter(|entry| entry.blow_ups.any > 0) {
            let (count, all) = (entry.blow_ups.any, self.windows);
            text.push_str(&format!("blow-ups: {count} of {all} rollouts of {}\n", entry.name));
        }
        text.extend(self.notes.iter().map(|note| format!("{note}\n")));
        text
    }

    /// All tables and remarks, in lines of at most `columns` characters.
    pub fn tables(&self, columns: usize) -> String {
        let mut tables = vec![self.skill_table()];
        tables.extend(self.seed_table());
        tables.extend(self.skills_by_kind());
        tables.extend(self.error_tables());
        tables.push(self.step_table());
        if self.has_measures() {
            tables.extend(self.measure_tables());
            tables.push(self.flight_table());
        }
        if self.has_settled() {
            tables.extend(self.settled_tables());
        }
        if self.has_costs() {
            tables.push(self.cost_table());
        }
        if self.has_estimates() {
            tables.push(self.reliability_table());
        }
        let tables = tables.iter().map(|table| format!("{}\n", table.framed(columns)));
        tables.chain(self.notes.iter().map(|note| format!("{note}\n"))).collect()
    }
}

/// A skill for a table. Where a baseline is exact, as the ballistic one in free fall, others are worse by millions.
pub(super) fn rounded(skill: f64) -> String {
    match skill {
        _ if skill.is_nan() => "-".to_owned(),
        _ if skill < -99.0 => "< -99".to_owned(),
        _ => skill_text(skill),
    }
}
