//! Everything about one contestant.

use serde::{Deserialize, Serialize};

use super::{
    curves::{BulkCurves, Curves, StepCurves},
    measures::{Flight, Measures},
};
use crate::{Arena, BlowUps, Cost, Interval, JudgedScene, Kind, Skills, Tally, numbers};
use eddy_frames::Material;
use eddy_inference::checkpoint::Description;

/// Who predicts.
#[derive(Clone, Debug)]
pub struct Contestant {
    /// Its name in tables.
    pub name: String,
    /// What it is.
    pub role: Role,
    /// Where a model is from; nothing else has that.
    pub origin: Option<Origin>,
}

/// What a contestant is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Role {
    /// A checkpoint that observed each stream from its first frame on.
    Model,
    /// A checkpoint that observed no more than its warm-up.
    JoinedLate,
    /// A predictor that learns nothing.
    Baseline,
    /// The training's mean, in every place: the unit of z-score errors. No skill is measured against it, it
    /// knows nothing of the frames that were observed.
    Mean,
    /// A solver that knows the law and observes what a model observes.
    Rival,
    /// The truth from slightly displaced positions: nobody can do better for long.
    Chaos,
    /// The truth, for comparison of measures.
    Truth,
}

/// Where a model is from.
#[derive(Clone, Debug)]
pub struct Origin {
    /// The checkpoint's path.
    pub checkpoint: String,
    /// Its digest.
    pub digest: String,
    /// What the network is.
    pub description: Description,
}

/// Everything about one contestant; curves have one number a frame ahead.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Entry {
    /// Its name.
    pub name: String,
    /// What it is.
    pub role: Role,
    /// The checkpoint of a model.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub checkpoint: Option<String>,
    /// Digest of the checkpoint.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub digest: Option<String>,
    /// Rollouts that blew up.
    pub blow_ups: BlowUps,
    /// Mean of the skills of all kinds: 1 - squared position error / that of the best baseline at that
    /// frame, both summed over the windows of a kind.
    #[serde(deserialize_with = "numbers::list")]
    pub skill: Vec<f64>,
    /// 95 % intervals of `skill` by bootstrap over scenes, at the frames shown; nothing when a kind has
    /// fewer than five scenes.
    pub skill_intervals: Option<Vec<Interval>>,
    /// Errors over all scenes.
    #[serde(flatten)]
    pub curves: Curves,
    /// Errors of next frames over all scenes; nothing for who cannot continue a stream.
    #[serde(flatten)]
    pub steps: Option<StepCurves>,
    /// What all particles have together, over all scenes; nothing where no measures were taken.
    #[serde(flatten)]
    pub bulk: Option<BulkCurves>,
    /// Physical measures over all scenes, at the frames shown.
    pub measures: Vec<Measures>,
    /// What happens to bodies in free flight; nothing for who predicts no next frame of them.
    pub flight: Option<Flight>,
    /// By the kind of the scene.
    pub kinds: Vec<KindEntry>,
    /// By the material of the particle, in whatever scene.
    pub materials: Vec<(Material, Curves)>,
    /// Time of a predicted frame on one thread.
    pub cost: Option<Cost>,
}

/// A contestant in the scenes of one kind.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct KindEntry {
    /// The kind.
    pub kind: Kind,
    /// As in [`Entry`].
    pub blow_ups: BlowUps,
    /// Skill in the scenes of this kind.
    #[serde(deserialize_with = "numbers::list")]
    pub skill: Vec<f64>,
    /// As in [`Entry`], of this skill.
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
    /// Everything about contestant `number` of the judged scenes.
    pub(super) fn new(
        arena: &Arena,
        contestant: Contestant,
        cost: Option<Cost>,
        number: usize,
        scenes: &[JudgedScene],
        skills: &Skills,
        shown: &[usize],
    ) -> Self {
        let mut all = Tally::new(arena);
        let mut kinds = Vec::new();
        for kind in skills.kinds() {
            let mut tally = Tally::new(arena);
            let of_kind = scenes.iter().filter(|scene| scene.kind == kind);
            of_kind.for_each(|scene| tally.merge(&scene.tallies[number]));
            all.merge(&tally);
            kinds.push(KindEntry {
                kind,
                blow_ups: tally.blow_ups,
                skill: skills.of_kind(kind, number),
                skill_intervals: skills.intervals_of_kind(kind, &[number], shown),
                curves: Curves::new(&tally.errors.total()),
                steps: tally.steps.as_ref().map(StepCurves::new),
                measures: measures(&tally, shown),
            });
        }
        let materials = Material::ALL.into_iter().filter_map(|material| {
            let errors = all.errors.of(material);
            let present = errors.first().is_some_and(|first| first.count > 0.0);
            present.then(|| (material, Curves::new(&errors)))
        });
        let Contestant { name, role, origin } = contestant;
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
            kinds,
            materials: materials.collect(),
            cost,
        }
    }
}

fn measures(tally: &Tally, shown: &[usize]) -> Vec<Measures> {
    shown.iter().zip(&tally.physics).map(|(&frame, sums)| Measures::new(frame, sums)).collect()
}
