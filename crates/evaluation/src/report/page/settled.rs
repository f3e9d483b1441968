//! Settled and slow states: long rollouts from a late frame.

use super::{super::scenes::SceneEntry, Report, Role, error, percent, ratio};
use crate::{Kind, SETTLED_AVERAGED, SETTLED_FRAMES, SETTLED_START, Settled, SettledState};
use eddy_pages::{Section, Table};

/// Mean speed of the truth above which a predictor's is compared with it (domain lengths per second).
const MOVING: f64 = 0.02;
/// Displacement of the truth up to which it rests (spacings).
const RESTING: f64 = 0.05;
/// One-step error below which errors count as equal (spacings).
const EQUAL: f64 = 0.002;

impl Report {
    pub(super) fn settled(&self, section: &mut Section) {
        section.paragraph(&format!(
            "One rollout per stream from frame {SETTLED_START}, when most scenes have slowed down: whether slow matter goes on \
             moving, and matter at rest stays. Speed and energy are means over {SETTLED_AVERAGED} frames; those of the truth are in \
             its own row.",
        ));
        self.settled_tables().iter().for_each(|table| _ = section.table(table));
    }

    /// Whether streams are long enough for such rollouts.
    pub(in super::super) fn has_settled(&self) -> bool {
        self.scenes.iter().any(|scene| !scene.settled.is_empty())
    }

    pub(in super::super) fn settled_tables(&self) -> Vec<Table> {
        let mut tables = vec![self.settled_steps()];
        for frame in SETTLED_FRAMES {
            if self.scenes.iter().any(|scene| self.truth_at(scene, frame).is_some()) {
                tables.extend(self.settled_at(frame));
            }
        }
        tables
    }

    fn settled_steps(&self) -> Table {
        let first = SETTLED_START + 1;
        let caption = format!(
            "One-step error in frames {first} to {} (spacings, RMS)",
            SETTLED_START + SETTLED_FRAMES[0]
        );
        let spacing = f64::from(self.spacing);
        let of = |settled: &Settled| settled.step_rmse / spacing;
        let best = |scene: &SceneEntry| {
            let all = self.predictors.iter().zip(&scene.settled);
            let baselines = all.filter(|(entry, _)| entry.role == Role::Baseline);
            baselines
                .filter_map(|(_, settled)| settled.as_ref().map(of))
                .fold(f64::INFINITY, f64::min)
        };
        let against = format!("largest / best trivial predictor's (below {EQUAL} is equal)");
        let mut table = self.kinds_table(caption, &[&against]);
        for number in self.settled_predictors() {
            let error_in = |scene: &SceneEntry| settled_of(scene, number).map_or(f64::NAN, of);
            let kinds = self.by_kinds(error_in).map(error);
            let ratios =
                self.scenes.iter().map(|scene| error_in(scene).max(EQUAL) / best(scene).max(EQUAL));
            let worst = ratio(largest(ratios.filter(|_| self.has_steps(number))));
            table.row(self.predictors[number].name.as_str(), kinds.chain([worst]));
        }
        table
    }

    /// Whether a predictor makes one-step predictions.
    fn has_steps(&self, number: usize) -> bool {
        let all = self.scenes.iter().filter_map(|scene| settled_of(scene, number));
        all.into_iter().any(|settled| !settled.step_rmse.is_nan())
    }

