//! The report as a page.
//!
//! 1. `summary`: who is how good, and what has to be said about it.
//! 2. `paper`: the paper's Tables 2 and 3, and its curves of single scenes (Figs. 4, 8 and 9).
//! 3. `errors`: errors over the frames ahead, free and fed with the truth.
//! 4. `physics`: density, kinetic energy, centre of mass, what is outside.
//! 5. `pictures`: rollouts to look at (Fig. 7).
//! 6. `kinds`: by what scenes and particles are made of.
//! 7. `cost`: time of a frame.
//! 8. `making`: how to make it again.

mod cost;
mod errors;
mod kinds;
mod making;
mod paper;
mod physics;
mod pictures;
mod summary;

use std::io;

use super::{Entry, Report, Role};
use crate::{
    Interval,
    page::{Axis, Page, Series, Table},
};

/// The horizontal axis of most plots.
const AHEAD: &str = "frames ahead";

impl Report {
    /// The report as a page.
    ///
    /// # Errors
    /// A snapshot without pixels.
    pub fn page(&self) -> io::Result<Page> {
        let lead = format!(
            "{} free rollouts of every predictor over {} streams it has not seen: fed with its own output, \
             compared with the truth for {} frames of {} ms.",
            self.windows,
            self.streams,
            self.horizon,
            rounded(1e3 * f64::from(self.dt)),
        );
        let mut page = Page::new(self.title(), lead);
        self.summary(page.section("Summary"));
        self.paper(page.section("Scene by scene: the paper's Tables 2 and 3"));
        self.error_curves(page.section("Errors over the frames ahead"));
        self.ways(page.section("One step, steps added up, free rollout"));
        if self.predictors.iter().any(|entry| !entry.measures.is_empty()) {
            self.physics(page.section("What physics asks for"));
        }
        if !self.snapshots.1.is_empty() {
            self.pictures(page.section("Truth and prediction"))?;
        }
        self.by_kind(page.section("By kind of scene and by material"));
        if self.predictors.iter().any(|entry| entry.cost.is_some()) {
            self.cost(page.section("Time of a frame"));
        }
        self.making(page.section("How to make this again"));
        Ok(page)
    }

    /// Names of the models, or of the groups of seeds they are in.
    fn title(&self) -> String {
        let models = self.predictors.iter().filter(|entry| entry.role == Role::Model);
        let names: Vec<&str> = models.map(|entry| entry.name.as_str()).collect();
        match names[..] {
            [] => "Predictions judged".to_owned(),
            [name] => format!("{name}, judged"),
            [first, second] => format!("{first} and {second}, judged"),
            [first, ..] => format!("{first} and {} more models, judged", names.len() - 1),
        }
    }

    /// Everyone but the truth, which makes no error.
    fn fallible(&self) -> impl Iterator<Item = &Entry> {
        self.predictors.iter().filter(|entry| entry.role != Role::Truth)
    }

    /// Those whose skill says something.
    fn skilled(&self) -> impl Iterator<Item = &Entry> {
        self.fallible().filter(|entry| entry.role != Role::Mean)
    }

    /// A table with a column for each frame shown, and further ones.
    fn frame_table(&self, caption: &str, further: &[&str]) -> Table {
        let frames = self.shown.iter().map(|ahead| format!("frame {ahead}"));
        let further = further.iter().map(|&word| word.to_owned());
        Table::new(caption, std::iter::once(String::new()).chain(frames).chain(further))
    }

    /// A curve at the frames shown, in words.
    fn words_at_shown(&self, curve: &[f64], format: impl Fn(f64) -> String) -> Vec<String> {
        self.shown.iter().map(|&ahead| format(at(curve, ahead))).collect()
    }

    /// A curve with its interval at the frames shown.
    fn banded(&self, name: &str, curve: &[f64], intervals: Option<&Vec<Interval>>) -> Series {
        let band = |(&ahead, interval): (&usize, &Interval)| {
            [ahead as f64, interval.lower, interval.upper]
        };
        let band = intervals.iter().flat_map(|all| self.shown.iter().zip(*all)).map(band);
        Series { band: band.collect(), ..Series::ahead(name, curve) }
    }
}

/// A curve's number `ahead` frames ahead, from 1; NaN where there is none.
pub(super) fn at(curve: &[f64], ahead: usize) -> f64 {
    ahead.checked_sub(1).and_then(|index| curve.get(index)).copied().unwrap_or(f64::NAN)
}

/// An axis of errors: they span decades.
fn of_errors(title: &str) -> Axis {
    Axis::logarithmic(title)
}

fn frames_ahead() -> Axis {
    Axis::linear(AHEAD)
}

/// A number in words that fit; a dash where there is none.
pub(super) fn shown(number: f64, format: impl Fn(f64) -> String) -> String {
    if number.is_nan() { "-".to_owned() } else { format(number) }
}

pub(super) fn skill(number: f64) -> String {
    shown(number, |x| if x.abs() < 100.0 { format!("{x:+.3}") } else { format!("{x:+.0}") })
}

pub(super) fn error(number: f64) -> String {
    shown(number, |x| match x.abs() {
        // As many digits, but no exponent where it can be read without.
        0.01..10.0 => format!("{x:.4}"),
        0.0 => "0".to_owned(),
        _ => format!("{x:.2e}"),
    })
}

pub(super) fn percent(number: f64) -> String {
    shown(number, |x| format!("{:.1} %", 100.0 * x))
}

pub(super) fn milliseconds(number: f64) -> String {
    shown(number, |x| if x < 0.01 { format!("{x:.4}") } else { format!("{x:.3}") })
}

/// An interval in words; a dash where there is none.
pub(super) fn between(intervals: Option<&Vec<Interval>>, number: usize) -> String {
    let found = intervals.and_then(|all| all.get(number));
    found.map_or("-".to_owned(), |Interval { lower, upper }| {
        shown(lower + upper, |_| format!("{lower:+.3} to {upper:+.3}"))
    })
}

/// A number as it was meant, of one that was kept in single precision.
fn rounded(number: f64) -> f64 {
    (1e4 * number).round() / 1e4
}
