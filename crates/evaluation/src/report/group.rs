//! Checkpoints of one network from trainings on the same data with different seeds: seeds of one model.

use serde::{Deserialize, Serialize};

use super::{Entry, Role};
use crate::{BlowUps, Interval, Kind, Skills, numbers};
use eddy_inference::checkpoint::{Description, Normalization, TrainingSummary};

/// Seeds of one model, or the rollouts of another program.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Group {
    /// The model: architecture and core; the name of the rollouts.
    pub name: String,
    /// Names of its checkpoints.
    pub members: Vec<String>,
    /// Blow-ups over the rollouts of all seeds.
    pub blow_ups: BlowUps,
    /// Time per frame on one thread, mean over seeds (ms); `None` if not timed.
    pub ms: Option<f64>,
    /// Mean skill over kinds.
    #[serde(flatten)]
    pub skill: GroupSkill,
    /// By kind of scene.
    pub kinds: Vec<(Kind, GroupSkill)>,
    /// Gain over the first group; `None` for the first group itself.
    #[serde(default)]
    pub gain: Option<Gain>,
}

/// The difference between the skills of two groups on the same scenes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Gain {
    /// Difference of the skills averaged over kinds and seeds; one number per frame ahead.
    #[serde(deserialize_with = "numbers::list")]
    pub gain: Vec<f64>,
    /// 95 % intervals of `gain` by bootstrap over scenes, the same for both groups, at the frames shown; `None` when a kind
    /// has fewer than five scenes.
    pub gain_intervals: Option<Vec<Interval>>,
}

/// Skill of a group.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct GroupSkill {
    /// Mean over seeds; one number per frame ahead.
    #[serde(deserialize_with = "numbers::list")]
    pub skill: Vec<f64>,
    /// Sample standard deviation over seeds; 0 for a single seed.
    #[serde(deserialize_with = "numbers::list")]
    pub spread: Vec<f64>,
    /// 95 % intervals of `skill` by bootstrap over scenes, at the frames shown; `None` when a kind has fewer than five
    /// scenes.
    pub skill_intervals: Option<Vec<Interval>>,
}

impl Group {
    /// All groups of models, in the order of their first members, and one for the rollouts of each other program. `networks` has the
    /// description of each model.
    pub(super) fn all(
        predictors: &[Entry],
        networks: &[Option<Description>],
        skills: &Skills,
        shown: &[usize],
    ) -> Vec<Self> {
        let of_role =
            |role| predictors.iter().enumerate().filter(move |(_, entry)| entry.role == role);
        let checkpoints = of_role(Role::Model)
            .filter_map(|(number, _)| Some((number, networks[number].as_ref()?)));
        let models = by_model(checkpoints.collect()).into_iter().map(|model| {
            let (_, network) = model[0];
            let name = format!("{} {}", network.architecture.name(), network.core.name());
            (name, model.iter().map(|(number, _)| *number).collect())
        });
        let rivals =
            of_role(Role::Recorded).map(|(number, entry)| (entry.name.clone(), vec![number]));
        let members: Vec<(String, Vec<usize>)> = models.chain(rivals).collect();
        let group = |(name, members): &(String, Vec<usize>)| {
            let entries: Vec<&Entry> = members.iter().map(|&member| &predictors[member]).collect();
            let mut blow_ups = BlowUps::default();
            entries.iter().for_each(|entry| blow_ups.merge(&entry.blow_ups));
            let times: Option<Vec<f64>> =
                entries.iter().map(|entry| entry.cost.as_ref().map(|cost| cost.p50)).collect();
            let of_kind = |kind: Kind| {
                let curves = members.iter().map(|&member| skills.of_kind(kind, member)).collect();
                let intervals = skills.intervals_of_kind(kind, members, shown);
                (kind, GroupSkill::new(curves, intervals))
            };
            let curves = members.iter().map(|&member| skills.mean(member)).collect();
            Self {
                name: name.clone(),
                members: entries.iter().map(|entry| entry.name.clone()).collect(),
                blow_ups,
                ms: times.map(|times| times.iter().sum::<f64>() / times.len() as f64),
                skill: GroupSkill::new(curves, skills.intervals(members, shown)),
                kinds: skills.kinds().map(of_kind).collect(),
                gain: None,
            }
        };
        let mut groups: Vec<Self> = members.iter().map(group).collect();
        if let Some((first, others)) = groups.split_first_mut() {
            for (group, (_, members_of)) in others.iter_mut().zip(&members[1..]) {
                let pairs = group.skill.skill.iter().zip(&first.skill.skill);
                group.gain = Some(Gain {
                    gain: pairs.map(|(mine, first)| mine - first).collect(),
                    gain_intervals: skills.gain_intervals(members_of, &members[0].1, shown),
                });
            }
        }
        distinguish(&mut groups);
        groups
    }
}

/// Numbers and descriptions of checkpoints.
type Models<'a> = Vec<(usize, &'a Description)>;

