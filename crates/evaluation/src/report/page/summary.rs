//! Skill, seeds and remarks.

use super::{
    super::group::{Gain, GroupSkill},
    Report, Role, between, frames_ahead, milliseconds, skill,
};
use crate::BlowUps;
use eddy_frames::counted;
use eddy_pages::{Axis, LinePlot, Section, Series, Table};

impl Report {
    pub(super) fn summary(&self, section: &mut Section) {
        section.paragraph(
            "Skill is 1 - squared position error / squared position error of the best trivial predictor (persistence, constant \
             velocity or ballistic flight), both summed over the rollouts of a kind of scenes, averaged over kinds. A \
             skill of 1 is a perfect prediction, 0 is no better than the best trivial predictor at that frame.",
        );
        for note in &self.notes {
            section.note(note);
        }
        if let Some(note) = self.curves_note() {
            section.note(&note);
        }
        section.table(&self.skill_table()).plots(&[self.skill_plot()]);
        let Some(table) = self.seed_table() else { return };
        section.heading("Seeds and intervals").table(&table);
        section.paragraph(
            "Checkpoints of one network from trainings on the same data with different seeds are seeds of one model. \
             Deviations are sample standard deviations over seeds. Intervals are 95 % percentile bootstrap intervals: \
             1,000 resamples of the scenes, the same for all seeds and for both sides of a gain. With fewer than five \
             scenes of a kind there is none.",
        );
    }

    pub(in super::super) fn skill_table(&self) -> Table {
        let caption = self.skill_caption();
        let mut table = self.frame_table(&caption, &["blow-ups", "far off", "ms per frame"]);
        let compared = self.compared.iter().map(usize::to_string);
        table.fixed_row("rollouts with truth", compared);
        for entry in self.skilled() {
            let mut cells = self.at_shown(&entry.skill, skill);
            cells.extend(counts(&entry.blow_ups, self.windows));
            cells.push(entry.cost.as_ref().map_or("-".into(), |cost| milliseconds(cost.p50)));
            table.row(entry.name.as_str(), cells);
        }
        table
    }

    /// What skill is averaged over.
    fn skill_caption(&self) -> String {
        match &self.kinds[..] {
            [one] => format!("Skill, {}", one.kind.name()),
            kinds => format!("Skill, mean of {} kinds of scenes", kinds.len()),
        }
    }

    fn skill_plot(&self) -> LinePlot {
        let series = self.fallible().map(|entry| match entry.role {
            Role::Mean => Series::default(),
            _ => self.banded(&entry.name, &entry.skill, entry.skill_intervals.as_ref()),
        });
        // Values below -1 would compress all others. The empty series of the training mean keeps styles the same in every
        // plot.
        let series = series.map(|mut series| {
            series.points.iter_mut().filter(|[_, y]| *y < -1.0).for_each(|[_, y]| *y = f64::NAN);
            series.band.retain(|[_, low, _]| *low >= -1.0);
            series
        });
        let has_intervals = self.fallible().any(|entry| entry.skill_intervals.is_some());
        let intervals = if has_intervals { " with 95 % intervals over scenes" } else { "" };
        LinePlot {
            title: format!("Skill{intervals} (cut off at -1)"),
            x: frames_ahead(),
            y: Axis::linear("skill"),
            series: series.collect(),
        }
    }

    /// Several models or seeds, or intervals over scenes; `None` if it would only repeat the skill of a checkpoint.
    pub(in super::super) fn seed_table(&self) -> Option<Table> {
        let has_intervals = self.groups.iter().any(|group| group.skill.skill_intervals.is_some());
        if !has_intervals && !self.has_several_models() {
            return None;
        }
        let mut table =
            self.frame_table("Skill by model", &["blow-ups", "far off", "ms per frame"]);
        for group in &self.groups {
            let GroupSkill { skill: mean, spread, skill_intervals } = &group.skill;
            let mut cells = self.at_shown(mean, skill);
            let seeds = group.members.len();
            cells.extend(counts(&group.blow_ups, seeds * self.windows));
            cells.push(group.ms.map_or("-".into(), milliseconds));
            let name = match &group.members[..] {
                [one] => one.clone(),
                _ => format!("{}, mean of {}", group.name, counted(seeds as u64, "seed")),
            };
            table.row(name, cells);
            if seeds > 1 {
                table
                    .detail_row("standard deviation", self.at_shown(spread, |x| format!("{x:.3}")));
            }
            if skill_intervals.is_some() {
                let at_shown = |at| between(skill_intervals.as_ref(), at);
                table.detail_row("95 % interval over scenes", (0..self.shown.len()).map(at_shown));
            }
            if let Some(Gain { gain, gain_intervals }) = &group.gain {
                table.detail_row("gain over the first model", self.at_shown(gain, skill));
                if gain_intervals.is_some() {
                    let at_shown = |at| between(gain_intervals.as_ref(), at);
                    table.detail_row(
                        "95 % interval of the gain",
                        (0..self.shown.len()).map(at_shown),
                    );
                }
            }
        }
        Some(table)
    }

    /// Whether there are several checkpoints, or rollouts of other programs.
    pub(in super::super) fn has_several_models(&self) -> bool {
        self.groups.iter().map(|group| group.members.len()).sum::<usize>() > 1
    }
}

/// Numbers of rollouts that blew up and that ended far off.
fn counts(blow_ups: &BlowUps, windows: usize) -> [String; 2] {
    [blow_ups.any, blow_ups.far_off].map(|count| format!("{count} of {windows}"))
}
