//! All results of one predictor.

use serde::{Deserialize, Serialize};

use super::{
    curves::{BulkCurves, Curves, StepCurves},
    measures::{Flight, Measures},
};
use crate::{
    Accumulator, BlowUps, Context, Cost, Interval, Kind, Reliability, SceneResult, Skills, numbers,
};
use eddy_frames::Material;
use eddy_inference::checkpoint::Description;

/// Name and origin of a predictor.
#[derive(Clone, Debug)]
pub struct PredictorInfo {
    /// Its name in tables.
    pub name: String,
    /// Its role in the evaluation.
    pub role: Role,
    /// The checkpoint of a model; `None` for other predictors.
    pub origin: Option<Origin>,
}

/// The role of a predictor in an evaluation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// A checkpoint that observed each stream from its first frame on.
    Model,
    /// A checkpoint that observed its warm-up only.
    JoinedLate,
    /// Rollouts that another program has recorded.
    Recorded,
    /// A trivial predictor.
    Baseline,
    /// The mean of the training data: the reference of z-score errors. Not a baseline of skill, because it ignores the
    /// observed frames.
    Mean,
    /// Ten numbers fitted to the training data. Not a baseline of skill, because it has learned.
    LinearFit,
    /// A reference solver that observes what a model observes.
    #[serde(rename = "rival")]
    Solver,
    /// The true simulation from slightly displaced positions: an upper bound on predictability.
    Chaos,
    /// The truth, for comparison of physical measures.
    Truth,
}

/// The checkpoint of a model.
#[derive(Clone, Debug)]
pub struct Origin {
    /// The checkpoint's path.
    pub checkpoint: String,
    /// Its digest.
    pub digest: String,
    /// Description of the network.
    pub description: Description,
}

/// All results of one predictor; curves have one number per frame ahead.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// Its role in the evaluation.
    pub role: Role,
    /// Path of a model's checkpoint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checkpoint: Option<String>,
    /// Digest of the checkpoint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub digest: Option<String>,
    /// Rollouts that blew up.
    pub blow_ups: BlowUps,
    /// Mean over kinds of 1 - squared position error / squared position error of the best baseline at that frame, both
    /// summed over the windows of a kind.
    #[serde(deserialize_with = "numbers::list")]
    pub skill: Vec<f64>,
    /// 95 % intervals of `skill` by bootstrap over scenes, at the frames shown; `None` when a kind has fewer than five
    /// scenes.
    pub skill_intervals: Option<Vec<Interval>>,
    /// Errors over all scenes.
    #[serde(flatten)]
    pub curves: Curves,
    /// Errors of one-step predictions over all scenes, if the predictor makes them.
    #[serde(flatten)]
    pub steps: Option<StepCurves>,
    /// Bulk quantities over all scenes, if measures were requested.
    #[serde(flatten)]
    pub bulk: Option<BulkCurves>,
    /// Physical measures over all scenes, at the frames shown.
    pub measures: Vec<Measures>,
    /// Errors of bodies in free flight, if the predictor makes one-step predictions of them.
    pub flight: Option<Flight>,
    /// How well the estimates of its errors hold, for models that make them.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub reliability: Vec<Reliability>,
    /// By kind of scene.
    pub kinds: Vec<KindEntry>,
    /// By material of the particle, over all scenes.
    pub materials: Vec<(Material, Curves)>,
    /// Time per predicted frame on one thread.
    pub cost: Option<Cost>,
}

/// Results of a predictor in scenes of one kind.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct KindEntry {
    /// Kind of scene.
    pub kind: Kind,
    /// As in [`Entry`].
    pub blow_ups: BlowUps,
    /// Skill in the scenes of this kind.
    #[serde(deserialize_with = "numbers::list")]
    pub skill: Vec<f64>,
    /// As in [`Entry`], for this skill.
    pub skill_intervals: Option<Vec<Interval>>,
    /// As in [`Entry`].
    #[serde(flatten)]
    pub curves: Curves,
    /// As in [`Entry`].
    #[serde(flatten)]
    pub steps: Option<StepCurves>,
    /// As in [`Entry`].
    pub measures: Vec<Measures>,
}

impl Entry {
    /// Results of predictor `number` over the evaluated scenes.
    pub(super) fn new(
        context: &Context,
        info: PredictorInfo,
        cost: Option<Cost>,
        number: usize,
        scenes: &[SceneResult],
        skills: &Skills,
        shown: &[usize],
    ) -> Self {
        let mut all = Accumulator::new(context);
        let mut kinds = Vec::new();
        for kind in skills.kinds() {
            let mut accumulator = Accumulator::new(context);
            let of_kind = scenes.iter().filter(|scene| scene.kind == kind);
            of_kind.for_each(|scene| accumulator.merge(&scene.accumulators[number]));
            all.merge(&accumulator);
            kinds.push(KindEntry {
                kind,
                blow_ups: accumulator.blow_ups,
                skill: skills.of_kind(kind, number),
                skill_intervals: skills.intervals_of_kind(kind, &[number], shown),
                curves: Curves::new(&accumulator.errors.total()),
                steps: accumulator.steps.as_ref().map(StepCurves::new),
                measures: measures(&accumulator, shown),
            });
        }
        let materials = Material::ALL.into_iter().filter_map(|material| {
            let errors = all.errors.of(material);
            let present = errors.first().is_some_and(|first| first.count > 0.0);
            present.then(|| (material, Curves::new(&errors)))
        });
        let PredictorInfo { name, role, origin } = info;
        let (checkpoint, digest) = origin.map(|o| (o.checkpoint, o.digest)).unzip();
        Self {
            name,
            role,
            checkpoint,
            digest,
            blow_ups: all.blow_ups,
            skill: skills.mean(number),
            skill_intervals: skills.intervals(&[number], shown),
            curves: Curves::new(&all.errors.total()),
            steps: all.steps.as_ref().map(StepCurves::new),
            bulk: BulkCurves::new(&all.bulk),
            measures: measures(&all, shown),
            flight: Flight::new(&all.flight),
            reliability: Reliability::by_horizon(&all.estimates),
            kinds,
            materials: materials.collect(),
            cost,
        }
    }
}

fn measures(accumulator: &Accumulator, shown: &[usize]) -> Vec<Measures> {
    shown
        .iter()
        .zip(&accumulator.physics)
        .map(|(&frame, sums)| Measures::new(frame, sums))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::Role;

    #[test]
    fn roles_have_the_names_of_earlier_reports() {
        let json = serde_json::to_string(&[Role::Model, Role::JoinedLate, Role::Solver]).unwrap();
        assert_eq!(json, r#"["model","joined_late","rival"]"#);
        assert_eq!(serde_json::from_str::<Role>("\"rival\"").unwrap(), Role::Solver);
    }
}
