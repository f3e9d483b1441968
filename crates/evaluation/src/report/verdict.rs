//! What a report says of each model, in sentences.

use super::{Entry, Report, Role, page::at, tables::rounded};
use eddy_frames::{counted, decimal};

impl Report {
    /// Which of several models is best, at the frames of the verdicts; `None` for fewer than two.
    pub fn winner(&self) -> Option<String> {
        let judged: Vec<_> = self.competing().collect();
        let [first, _, ..] = judged[..] else { return None };
        let at_frame = |&frame: &usize| {
            let skills = judged.iter().map(|entry| (&entry.name, at(&entry.skill, frame)));
            let skills = skills.filter(|(_, skill)| !skill.is_nan());
            let best = skills.max_by(|(_, a), (_, b)| a.total_cmp(b));
            best.map(|(name, _)| format!("{name} at frame {frame}"))
        };
        let best: Vec<_> = frames(first.skill.len()).iter().filter_map(at_frame).collect();
        Some(format!("Best of {}: {}.", judged.len(), best.join(", ")))
    }

    /// A model and sentences on it: where it is better than trivial, its weakest kind of scenes, blow-ups, cost.
    pub fn verdicts(&self) -> impl Iterator<Item = (&str, Vec<String>)> {
        self.judged().map(|entry| (&*entry.name, self.verdict(entry)))
    }

    fn judged(&self) -> impl Iterator<Item = &Entry> {
        let judged =
            |entry: &&Entry| matches!(entry.role, Role::Model | Role::JoinedLate | Role::Recorded);
        self.predictors.iter().filter(judged)
    }

    /// The models, and the rollouts of other programs: a model that joined late competes with itself.
    pub(super) fn competing(&self) -> impl Iterator<Item = &Entry> {
        self.judged().filter(|entry| entry.role != Role::JoinedLate)
    }

    fn verdict(&self, entry: &Entry) -> Vec<String> {
        let last = entry.skill.len();
        let skills = frames(last)
            .into_iter()
            .map(|frame| format!("{} at frame {frame}", rounded(at(&entry.skill, frame))));
        let skills: Vec<_> = skills.collect();
        let mut sentences = Vec::new();
        if entry.skill_intervals.is_none() {
            sentences
                .push("Too few scenes for an interval: other scenes may differ much.".to_owned());
        }
        sentences.push(format!(
            "Better than the best trivial predictor {}: skill {}.",
            better(&entry.skill),
            skills.join(", ")
        ));
        sentences.extend(self.ahead_of(entry));
        let weakest = entry.kinds.iter().map(|kind| (kind.kind, at(&kind.skill, last)));
        let weakest = weakest.filter(|(_, skill)| !skill.is_nan());
        let weakest = weakest.min_by(|(_, a), (_, b)| a.total_cmp(b));
        if let Some((kind, skill)) = weakest.filter(|_| entry.kinds.len() > 1) {
            let skill = rounded(skill);
            sentences
                .push(format!("Weakest in scenes of {}: {skill} at frame {last}.", kind.name()));
        }
        let all = counted(self.windows as u64, "rollout");
        let far_off = match entry.blow_ups.far_off {
            0 => "none ends".to_owned(),
            1 => "1 ends".to_owned(),
            count => format!("{count} end"),
        };
        let blow_up = match entry.blow_ups.any {
            0 => format!("None of {all} blows up"),
            1 => format!("1 of {all} blows up"),
            count => format!("{count} of {all} blow up"),
        };
        sentences.push(format!(
            "{blow_up} (three times the largest kinetic energy of the truth), {far_off} far off (four times the error of the best trivial predictor)."
        ));
        if let Some(cost) = &entry.cost {
            sentences.push(format!(
                "A frame ({} ms) takes {:.2} ms on one thread.",
                decimal(1e3 * self.dt),
                cost.p50
            ));
        }
        sentences
    }

    /// What is ahead of a model among predictors that are no trivial ones, at the frames of the verdicts.
    fn ahead_of(&self, entry: &Entry) -> Option<String> {
        let others = self.predictors.iter();
        let others = others.filter(|other| matches!(other.role, Role::LinearFit | Role::Solver));
        let ahead = others.filter_map(|other| {
            let is_ahead = |&frame: &usize| at(&other.skill, frame) > at(&entry.skill, frame);
            let frames: Vec<_> = frames(entry.skill.len()).into_iter().filter(is_ahead).collect();
            let listed: Vec<_> = frames.iter().map(usize::to_string).collect();
            (!frames.is_empty()).then(|| format!("{} at frame {}", other.name, listed.join(", ")))
        });
        let ahead: Vec<_> = ahead.collect();
        (!ahead.is_empty()).then(|| format!("Ahead of it: {}.", ahead.join("; ")))
    }
}

/// The frames ahead whose skills are named, of so many.
fn frames(last: usize) -> Vec<usize> {
    let mut frames = vec![1, 20, last];
    frames.retain(|&frame| frame <= last);
    frames.dedup();
    frames
}

/// At which frames ahead a skill is above 0.
fn better(skill: &[f64]) -> String {
    let above = |skill: &&f64| **skill > 0.0;
    let (count, all) = (skill.iter().filter(above).count(), skill.len());
    let first = skill.iter().take_while(above).count();
    let last = skill.iter().rev().take_while(above).count();
    match count {
        0 => "at no frame".to_owned(),
        _ if count == all => "at every frame".to_owned(),
        _ if count == first => format!("up to frame {first}"),
        _ if count == last => format!("from frame {} on", all - last + 1),
        _ => format!("at {count} of {all} frames"),
    }
}

#[cfg(test)]
mod tests {
    use super::better;

    #[test]
    fn a_verdict_says_at_which_frames_a_model_is_better() {
        for (skill, expected) in [
            (&[0.5, 0.1][..], "at every frame"),
            (&[-0.5, 0.0], "at no frame"),
            (&[0.5, 0.5, -0.1], "up to frame 2"),
            (&[-0.5, f64::NAN, 0.1, 0.2], "from frame 3 on"),
            (&[0.5, -0.5, 0.1], "at 2 of 3 frames"),
        ] {
            assert_eq!(better(skill), expected);
        }
    }
}