/// The checkpoints by model, in the order of their first ones.
fn by_model(checkpoints: Models<'_>) -> Vec<Models<'_>> {
    let mut models: Vec<Models<'_>> = Vec::new();
    for (number, description) in checkpoints {
        let is_theirs = |model: &&mut Models<'_>| {
            model.iter().all(|(_, other)| are_seeds_of_one_model(other, description))
        };
        match models.iter_mut().find(is_theirs) {
            Some(model) => model.push((number, description)),
            None => models.push(vec![(number, description)]),
        }
    }
    models
}

/// Whether two checkpoints of one network are from trainings on the same data with different seeds. A training that goes on from a
/// checkpoint makes another model of it; a second one with the same seed has other settings.
fn are_seeds_of_one_model(one: &Description, other: &Description) -> bool {
    let (training, others) = (&one.training, &other.training);
    untrained(one) == untrained(other)
        && one.data == other.data
        && training.seed != others.seed
        && training.start.is_some() == others.start.is_some()
}

/// Adds the names of the checkpoints to the names of models that are called the same.
fn distinguish(groups: &mut [Group]) {
    let names: Vec<String> = groups.iter().map(|group| group.name.clone()).collect();
    for group in groups {
        if names.iter().filter(|name| **name == group.name).count() > 1 {
            group.name = format!("{} ({})", group.name, group.members.join(", "));
        }
    }
}

impl GroupSkill {
    fn new(curves: Vec<Vec<f64>>, skill_intervals: Option<Vec<Interval>>) -> Self {
        let (skill, spread) = mean_and_spread(&curves);
        Self { skill, spread, skill_intervals }
    }
}

/// A description without the parts that come from training and its data.
fn untrained(description: &Description) -> Description {
    let zero = [0.0; 4];
    let normalization =
        Normalization { minimum: zero, maximum: zero, mean: zero, standard_deviation: zero };
    let training = TrainingSummary::default();
    Description { data: String::new(), normalization, training, ..description.clone() }
}

fn mean_and_spread(curves: &[Vec<f64>]) -> (Vec<f64>, Vec<f64>) {
    let count = curves.len() as f64;
    let at = |frame: usize| {
        let mean = curves.iter().map(|curve| curve[frame]).sum::<f64>() / count;
        let squares: f64 = curves.iter().map(|curve| (curve[frame] - mean).powi(2)).sum();
        (mean, (squares / (count - 1.0).max(1.0)).sqrt())
    };
    (0..curves.first().map_or(0, Vec::len)).map(at).unzip()
}

#[cfg(test)]
mod tests {
    use eddy_inference::checkpoint::{Architecture, Core, Sizes};

    use super::*;

    #[test]
    fn models_of_one_name_are_told_apart_by_their_checkpoints() {
        let group = |name: &str, member: &str| Group {
            name: name.to_owned(),
            members: vec![member.to_owned()],
            blow_ups: BlowUps::default(),
            ms: None,
            skill: GroupSkill { skill: Vec::new(), spread: Vec::new(), skill_intervals: None },
            kinds: Vec::new(),
            gain: None,
        };
        let mut groups = [
            group("particle mingru", "mine"),
            group("frame gru", "b"),
            group("particle mingru", "c"),
        ];
        distinguish(&mut groups);
        let names: Vec<&str> = groups.iter().map(|group| group.name.as_str()).collect();
        assert_eq!(names, ["particle mingru (mine)", "frame gru", "particle mingru (c)"]);
    }

    #[test]
    fn trainings_of_one_network_with_different_seeds_are_seeds_of_one_model() {
        let trained = |data: &str, core: Core, seed: u64, start: Option<&str>| {
            let sizes = Sizes { encoder: 4, hidden: 4, layers: 1, particles: None };
            let mut description = Description::untrained(Architecture::Particle, core, sizes);
            description.data = data.to_owned();
            description.training = TrainingSummary {
                seed,
                start: start.map(str::to_owned),
                ..TrainingSummary::default()
            };
            description
        };
        let checkpoints = [
            trained("data", Core::MinGru, 1, None),
            trained("other", Core::MinGru, 2, None),
            trained("data", Core::MinGru, 2, None),
            trained("data", Core::MinLstm, 2, None),
            // Trained further, both from checkpoints of their own.
            trained("data", Core::MinGru, 1, Some("a")),
            trained("data", Core::MinGru, 2, Some("b")),
            // Once more with seed 1.
            trained("data", Core::MinGru, 1, None),
            trained("data", Core::MinGru, 3, None),
        ];
        let models = by_model(checkpoints.iter().enumerate().collect());
        let numbers: Vec<Vec<usize>> =
            models.iter().map(|model| model.iter().map(|(number, _)| *number).collect()).collect();
        assert_eq!(numbers, [vec![0, 2, 7], vec![1], vec![3], vec![4, 5], vec![6]]);
    }

    #[test]
    fn the_spread_is_the_standard_deviation_of_the_sample() {
        let (mean, spread) = mean_and_spread(&[vec![1.0, 5.0], vec![2.0, 5.0], vec![3.0, 5.0]]);
        assert_eq!((mean, spread), (vec![2.0, 5.0], vec![1.0, 0.0]));
        assert_eq!(mean_and_spread(&[vec![0.5]]), (vec![0.5], vec![0.0]));
    }
}
