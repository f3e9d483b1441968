//! Command, data and settings of the evaluation.

use super::{Report, rounded};
use eddy_frames::counted;
use eddy_pages::Section;

impl Report {
    pub(super) fn reproduce(&self, section: &mut Section) {
        section.provenance(&self.made);
        let fact = |name: &str, value: String| (name.to_owned(), value);
        let mut facts = vec![fact(
            "Data",
            format!("{}, digest {}", counted(self.streams as u64, "stream"), self.data_digest),
        )];
        for entry in &self.predictors {
            let (Some(checkpoint), Some(digest)) = (&entry.checkpoint, &entry.digest) else {
                continue;
            };
            facts
                .push(fact("Checkpoint", format!("{}: {checkpoint}, digest {digest}", entry.name)));
        }
        let starts = self.scenes.iter().map(|scene| scene.starts.len()).max().unwrap_or(0);
        let [lower, upper] = self.walls.map(|wall| wall.map(|x| rounded(x.into())));
        facts.extend([
            fact("Rollouts", format!("up to {starts} per stream, {} in total", self.windows)),
            fact(
                "Frames",
                format!(
                    "{} compared, {} checked for blow-ups, {} ms apart",
                    self.horizon,
                    self.reach,
                    rounded(1e3 * f64::from(self.dt))
                ),
            ),
            fact("Effective walls", format!("{lower:?} to {upper:?} domain lengths")),
            fact("Particle spacing", format!("{} domain lengths", rounded(self.spacing.into()))),
            fact("Ranges of x, y, vx, vy", format!("{:.4?}", self.units.ranges)),
            fact("Their standard deviations", format!("{:.4?}", self.units.deviations)),
        ]);
        section.facts(&facts);
        section.paragraph(
            "Repeating the command gives the same results except for the date and the measured times.",
        );
    }
}
