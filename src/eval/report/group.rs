//! Networks that differ in nothing but their training: seeds of one model.

use serde::Serialize;

use super::{Contestant, Role};
use crate::{
    checkpoint::{Description, Normalization, TrainingSummary},
    eval::{Interval, Skills},
};

/// Seeds of one model.
#[derive(Clone, Debug, Serialize)]
pub struct Group {
    /// The model: architecture and core.
    pub name: String,
    /// Names of its checkpoints.
    pub members: Vec<String>,
    /// Mean over the seeds of the mean skill over kinds; one number a frame ahead.
    pub skill: Vec<f64>,
    /// Standard deviation of it between the seeds (of the sample); 0 for a single one.
    pub spread: Vec<f64>,
    /// 95 % intervals of `skill` by bootstrap over scenes, at the frames shown.
    pub skill_intervals: Vec<Interval>,
}

impl Group {
    /// All groups among the models, in the order of their first members.
    pub(super) fn all(contestants: &[Contestant], skills: &Skills, shown: &[usize]) -> Vec<Self> {
        let mut networks: Vec<(Description, Vec<usize>)> = Vec::new();
        for (number, contestant) in contestants.iter().enumerate() {
            let (Some(origin), Role::Model) = (&contestant.origin, contestant.role) else {
                continue;
            };
            let network = untrained(&origin.description);
            match networks.iter_mut().find(|(other, _)| *other == network) {
                Some((_, members)) => members.push(number),
                None => networks.push((network, vec![number])),
            }
        }
        let group = |(network, members): (Description, Vec<usize>)| {
            let curves: Vec<Vec<f64>> = members.iter().map(|&member| skills.mean(member)).collect();
            let (skill, spread) = mean_and_spread(&curves);
            Self {
                name: format!("{} {}", network.architecture.name(), network.core.name()),
                members: members.iter().map(|&m| contestants[m].name.clone()).collect(),
                skill,
                spread,
                skill_intervals: skills.intervals(&members, shown),
            }
        };
        networks.into_iter().map(group).collect()
    }
}

/// A description without what comes from training and its data.
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
    use super::*;

    #[test]
    fn the_spread_is_the_standard_deviation_of_the_sample() {
        let (mean, spread) = mean_and_spread(&[vec![1.0, 5.0], vec![2.0, 5.0], vec![3.0, 5.0]]);
        assert_eq!((mean, spread), (vec![2.0, 5.0], vec![1.0, 0.0]));
        assert_eq!(mean_and_spread(&[vec![0.5]]), (vec![0.5], vec![0.0]));
    }
}
