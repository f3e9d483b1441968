//! The report as an HTML page.
//!
//! 1. `summary`: skill, seeds and remarks.
//! 2. `errors`: free-rollout and one-step errors over the frames ahead.
//! 3. `physics`: density, kinetic energy, centre of mass, share outside the walls.
//! 4. `settled`: slow and settled states in long rollouts.
//! 5. `pictures`: pictures of rollouts (Fig. 7).
//! 6. `kinds`: results by kind of scene and by material.
//! 7. `by_scene`: the paper's Tables 2 and 3, and its curves of single scenes (Figs. 4, 8 and 9).
//! 8. `cost`: time per frame.
//! 9. `reliability`: how well estimates of errors hold.
//! 10. `reproduce`: command, data and settings.

mod by_scene;
mod cost;
mod errors;
mod kinds;
mod physics;
mod pictures;
mod reliability;
mod reproduce;
mod settled;
mod summary;

use std::io;

use super::{Entry, Report, Role};
use crate::Interval;
use eddy_frames::counted;
use eddy_pages::{Axis, Page, Series, Table};

/// The horizontal axis of most plots.
const AHEAD: &str = "frames ahead";

impl Report {
    /// The report as an HTML page.
    ///
    /// # Errors
    /// A snapshot without pixels.
    pub fn page(&self) -> io::Result<Page> {
        let lead = format!(
            "{} per predictor over {}: every predictor continues from its own output and is \
             compared with the truth for {} of {} ms.",
            counted(self.windows as u64, "free rollout"),
            counted(self.streams as u64, "unseen stream"),
            counted(self.horizon as u64, "frame"),
            rounded(1e3 * f64::from(self.dt)),
        );
        let mut page = Page::new(self.title(), lead);
        let verdict = page.section("Verdict");
        for (name, sentences) in self.verdicts() {
            verdict.paragraph(&format!("{name}: {}", sentences.join(" ")));
        }
        if let Some(winner) = self.winner() {
            verdict.paragraph(&winner);
        }
        self.summary(page.section("Summary"));
        self.error_curves(page.section("Errors over the frames ahead"));
        self.step_errors(page.section("One-step, accumulated and free-rollout error"));
        if self.has_measures() {
            self.physics(page.section("Physical consistency"));
        }
        if self.has_settled() {
            self.settled(page.section("Settled and slow states"));
        }
        if !self.snapshots.1.is_empty() {
            self.pictures(page.section("Truth and prediction"))?;
        }
        self.by_kind(page.section("By kind of scene and by material"));
        self.by_scene(page.section("Scene by scene"));
        if self.has_costs() {
            self.cost(page.section("Inference time"));
        }
        if self.has_estimates() {
            self.reliability(page.section("Estimates of the error"));
        }
        self.reproduce(page.section("Reproduce"));
        Ok(page)
    }

    /// The title with the names of the models.
    fn title(&self) -> String {
        let names: Vec<&str> = self.competing().map(|entry| entry.name.as_str()).collect();
        match names[..] {
            [] => "Evaluation".to_owned(),
            [name] => format!("Evaluation of {name}"),
            [first, second] => format!("Evaluation of {first} and {second}"),
            [first, ..] => format!("Evaluation of {first} and {} more models", names.len() - 1),
        }
    }

    /// All predictors but the truth, whose errors are zero.
    fn fallible(&self) -> impl Iterator<Item = &Entry> {
        self.predictors.iter().filter(|entry| entry.role != Role::Truth)
    }

    /// Predictors whose skill is meaningful.
    pub(super) fn skilled(&self) -> impl Iterator<Item = &Entry> {
        self.fallible().filter(|entry| entry.role != Role::Mean)
    }

    /// Whether physical measures were computed.
    pub(super) fn has_measures(&self) -> bool {
        self.predictors.iter().any(|entry| !entry.measures.is_empty())
    }

    /// Whether predictors were timed.
    pub(super) fn has_costs(&self) -> bool {
        self.predictors.iter().any(|entry| entry.cost.is_some())
    }

    /// Whether a model estimates its errors.
    pub(super) fn has_estimates(&self) -> bool {
        self.predictors.iter().any(|entry| !entry.reliability.is_empty())
    }

    /// A table with a column for each frame shown, followed by others.
    fn frame_table(&self, caption: &str, further: &[&str]) -> Table {
        let frames = self.shown.iter().map(|ahead| format!("frame {ahead}"));
        let further = further.iter().map(|&word| word.to_owned());
        Table::new(caption, std::iter::once(String::new()).chain(frames).chain(further))
    }

    /// A curve at the frames shown, formatted.
    fn at_shown(&self, curve: &[f64], format: impl Fn(f64) -> String) -> Vec<String> {
        self.shown.iter().map(|&ahead| format(at(curve, ahead))).collect()
    }

    /// A curve with intervals at the frames shown.
    fn banded(&self, name: &str, curve: &[f64], intervals: Option<&Vec<Interval>>) -> Series {
        let curve = self.drawn(curve);
        let band = |(&ahead, interval): (&usize, &Interval)| {
            [ahead as f64, interval.lower, interval.upper]
        };
        let band = intervals.iter().flat_map(|all| self.shown.iter().zip(*all)).map(band);
        let band = band.filter(|[ahead, ..]| *ahead <= curve.len() as f64).collect();
        Series { band, ..Series::ahead(name, curve) }
    }
}

/// The value of a curve `ahead` frames ahead (from 1); NaN if missing.
pub(super) fn at(curve: &[f64], ahead: usize) -> f64 {
    ahead.checked_sub(1).and_then(|index| curve.get(index)).copied().unwrap_or(f64::NAN)
}

/// A logarithmic axis: errors span decades.
fn error_axis(title: &str) -> Axis {
    Axis::logarithmic(title)
}

fn frames_ahead() -> Axis {
    Axis::linear(AHEAD)
}

/// A formatted number, or a dash for NaN.
pub(super) fn shown(number: f64, format: impl Fn(f64) -> String) -> String {
    if number.is_nan() { "-".to_owned() } else { format(number) }
}

pub(super) fn skill(number: f64) -> String {
    shown(number, |x| if x.abs() < 100.0 { format!("{x:+.3}") } else { format!("{x:+.0}") })
}

pub(super) fn error(number: f64) -> String {
    shown(number, |x| match x.abs() {
        // No exponent for readable magnitudes.
        0.01..10.0 => format!("{x:.4}"),
        0.0 => "0".to_owned(),
        _ => format!("{x:.2e}"),
    })
}

pub(super) fn percent(number: f64) -> String {
    shown(number, |x| format!("{:.1} %", 100.0 * x))
}

pub(super) fn ratio(number: f64) -> String {
    shown(number, |x| format!("{x:.3}"))
}

pub(super) fn milliseconds(number: f64) -> String {
    shown(number, |x| if x < 0.01 { format!("{x:.4}") } else { format!("{x:.3}") })
}

/// A formatted interval, or a dash if missing.
pub(super) fn between(intervals: Option<&Vec<Interval>>, number: usize) -> String {
    let found = intervals.and_then(|all| all.get(number));
    found.map_or("-".to_owned(), |Interval { lower, upper }| {
        shown(lower + upper, |_| format!("{lower:+.3} to {upper:+.3}"))
    })
}

/// Removes the conversion error of a number stored in single precision.
fn rounded(number: f64) -> f64 {
    (1e4 * number).round() / 1e4
}
