//! Evaluation reports: JSON and CSV for programs, tables and a page for people.
//!
//! 1. `curves`: errors and skill over the frames ahead.
//! 2. `measures`: physical measures with units.
//! 3. `entry`: all results of one predictor.
//! 4. `group`: checkpoints that are seeds of one model: mean, standard deviation, interval.
//! 5. `scenes`: errors scene by scene.
//! 6. `page`, `tables`, `files`: output.
//! 7. `read`, `compare`: comparison of reports read from files.

mod compare;
mod curves;
mod entry;
mod files;
mod group;
mod measures;
mod page;
mod read;
mod scenes;
mod tables;
mod verdict;

use serde::{Deserialize, Serialize};

pub use compare::Comparison;
pub use entry::{Entry, Origin, PredictorInfo, Role};
pub use read::ReportError;

use super::{Context, Cost, Kind, SHOWN_FRAMES, SceneResult, Skills, Snapshot, Units};
use eddy_pages::Provenance;
use group::Group;
use read::FORMAT;
pub use scenes::{SCENE_FRAMES, SceneEntry};

/// Results of an evaluation.
#[derive(Clone, Debug)]
pub struct EvaluationResults {
    /// The predictors, in the order of the accumulators; trivial predictors are adjacent.
    pub infos: Vec<PredictorInfo>,
    /// Results by scene.
    pub scenes: Vec<SceneResult>,
    /// Time per frame of each predictor; `None` if not timed.
    pub costs: Vec<Option<Cost>>,
    /// Digest of the streams.
    pub data_digest: String,
    /// Indices of the pictured predictors, and their snapshots.
    pub snapshots: (Vec<usize>, Vec<Snapshot>),
    /// Remarks, one sentence each.
    pub notes: Vec<String>,
    /// Provenance.
    pub made: Provenance,
}

/// An evaluation report, as in `report.json`. Curves have one number per frame ahead, `null` where there is none.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Report {
    /// Version of the format.
    pub format: u32,
    /// Provenance. Apart from it and the times, repeating an evaluation gives the same report.
    pub made: Provenance,
    /// Digest of the evaluated streams.
    pub data_digest: String,
    /// Evaluated streams.
    pub streams: usize,
    /// Free rollouts of each predictor.
    pub windows: usize,
    /// Frames ahead that are compared with the truth.
    pub horizon: usize,
    /// Frames ahead up to which blow-ups are counted.
    pub reach: usize,
    /// Time between two frames (s).
    pub dt: f32,
    /// Distance between neighbouring particles at rest (domain lengths).
    pub spacing: f32,
    /// Effective walls: minimum and maximum coordinates of all true particles (domain lengths).
    pub walls: [[f32; 2]; 2],
    /// Divisors of normalised errors.
    pub units: Units,
    /// The kinds of scenes that occur, with their numbers.
    pub kinds: Vec<KindCount>,
    /// The frames ahead of measures and intervals.
    pub shown: Vec<usize>,
    /// Rollouts of each predictor with a true frame at each of the frames shown: the truth of late starts ends early.
    pub compared: Vec<usize>,
    /// Frames ahead up to which every rollout has a true frame; 0 in reports of older versions.
    #[serde(default)]
    pub complete: usize,
    /// All predictors, in the order of the tables.
    pub predictors: Vec<Entry>,
    /// The models, with the checkpoints that are seeds of each.
    pub groups: Vec<Group>,
    /// Errors scene by scene.
    pub scenes: Vec<SceneEntry>,
    /// Names of the pictured predictors, and their snapshots; not in `report.json`.
    #[serde(skip)]
    pub snapshots: (Vec<String>, Vec<Snapshot>),
    /// Remarks, one sentence each.
    pub notes: Vec<String>,
}

/// Numbers of streams and rollouts of a kind of scenes.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct KindCount {
    /// Kind of scene.
    pub kind: Kind,
    /// Evaluated streams.
    pub streams: usize,
    /// Free rollouts of each predictor.
    pub windows: usize,
    /// Rollouts of each predictor with a true frame, at each of the frames shown.
    pub compared: Vec<usize>,
}

impl Report {
    /// Assembles the report.
    pub fn new(context: &Context, results: EvaluationResults) -> Self {
        let EvaluationResults { infos, mut scenes, costs, data_digest, snapshots, mut notes, made } =
            results;
        let (shown_in_snapshots, snapshots) = snapshots;
        let name = |&number: &usize| infos[number].name.clone();
        let shown_in_snapshots = shown_in_snapshots.iter().map(name).collect();
        scenes.retain(|scene| scene.windows() > 0);
        let horizon = context.settings.horizon;
        let baseline = |info: &PredictorInfo| info.role == Role::Baseline;
        let first = infos.iter().position(baseline).unwrap_or(0);
        let baselines = first..first + infos.iter().filter(|c| baseline(c)).count();
        let skills = Skills::of(&scenes, baselines, horizon);
        let shown: Vec<usize> =
            SHOWN_FRAMES.into_iter().filter(|&ahead| ahead <= horizon).collect();
        let kinds = skills.kinds().map(|kind| {
            let of_kind = || scenes.iter().filter(|scene| scene.kind == kind);
            let windows = of_kind().map(SceneResult::windows).sum();
            let at = |number: usize| of_kind().map(|scene| scene.compared[number]).sum();
            let compared = (0..shown.len()).map(at).collect();
            KindCount { kind, streams: of_kind().count(), windows, compared }
        });
        let kinds: Vec<KindCount> = kinds.collect();
        let at = |number: usize| kinds.iter().map(|kind| kind.compared[number]).sum();
        let compared = (0..shown.len()).map(at).collect();
        for (number, info) in infos.iter().enumerate() {
            notes.extend(failures(&info.name, number, &scenes));
        }
        let description = |c: &PredictorInfo| c.origin.as_ref().map(|o| o.description.clone());
        let networks: Vec<_> = infos.iter().map(description).collect();
        let predictors: Vec<Entry> = infos
            .into_iter()
            .zip(costs)
            .enumerate()
            .map(|(number, (info, cost))| {
                Entry::new(context, info, cost, number, &scenes, &skills, &shown)
            })
            .collect();
        let groups = Group::all(&predictors, &networks, &skills, &shown);
        Self {
            format: FORMAT,
            made,
            data_digest,
            streams: scenes.len(),
            windows: kinds.iter().map(|kind| kind.windows).sum(),
            horizon,
            reach: context.settings.reach,
            dt: context.ballistic.dt,
            spacing: context.spacing,
            walls: [context.ballistic.lower, context.ballistic.upper],
            units: context.units,
            kinds,
            shown,
            compared,
            complete: scenes.iter().map(|scene| scene.complete).min().unwrap_or(0),
            predictors,
            groups,
            scenes: scenes.iter().map(SceneEntry::new).collect(),
            snapshots: (shown_in_snapshots, snapshots),
            notes,
        }
    }
}

/// A remark on the scenes in which rollouts of predictor `number` failed.
fn failures(name: &str, number: usize, scenes: &[SceneResult]) -> Option<String> {
    let reasons: Vec<&String> =
        scenes.iter().filter_map(|scene| scene.accumulators[number].failure.as_ref()).collect();
    let (first, scenes, all) = (reasons.first()?, reasons.len(), scenes.len());
    Some(format!(
        "{name}: rollouts failed in {scenes} of {all} streams and count as diverged; first reason: {first}"
    ))
}
