//! What a judgement says: for programs (JSON, CSV) and for people (tables, a page).
//!
//! 1. `curves`: errors and skill over the frames ahead.
//! 2. `measures`: physical measures as numbers with units.
//! 3. `entry`: everything about one contestant.
//! 4. `group`: networks that differ in nothing but their training: mean, spread, interval.
//! 5. `scenes`: errors scene by scene.
//! 6. `tables`, `plot`, `page`, `files`: how it is shown and kept.
//! 7. `read`, `compare`: reports that were written before, side by side.

mod compare;
mod curves;
mod entry;
mod files;
mod group;
mod measures;
mod page;
mod plot;
mod read;
mod scenes;
mod tables;

use serde::{Deserialize, Serialize};

pub use compare::Comparison;
pub use entry::{Contestant, Entry, Origin, Role};
pub use read::ReportError;

use super::{Arena, Cost, JudgedScene, Kind, SHOWN, Skills, Snapshot, Units};
use crate::page::Provenance;
use group::Group;
use read::FORMAT;
pub use scenes::{SCENE_FRAMES, SceneEntry};

/// What was judged.
#[derive(Clone, Debug)]
pub struct Judged {
    /// Who, in the order of the tallies: trivial predictors side by side.
    pub contestants: Vec<Contestant>,
    /// The scenes.
    pub scenes: Vec<JudgedScene>,
    /// What a frame costs, for each contestant; nothing where it was not timed.
    pub costs: Vec<Option<Cost>>,
    /// Digest of the streams.
    pub data_digest: String,
    /// Rollouts to look at, of contestants with these numbers.
    pub snapshots: (Vec<usize>, Vec<Snapshot>),
    /// What has to be said about it, one sentence each.
    pub notes: Vec<String>,
    /// How it was made.
    pub made: Provenance,
}

/// Everything about a judgement, as in `report.json`. Curves have one number a frame ahead; what there
/// is no number for is `null`.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Report {
    /// Number of the format.
    pub format: u32,
    /// How it was made. All the rest is the same whenever the same is judged, but for the time of a frame.
    pub made: Provenance,
    /// Digest of the judged streams.
    pub data_digest: String,
    /// Judged streams.
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
    /// Where the walls are in effect: smallest and largest coordinates of any true particle (domain
    /// lengths).
    pub walls: [[f32; 2]; 2],
    /// What normalised errors are divided by.
    pub units: Units,
    /// The kinds of scenes that occur, and how many of each.
    pub kinds: Vec<KindCount>,
    /// The frames ahead of measures and intervals.
    pub shown: Vec<usize>,
    /// Rollouts of each predictor that have a true frame to be compared with, at each of the frames shown:
    /// the truth of late starts ends early.
    pub compared: Vec<usize>,
    /// Everyone who was judged, in the order of the tables.
    pub predictors: Vec<Entry>,
    /// Networks that differ in nothing but their training.
    pub groups: Vec<Group>,
    /// Errors scene by scene.
    pub scenes: Vec<SceneEntry>,
    /// Rollouts to look at, with the names of who predicts; not in `report.json`.
    #[serde(skip)]
    pub snapshots: (Vec<String>, Vec<Snapshot>),
    /// What has to be said about it.
    pub notes: Vec<String>,
}

/// Scenes of a kind.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct KindCount {
    /// The kind.
    pub kind: Kind,
    /// Judged streams.
    pub streams: usize,
    /// Free rollouts of each predictor.
    pub windows: usize,
    /// Those of them that have a true frame to be compared with, at each of the frames shown.
    pub compared: Vec<usize>,
}

impl Report {
    /// Puts the report of a judgement together.
    pub fn new(arena: &Arena, judged: Judged) -> Self {
        let Judged { contestants, mut scenes, costs, data_digest, snapshots, mut notes, made } =
            judged;
        let (shown_in_snapshots, snapshots) = snapshots;
        let name = |&number: &usize| contestants[number].name.clone();
        let shown_in_snapshots = shown_in_snapshots.iter().map(name).collect();
        scenes.retain(|scene| scene.windows() > 0);
        let horizon = arena.settings.horizon;
        let baseline = |contestant: &Contestant| contestant.role == Role::Baseline;
        let first = contestants.iter().position(baseline).unwrap_or(0);
        let baselines = first..first + contestants.iter().filter(|c| baseline(c)).count();
        let skills = Skills::of(&scenes, baselines, horizon);
        let shown: Vec<usize> = SHOWN.into_iter().filter(|&ahead| ahead <= horizon).collect();
        let kinds = skills.kinds().map(|kind| {
            let of_kind = || scenes.iter().filter(|scene| scene.kind == kind);
            let windows = of_kind().map(JudgedScene::windows).sum();
            let at = |number: usize| of_kind().map(|scene| scene.compared[number]).sum();
            let compared = (0..shown.len()).map(at).collect();
            KindCount { kind, streams: of_kind().count(), windows, compared }
        });
        let kinds: Vec<KindCount> = kinds.collect();
        let at = |number: usize| kinds.iter().map(|kind| kind.compared[number]).sum();
        let compared = (0..shown.len()).map(at).collect();
        for (number, contestant) in contestants.iter().enumerate() {
            notes.extend(failures(&contestant.name, number, &scenes));
        }
        let description = |c: &Contestant| c.origin.as_ref().map(|o| o.description.clone());
        let networks: Vec<_> = contestants.iter().map(description).collect();
        let predictors: Vec<Entry> = contestants
            .into_iter()
            .zip(costs)
            .enumerate()
            .map(|(number, (contestant, cost))| {
                Entry::new(arena, contestant, cost, number, &scenes, &skills, &shown)
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
            reach: arena.settings.reach,
            dt: arena.ballistic.dt,
            spacing: arena.spacing,
            walls: [arena.ballistic.lower, arena.ballistic.upper],
            units: arena.units,
            kinds,
            shown,
            compared,
            predictors,
            groups,
            scenes: scenes.iter().map(SceneEntry::new).collect(),
            snapshots: (shown_in_snapshots, snapshots),
            notes,
        }
    }
}

/// What there is to say of scenes in which contestant `number` lost rollouts.
fn failures(name: &str, number: usize, scenes: &[JudgedScene]) -> Option<String> {
    let reasons: Vec<&String> =
        scenes.iter().filter_map(|scene| scene.tallies[number].failure.as_ref()).collect();
    let (first, scenes, all) = (reasons.first()?, reasons.len(), scenes.len());
    Some(format!(
        "{name}: lost rollouts count as diverged, in {scenes} of {all} streams; first: {first}"
    ))
}