    fn settled_at(&self, frame: usize) -> [Table; 4] {
        let spacing = f64::from(self.spacing);
        let frames = format!("frames {} to {frame} ahead", frame + 1 - SETTLED_AVERAGED);
        let off = format!("largest deviation, truth above {MOVING}");
        let mut speeds =
            self.kinds_table(format!("Mean speed, {frames} (domain lengths/s)"), &[&off]);
        let mut energies = self
            .kinds_table(format!("Kinetic energy per mass, {frames} (domain lengths²/s²)"), &[]);
        let mut areas = self.kinds_table(format!("Area / true area, frame {frame} ahead"), &[]);
        let mut creep = Table::new(
            format!(
                "Displacement in {frame} frames where the truth moves less than {RESTING} spacings (spacings, RMS)"
            ),
            ["", "mean", "largest", "streams"],
        );
        for number in self.settled_predictors() {
            let name = self.predictors[number].name.as_str();
            let own = |of: fn(&SettledState) -> f64| {
                move |scene: &SceneEntry| state_of(scene, number, frame).map_or(f64::NAN, of)
            };
            let pairs = || {
                self.scenes.iter().filter_map(|scene| {
                    Some((state_of(scene, number, frame)?, self.truth_at(scene, frame)?))
                })
            };
            let moving = pairs().filter(|(_, truth)| truth.speed > MOVING);
            let deviation =
                largest(moving.map(|(state, truth)| (state.speed / truth.speed - 1.0).abs()));
            let kinds = self.by_kinds(own(|state| state.speed)).map(error);
            speeds.row(name, kinds.chain([percent(deviation)]));
            energies.row(name, self.by_kinds(own(|state| state.kinetic_energy)).map(error));
            let relative = |scene: &SceneEntry| {
                let truth = self.truth_at(scene, frame);
                state_of(scene, number, frame)
                    .zip(truth)
                    .map_or(f64::NAN, |(state, truth)| state.area / truth.area)
            };
            areas.row(name, self.by_kinds(relative).map(ratio));
            let resting = pairs().filter(|(_, truth)| truth.moved < RESTING * spacing);
            let moved: Vec<f64> = resting.map(|(state, _)| state.moved / spacing).collect();
            let numbers = [mean(moved.iter().copied()), largest(moved.iter().copied())].map(error);
            creep.row(name, numbers.into_iter().chain([moved.len().to_string()]));
        }
        [speeds, energies, creep, areas]
    }

    /// Indices of the predictors with such rollouts.
    fn settled_predictors(&self) -> impl Iterator<Item = usize> {
        let has = |&number: &usize| self.scenes.iter().any(|s| settled_of(s, number).is_some());
        (0..self.predictors.len()).filter(has)
    }

    fn truth_at<'a>(&self, scene: &'a SceneEntry, frame: usize) -> Option<&'a SettledState> {
        let truth = self.predictors.iter().position(|entry| entry.role == Role::Truth)?;
        state_of(scene, truth, frame)
    }

    /// A table with a column for each kind of scene, followed by others.
    fn kinds_table(&self, caption: String, further: &[&str]) -> Table {
        let kinds = self.kinds.iter().map(|kind| kind.kind.name().to_owned());
        let further = further.iter().map(|&word| word.to_owned());
        Table::new(caption, std::iter::once(String::new()).chain(kinds).chain(further))
    }

    /// The mean over the scenes of each kind; scenes where it is NaN do not count.
    fn by_kinds(&self, of: impl Fn(&SceneEntry) -> f64) -> impl Iterator<Item = f64> {
        self.kinds.iter().map(move |kind| {
            let kind: Kind = kind.kind;
            mean(self.scenes.iter().filter(|scene| scene.kind == kind).map(&of))
        })
    }
}

fn settled_of(scene: &SceneEntry, number: usize) -> Option<&Settled> {
    scene.settled.get(number)?.as_ref()
}

fn state_of(scene: &SceneEntry, number: usize, frame: usize) -> Option<&SettledState> {
    settled_of(scene, number)?.states.iter().find(|state| state.frame == frame)
}

/// The mean of the numbers that are not NaN; NaN if there are none.
fn mean(numbers: impl Iterator<Item = f64>) -> f64 {
    let (sum, count) = numbers
        .filter(|number| !number.is_nan())
        .fold((0.0, 0.0), |(sum, count), number| (sum + number, count + 1.0));
    sum / count
}

/// The largest number; NaN if there are none.
fn largest(numbers: impl Iterator<Item = f64>) -> f64 {
    numbers.fold(f64::NAN, f64::max)
}
