//! Where an axis begins and ends, and its ticks.

use std::ops::Range;

use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, Ranged, ValueFormatter};

/// How numbers are laid out along an axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scale {
    /// Equal differences have equal lengths.
    #[default]
    Linear,
    /// Equal ratios have equal lengths. Only positive numbers have a place.
    Logarithmic,
}

/// An axis of a plot.
#[derive(Clone, Debug, Default)]
pub struct Axis {
    /// What it shows, with its unit.
    pub title: String,
    /// How numbers are laid out.
    pub scale: Scale,
}

/// Room beyond the data, as a share of its extent.
const ROOM: f64 = 0.04;
/// About so many ticks are wanted.
const TICKS: f64 = 6.0;
/// The most decades whose ticks are also at 2 and 5.
const FINE_DECADES: f64 = 1.6;
/// The most decades of an axis: what is smaller falls off its lower end. A prediction that is exact up to
/// rounding would squeeze everything else.
const DECADES: f64 = 12.0;

impl Axis {
    /// A linear axis.
    pub fn linear(title: impl Into<String>) -> Self {
        Self { title: title.into(), scale: Scale::Linear }
    }

    /// A logarithmic axis.
    pub fn logarithmic(title: impl Into<String>) -> Self {
        Self { title: title.into(), scale: Scale::Logarithmic }
    }

    /// Where a number is along the axis, in units of its own; nothing for what has no place.
    pub(super) fn place(&self, number: f64) -> Option<f64> {
        let place = match self.scale {
            Scale::Linear => number,
            Scale::Logarithmic if number > 0.0 => number.log10(),
            Scale::Logarithmic => f64::NAN,
        };
        // What is further away than any measurement would leave nothing of the rest.
        (place.is_finite() && place.abs() < 1e200).then_some(place)
    }

    /// Ends of an axis that holds these places.
    pub(super) fn ends(&self, places: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
        let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
        for place in places {
            (least, most) = (least.min(place), most.max(place));
        }
        if least > most {
            return None;
        }
        if self.scale == Scale::Logarithmic {
            least = least.max(most - DECADES);
        }
        // A single number stands in the middle.
        let lonely = match self.scale {
            Scale::Linear => 0.5 * most.abs().max(f64::MIN_POSITIVE * 1e20),
            Scale::Logarithmic => 0.5,
        };
        let extent = most - least;
        let room = if extent > 0.0 { ROOM * extent } else { lonely };
        // An axis that nearly begins at zero does.
        let from_zero = self.scale == Scale::Linear && least >= 0.0 && least < 0.35 * most;
        Some([if from_zero { 0.0 } else { least - room }, most + room])
    }

    /// The axis between two ends.
    pub(super) fn ruler(&self, ends: [f64; 2]) -> Ruler {
        let ticks = match self.scale {
            Scale::Linear => linear(ends),
            Scale::Logarithmic => logarithmic(ends),
        };
        Ruler { ends, ticks }
    }
}

/// An axis between two ends, as plotters asks for it: it has places, not numbers.
#[derive(Clone, Debug)]
pub(super) struct Ruler {
    ends: [f64; 2],
    /// Places with their labels.
    ticks: Vec<(f64, String)>,
}

impl Ruler {
    /// How many labels there are.
    pub(super) fn labels(&self) -> usize {
        self.ticks.len()
    }
}

impl Ranged for Ruler {
    type FormatOption = NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, place: &f64, (first, last): (i32, i32)) -> i32 {
        let [least, most] = self.ends;
        first + ((place - least) / (most - least) * f64::from(last - first)).round() as i32
    }

    fn key_points<Hint: KeyPointHint>(&self, _: Hint) -> Vec<f64> {
        self.ticks.iter().map(|(place, _)| *place).collect()
    }

    fn range(&self) -> Range<f64> {
        self.ends[0]..self.ends[1]
    }
}

impl ValueFormatter<f64> for Ruler {
    fn format_ext(&self, place: &f64) -> String {
        let label = self.ticks.iter().find(|(at, _)| at == place);
        label.map_or(String::new(), |(_, label)| label.clone())
    }
}

