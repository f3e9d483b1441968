//! Results by kind of scene and by material.

use super::{Entry, Report, Role, at, between, error, skill};
use eddy_pages::{Section, Table};

/// The frames ahead at which kinds are shown side by side.
const BY_KIND: [usize; 3] = [1, 20, 100];

impl Report {
    pub(super) fn by_kind(&self, section: &mut Section) {
        self.skills_by_kind().iter().for_each(|table| _ = section.table(table));
        let last = BY_KIND.into_iter().rfind(|&ahead| ahead <= 20 && self.shown.contains(&ahead));
        if let Some(ahead) = last {
            section.table(&self.error_by_material(ahead));
        }
    }

    pub(in super::super) fn skills_by_kind(&self) -> Vec<Table> {
        let frames = BY_KIND.into_iter().filter(|ahead| self.shown.contains(ahead));
        frames.map(|ahead| self.skill_by_kind(ahead)).collect()
    }

    fn skill_by_kind(&self, ahead: usize) -> Table {
        let kinds = self.kinds.iter().map(|kind| kind.kind.name().to_owned());
        let titles = std::iter::once(String::new()).chain(kinds).chain(["mean".to_owned()]);
        let mut table = Table::new(format!("Skill at frame {ahead} by kind of scene"), titles);
        let place = self.shown.iter().position(|&shown| shown == ahead);
        let streams = self.kinds.iter().map(|kind| kind.streams).chain([self.streams]);
        table.fixed_row("streams", streams.map(|count| count.to_string()));
        for entry in self.skilled() {
            let skills = entry.kinds.iter().map(|kind| at(&kind.skill, ahead));
            let all = skills.chain([at(&entry.skill, ahead)]);
            table.row(entry.name.as_str(), all.map(skill));
            if let (Role::Model, Some(place)) = (entry.role, place) {
                let intervals = entry.kinds.iter().map(|kind| kind.skill_intervals.as_ref());
                let all = intervals.chain([entry.skill_intervals.as_ref()]);
                if all.clone().any(|intervals| intervals.is_some()) {
                    let all = all.map(|intervals| between(intervals, place));
                    table.detail_row("95 % interval over scenes", all);
                }
            }
        }
        table
    }

    fn error_by_material(&self, ahead: usize) -> Table {
        let of_first = |entry: &Entry| entry.materials.iter().map(|(m, _)| *m).collect::<Vec<_>>();
        let materials = self.predictors.first().map(of_first).unwrap_or_default();
        let names = materials.iter().map(|material| material.name());
        let titles = std::iter::once("").chain(names);
        let caption =
            format!("Position RMSE (domain lengths) at frame {ahead} by material of the particle");
        let mut table = Table::new(caption, titles);
        for entry in self.skilled() {
            let of = |material| entry.materials.iter().find(|(found, _)| found == material);
            let rmse =
                |(_, curves): &(_, super::super::curves::Curves)| at(&curves.position_rmse, ahead);
            let cells = materials.iter().map(|material| error(of(material).map_or(f64::NAN, rmse)));
            table.row(entry.name.as_str(), cells);
        }
        table
    }
}
