//! What a judgement says: for programs (JSON, CSV) and for people (tables, a plot).
//!
//! 1. `curves`: errors and skill over the frames ahead.
//! 2. `measures`: physical measures as numbers with units.
//! 3. `entry`: everything about one contestant.
//! 4. `group`: networks that differ in nothing but their training: mean, spread, interval.
//! 5. `tables`, `plot`, `files`: how it is shown and kept.

mod curves;
mod entry;
mod files;
mod group;
mod measures;
mod plot;
mod tables;

use serde::Serialize;

pub use entry::{Contestant, Entry, Origin, Role};

use super::{Arena, Cost, Extremes, JudgedScene, Kind, SHOWN, Skills};
use group::Group;

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
    /// What has to be said about it, one sentence each.
    pub notes: Vec<String>,
}

/// Everything about a judgement, as in `report.json`. Curves have one number a frame ahead; what there
/// is no number for is `null`.
#[derive(Clone, Debug, Serialize)]
pub struct Report {
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
    /// What the truth never exceeds.
    pub extremes: Extremes,
    /// The kinds of scenes that occur, and how many of each.
    pub kinds: Vec<KindCount>,
    /// The frames ahead of measures and intervals.
    pub shown: Vec<usize>,
    /// Everyone who was judged, in the order of the tables.
    pub predictors: Vec<Entry>,
    /// Networks that differ in nothing but their training.
    pub groups: Vec<Group>,
    /// What has to be said about it.
    pub notes: Vec<String>,
}

/// Scenes of a kind.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct KindCount {
    /// The kind.
    pub kind: Kind,
    /// Judged streams.
    pub streams: usize,
    /// Free rollouts of each predictor.
    pub windows: usize,
}

impl Report {
    /// Puts the report of a judgement together.
    pub fn new(arena: &Arena, judged: Judged) -> Self {
        let Judged { contestants, mut scenes, costs, data_digest, notes } = judged;
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
            KindCount { kind, streams: of_kind().count(), windows }
        });
        let kinds: Vec<KindCount> = kinds.collect();
        let groups = Group::all(&contestants, &skills, &shown);
        let predictors: Vec<Entry> = contestants
            .into_iter()
            .zip(costs)
            .enumerate()
            .map(|(number, (contestant, cost))| {
                Entry::new(arena, contestant, cost, number, &scenes, &skills, &shown)
            })
            .collect();
        Self {
            data_digest,
            streams: scenes.len(),
            windows: kinds.iter().map(|kind| kind.windows).sum(),
            horizon,
            reach: arena.settings.reach,
            dt: arena.ballistic.dt,
            spacing: arena.spacing,
            walls: [arena.ballistic.lower, arena.ballistic.upper],
            extremes: arena.extremes,
            kinds,
            shown,
            predictors,
            groups,
            notes,
        }
    }
}