/// Multiples of 1, 2 or 5 times a power of ten.
fn linear([least, most]: [f64; 2]) -> Vec<(f64, String)> {
    let rough = (most - least) / TICKS;
    let power = rough.log10().floor();
    let unit = 10_f64.powf(power);
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().find(|step| step * unit >= rough).unwrap_or(10.0);
    let step = step * unit;
    let digits = (-(step * 1.000_001).log10().floor()).max(0.0);
    let first = (least / step).ceil();
    let count = ((most / step).floor() - first).max(0.0) as usize;
    let tick = |number: usize| {
        let place = (first + number as f64) * step;
        let label = match digits {
            // Neither a row of zeros before the digits nor one after them.
            ..=4.0 if place.abs() < 1e6 => format!("{:.1$}", place + 0.0, digits as usize),
            _ => format!("{:.0e}", place),
        };
        (place, label)
    };
    (0..=count.min(50)).map(tick).collect()
}

/// Powers of ten, and 2 and 5 times those where there are few.
fn logarithmic([least, most]: [f64; 2]) -> Vec<(f64, String)> {
    let decades = most - least;
    let factors: &[f64] = if decades <= FINE_DECADES { &[1.0, 2.0, 5.0] } else { &[1.0] };
    let every = (decades / (TICKS + 2.0)).ceil().max(1.0) as i32;
    let mut ticks = Vec::new();
    for power in least.floor() as i32..=most.ceil() as i32 {
        if power.rem_euclid(every) != 0 {
            continue;
        }
        for &factor in factors {
            let place = f64::from(power) + factor.log10();
            if (least..=most).contains(&place) {
                ticks.push((place, power_of_ten(factor, power)));
            }
        }
    }
    ticks
}

/// A factor times a power of ten, the shortest way.
fn power_of_ten(factor: f64, power: i32) -> String {
    match power {
        -2..=3 => {
            let digits = (-power).max(0) as usize;
            format!("{:.digits$}", factor * 10_f64.powi(power))
        }
        _ if factor == 1.0 => format!("10{}", superscript(power)),
        _ => format!("{factor}·10{}", superscript(power)),
    }
}

fn superscript(number: i32) -> String {
    const DIGITS: [char; 10] = ['⁰', '¹', '²', '³', '⁴', '⁵', '⁶', '⁷', '⁸', '⁹'];
    let raised = |c: char| c.to_digit(10).map_or('⁻', |digit| DIGITS[digit as usize]);
    number.to_string().chars().map(raised).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn labels(ticks: &[(f64, String)]) -> Vec<&str> {
        ticks.iter().map(|(_, label)| label.as_str()).collect()
    }

    #[test]
    fn ticks_are_round_numbers() {
        let axis = Axis::linear("x");
        let words =
            |ends| axis.ruler(ends).ticks.into_iter().map(|(_, label)| label).collect::<Vec<_>>();
        assert_eq!(words([0.0, 20.8]), ["0", "5", "10", "15", "20"]);
        assert_eq!(words([-0.5, 1.05]), ["-0.5", "0.0", "0.5", "1.0"]);
        assert_eq!(words([0.0, 0.02]), ["0.000", "0.005", "0.010", "0.015", "0.020"]);
        let axis = Axis::logarithmic("y");
        assert_eq!(labels(&axis.ruler([-4.2, -1.8]).ticks), ["10⁻⁴", "10⁻³", "0.01"]);
        assert_eq!(labels(&axis.ruler([-0.4, 0.8]).ticks), ["0.5", "1", "2", "5"]);
    }

    #[test]
    fn what_has_no_place_is_left_out() {
        let log = Axis::logarithmic("y");
        assert_eq!([0.0, -1.0, f64::NAN, f64::INFINITY].map(|x| log.place(x)), [None; 4]);
        assert_eq!(log.place(100.0), Some(2.0));
        assert_eq!(Axis::linear("y").place(f64::NEG_INFINITY), None);
        assert_eq!(log.ends(std::iter::empty()), None);
        assert_eq!(log.ends([-30.0, 2.0].into_iter()).map(|ends| ends[0] > -12.0), Some(true));
    }

    proptest! {
        #[test]
        fn every_number_is_within_the_ends_and_few_ticks_are(
            numbers in prop::collection::vec(prop::num::f64::ANY, 1..5), logarithmic: bool,
        ) {
            let axis = if logarithmic { Axis::logarithmic("") } else { Axis::linear("") };
            let places: Vec<f64> = numbers.iter().filter_map(|&x| axis.place(x)).collect();
            let Some(ends) = axis.ends(places.iter().copied()) else {
                prop_assert!(places.is_empty());
                return Ok(());
            };
            prop_assert!(ends[0] < ends[1] && ends.iter().all(|end| end.is_finite()), "{ends:?}");
            let most = places.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            prop_assert!(most <= ends[1], "{places:?} {ends:?}");
            let ticks = axis.ruler(ends).ticks;
            prop_assert!(ticks.len() <= 20, "{ends:?} {ticks:?}");
        }
    }
}
