//! Who is how good, and what has to be said about it.

use super::{super::group::GroupSkill, Report, Role, between, frames_ahead, milliseconds, skill};
use crate::{
    BlowUps,
    page::{Axis, LinePlot, Section, Series, Table},
};

impl Report {
    pub(super) fn summary(&self, section: &mut Section) {
        section.paragraph(
            "Skill is 1 - squared position error / that of the best predictor that learns nothing, both summed over \
             the rollouts of a kind of scenes; what is shown is the mean over kinds. 1 is the truth, 0 no better than \
             persistence, constant velocity or ballistic flight, whichever is best at that frame.",
        );
        for note in &self.notes {
            section.note(note);
        }
        section.table(&self.skill_table()).plots(&[self.skill_plot()]);
        section.heading("Seeds and intervals").table(&self.seeds());
        section.paragraph(
            "Checkpoints that differ in nothing but their training are seeds of one model. Deviations are those of \
             the sample, between seeds. Intervals hold 95 % of 1,000 draws of the scenes with replacement (bootstrap, \
             percentiles), each seed on the same scenes; there is none when a kind has fewer than five scenes.",
        );
    }

    fn skill_table(&self) -> Table {
        let caption = format!("Skill, mean of {} kinds of scenes", self.kinds.len());
        let mut table = self.frame_table(&caption, &["blow-ups", "far off", "ms a frame"]);
        let compared = self.compared.iter().map(usize::to_string);
        table.row("rollouts with truth", compared);
        for entry in self.skilled() {
            let mut cells = self.words_at_shown(&entry.skill, skill);
            cells.extend(counts(&entry.blow_ups, self.windows));
            cells.push(entry.cost.as_ref().map_or("-".into(), |cost| milliseconds(cost.p50)));
            table.row(entry.name.as_str(), cells);
        }
        table
    }

    fn skill_plot(&self) -> LinePlot {
        let series = self.fallible().map(|entry| match entry.role {
            Role::Mean => Series::default(),
            _ => self.banded(&entry.name, &entry.skill, entry.skill_intervals.as_ref()),
        });
        // Below -1 the difference between wrong and more wrong would hide all others. The training's mean
        // keeps its place: styles are the same in every plot.
        let series = series.map(|mut series| {
            series.points.iter_mut().filter(|[_, y]| *y < -1.0).for_each(|[_, y]| *y = f64::NAN);
            series.band.retain(|[_, low, _]| *low >= -1.0);
            series
        });
        LinePlot {
            title: "Skill with 95 % intervals over scenes, from -1 on".into(),
            x: frames_ahead(),
            y: Axis::linear("skill"),
            series: series.collect(),
        }
    }

    fn seeds(&self) -> Table {
        let mut table = self.frame_table("Models by seeds", &["seeds"]);
        for group in &self.groups {
            let GroupSkill { skill: mean, spread, skill_intervals } = &group.skill;
            let mut cells = self.words_at_shown(mean, skill);
            cells.push(group.members.len().to_string());
            table.row(format!("{}: mean skill", group.name), cells);
            if group.members.len() > 1 {
                table.row(
                    "deviation between seeds",
                    self.words_at_shown(spread, |x| format!("{x:.3}")),
                );
            }
            let intervals = (0..self.shown.len()).map(|at| between(skill_intervals.as_ref(), at));
            table.row("95 % over scenes", intervals);
        }
        table
    }
}

/// How many of so many rollouts blew up, and how many ended far off.
fn counts(blow_ups: &BlowUps, windows: usize) -> [String; 2] {
    [blow_ups.any, blow_ups.far_off].map(|count| format!("{count} of {windows}"))
}
