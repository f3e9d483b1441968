//! Ranges and ticks of axes.

use std::ops::Range;

use plotters::coord::ranged1d::{KeyPointHint, NoDefaultFormatting, Ranged, ValueFormatter};

/// Scale of an axis.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Scale {
    /// Equal differences have equal lengths.
    #[default]
    Linear,
    /// Equal ratios have equal lengths. Only positive numbers can be shown.
    Logarithmic,
}

/// An axis of a plot.
#[derive(Clone, Debug, Default)]
pub struct Axis {
    /// Title with unit.
    pub title: String,
    /// Scale.
    pub scale: Scale,
}

/// Margin around the data, as a share of its extent.
const MARGIN: f64 = 0.04;
/// Approximate number of ticks.
const TICKS: f64 = 6.0;
/// Minimum number of ticks of a logarithmic axis.
const MIN_TICKS: usize = 3;
/// Maximum number of decades of an axis; smaller values are cut off. A prediction exact up to rounding would compress
/// everything else.
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

    /// Coordinate of a number along the axis: the number or its logarithm. `None` if it cannot be shown.
    pub(super) fn coordinate(&self, number: f64) -> Option<f64> {
        let coordinate = match self.scale {
            Scale::Linear => number,
            Scale::Logarithmic if number > 0.0 => number.log10(),
            Scale::Logarithmic => f64::NAN,
        };
        // Absurd values would compress everything else.
        (coordinate.is_finite() && coordinate.abs() < 1e200).then_some(coordinate)
    }

    /// Ends of an axis that contains these coordinates.
    pub(super) fn ends(&self, coordinates: impl Iterator<Item = f64>) -> Option<[f64; 2]> {
        let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
        for coordinate in coordinates {
            (least, most) = (least.min(coordinate), most.max(coordinate));
        }
        if least > most {
            return None;
        }
        if self.scale == Scale::Logarithmic {
            least = least.max(most - DECADES);
        }
        if self.scale == Scale::Linear && least == 0.0 && most == 0.0 {
            return Some([0.0, 1.0]);
        }
        // A single number is centred.
        let single = match self.scale {
            Scale::Linear => 0.5 * most.abs(),
            Scale::Logarithmic => 0.5,
        };
        let extent = most - least;
        let room = if extent > 0.0 { MARGIN * extent } else { single };
        // An axis that nearly starts at zero starts there.
        let from_zero = self.scale == Scale::Linear && least >= 0.0 && least < 0.35 * most;
        Some([if from_zero { 0.0 } else { least - room }, most + room])
    }

    /// The range of the axis between two ends, with ticks.
    pub(super) fn range(&self, ends: [f64; 2]) -> AxisRange {
        let ticks = match self.scale {
            Scale::Linear => linear(ends),
            Scale::Logarithmic => logarithmic(ends),
        };
        AxisRange { ends, ticks }
    }
}

/// The range of an axis in coordinates, in the form that plotters uses.
#[derive(Clone, Debug)]
pub(super) struct AxisRange {
    ends: [f64; 2],
    /// Coordinates with their labels.
    ticks: Vec<(f64, String)>,
}

impl AxisRange {
    /// Number of labels.
    pub(super) fn labels(&self) -> usize {
        self.ticks.len()
    }
}

impl Ranged for AxisRange {
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

impl ValueFormatter<f64> for AxisRange {
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
            // Plain digits where they need no padding with zeros.
            ..=4.0 if place.abs() < 1e6 => format!("{:.1$}", place + 0.0, digits as usize),
            _ => format!("{:.0e}", place),
        };
        (place, label)
    };
    (0..=count.min(50)).map(tick).collect()
}

/// Powers of ten; on short axes their multiples, and round numbers on very short ones: the coarsest of these with
/// [`MIN_TICKS`].
fn logarithmic(ends: [f64; 2]) -> Vec<(f64, String)> {
    const FACTORS: [&[f64]; 3] = [&[1.0], &[1.0, 2.0, 5.0], &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0]];
    for factors in FACTORS {
        let ticks = multiples(ends, factors);
        if ticks.len() >= MIN_TICKS {
            return ticks;
        }
    }
    let of_number = |(number, label): (f64, String)| (number.log10(), label);
    let numbers = linear(ends.map(|end| 10_f64.powf(end))).into_iter().map(of_number);
    // Ends whose numbers are too large, or too similar, for double precision have none.
    numbers.filter(|(place, _)| (ends[0]..=ends[1]).contains(place)).collect()
}

/// Powers of ten times each factor.
fn multiples([least, most]: [f64; 2], factors: &[f64]) -> Vec<(f64, String)> {
    let every = ((most - least) / (TICKS + 2.0)).ceil().max(1.0) as i32;
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

/// A factor times a power of ten, in its shortest form.
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
            |ends| axis.range(ends).ticks.into_iter().map(|(_, label)| label).collect::<Vec<_>>();
        assert_eq!(words([0.0, 20.8]), ["0", "5", "10", "15", "20"]);
        assert_eq!(words([-0.5, 1.05]), ["-0.5", "0.0", "0.5", "1.0"]);
        assert_eq!(words([0.0, 0.02]), ["0.000", "0.005", "0.010", "0.015", "0.020"]);
        let axis = Axis::logarithmic("y");
        assert_eq!(labels(&axis.range([-4.2, -1.8]).ticks), ["10⁻⁴", "10⁻³", "0.01"]);
        assert_eq!(labels(&axis.range([-0.4, 0.8]).ticks), ["0.5", "1", "2", "5"]);
        // From 1.07 to 3.98, and from 0.65 to 13.
        assert_eq!(labels(&axis.range([0.03, 0.6]).ticks), ["1.5", "2.0", "2.5", "3.0", "3.5"]);
        assert_eq!(labels(&axis.range([-0.19, 1.11]).ticks), ["1", "2", "5", "10"]);
    }

    #[test]
    fn numbers_that_cannot_be_shown_have_no_coordinate() {
        let log = Axis::logarithmic("y");
        assert_eq!([0.0, -1.0, f64::NAN, f64::INFINITY].map(|x| log.coordinate(x)), [None; 4]);
        assert_eq!(log.coordinate(100.0), Some(2.0));
        assert_eq!(Axis::linear("y").coordinate(f64::NEG_INFINITY), None);
        assert_eq!(log.ends(std::iter::empty()), None);
        let linear = Axis { scale: Scale::Linear, ..log.clone() };
        assert_eq!(linear.ends([0.0, 0.0].into_iter()), Some([0.0, 1.0]));
        assert_eq!(linear.ends([4.0].into_iter()), Some([2.0, 6.0]));
        assert_eq!(log.ends([-30.0, 2.0].into_iter()).map(|ends| ends[0] > -12.0), Some(true));
    }

    proptest! {
        #[test]
        fn the_range_contains_every_number_and_has_few_ticks(
            numbers in prop::collection::vec(prop::num::f64::ANY, 1..5), logarithmic: bool,
        ) {
            let axis = if logarithmic { Axis::logarithmic("") } else { Axis::linear("") };
            let places: Vec<f64> = numbers.iter().filter_map(|&x| axis.coordinate(x)).collect();
            let Some(ends) = axis.ends(places.iter().copied()) else {
                prop_assert!(places.is_empty());
                return Ok(());
            };
            prop_assert!(ends[0] < ends[1] && ends.iter().all(|end| end.is_finite()), "{ends:?}");
            let most = places.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            prop_assert!(most <= ends[1], "{places:?} {ends:?}");
            let ticks = axis.range(ends).ticks;
            prop_assert!(ticks.len() <= 20, "{ends:?} {ticks:?}");
        }
    }
}
