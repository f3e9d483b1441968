//! Styles of series: colour, dashes and mark, each sufficient to distinguish them.

use maud::{Markup, html};
use plotters::style::RGBColor;

/// Colours of series, from the palette of Okabe and Ito ("Color Universal Design", 2008) without its yellow, which is
/// too light for print, then wine and olive of Tol's muted scheme ("Colour Schemes", 2021) and a grey: as many as a study
/// has networks and baselines. `page.css` has the dashes of each and its replacement in dark mode.
pub(super) const COLORS: [RGBColor; 10] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(230, 159, 0),
    RGBColor(86, 180, 233),
    INK,
    RGBColor(136, 34, 85),
    RGBColor(153, 153, 51),
    RGBColor(136, 136, 136),
];
/// Text.
pub(super) const INK: RGBColor = RGBColor(30, 30, 30);
/// Axes.
pub(super) const AXIS: RGBColor = RGBColor(90, 90, 90);
/// Grid lines.
pub(super) const PALE: RGBColor = RGBColor(222, 222, 222);

/// The shape of a mark.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Mark {
    Disc,
    Square,
    Triangle,
    Diamond,
    Cross,
    Plus,
    Bar,
    Dash,
    Nabla,
    Hourglass,
}

const MARKS: [Mark; 10] = [
    Mark::Disc,
    Mark::Square,
    Mark::Triangle,
    Mark::Diamond,
    Mark::Cross,
    Mark::Plus,
    Mark::Bar,
    Mark::Dash,
    Mark::Nabla,
    Mark::Hourglass,
];

/// How a series is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Style {
    /// Its colour, which also selects the dashes.
    pub(super) color: RGBColor,
    /// The shape of its marks.
    pub(super) mark: Mark,
    /// Line width (drawing units): wider for the first ten series.
    pub(super) width: u32,
}

impl Style {
    /// The style of series `number`: ten colours and ten marks, shifted by one every ten series, so that 100 series
    /// differ.
    pub(super) fn of(number: usize) -> Self {
        let (round, place) = (number / COLORS.len(), number % COLORS.len());
        let mark = MARKS[(place + round) % MARKS.len()];
        Self { color: COLORS[place], mark, width: if round == 0 { 4 } else { 2 } }
    }

    /// The colour as in CSS.
    pub(super) fn hex(self) -> String {
        let RGBColor(red, green, blue) = self.color;
        format!("#{red:02X}{green:02X}{blue:02X}")
    }

    /// A line with a mark, for a legend.
    pub(super) fn sample(self, line: bool) -> Markup {
        let color = self.hex();
        let corners: Vec<String> =
            self.mark.outline([17.0, 7.0], 4.5).iter().map(|[x, y]| format!("{x},{y}")).collect();
        html! {
            svg.sample viewBox="0 0 34 14" aria-hidden="true" {
                @if line {
                    polyline fill="none" stroke=(color) stroke-width=(self.width / 2) points="0,7 34,7" {}
                }
                polygon fill=(color) points=(corners.join(" ")) {}
            }
        }
    }
}

impl Mark {
    /// Corners of the mark around a point, in the units of `radius`.
    pub(super) fn outline(self, [x, y]: [f64; 2], radius: f64) -> Vec<[f64; 2]> {
        let unit: Vec<[f64; 2]> = match self {
            // Sixteen corners approximate a disc of a few pixels.
            Self::Disc => (0..16)
                .map(|k| (f64::from(k) / 16.0 * std::f64::consts::TAU).sin_cos())
                .map(|(sin, cos)| [0.9 * cos, 0.9 * sin])
                .collect(),
            Self::Square => vec![[-0.8, -0.8], [0.8, -0.8], [0.8, 0.8], [-0.8, 0.8]],
            Self::Triangle => vec![[0.0, -1.1], [1.0, 0.8], [-1.0, 0.8]],
            Self::Diamond => vec![[0.0, -1.2], [0.9, 0.0], [0.0, 1.2], [-0.9, 0.0]],
            Self::Cross => star(std::f64::consts::FRAC_PI_4),
            Self::Plus => star(0.0),
            Self::Bar => vec![[-0.35, -1.2], [0.35, -1.2], [0.35, 1.2], [-0.35, 1.2]],
            Self::Dash => vec![[-1.2, -0.35], [1.2, -0.35], [1.2, 0.35], [-1.2, 0.35]],
            Self::Nabla => vec![[-1.0, -0.8], [1.0, -0.8], [0.0, 1.1]],
            Self::Hourglass => vec![[-0.9, -1.0], [0.9, -1.0], [-0.9, 1.0], [0.9, 1.0]],
        };
        let round = |number: f64| (10.0 * number).round() / 10.0;
        unit.into_iter().map(|[a, b]| [round(x + radius * a), round(y + radius * b)]).collect()
    }
}

/// A plus with thin arms, rotated by `angle` (rad).
fn star(angle: f64) -> Vec<[f64; 2]> {
    const ARM: [[f64; 2]; 3] = [[0.3, -0.3], [1.2, -0.3], [1.2, 0.3]];
    let turned = |quarter: i32| {
        let (sin, cos) = (angle + f64::from(quarter) * std::f64::consts::FRAC_PI_2).sin_cos();
        ARM.map(|[x, y]| [x * cos - y * sin, x * sin + y * cos])
    };
    (0..4).flat_map(turned).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hundred_series_differ_and_ten_differ_in_both_colour_and_mark() {
        let all: Vec<Style> = (0..100).map(Style::of).collect();
        for (number, style) in all.iter().enumerate() {
            assert!(!all[..number].contains(style), "{number}");
            for other in &all[number - number % COLORS.len()..number] {
                assert!(other.color != style.color && other.mark != style.mark, "{number}");
            }
        }
    }

    #[test]
    fn every_colour_has_dashes_and_a_dark_mode_colour() {
        let sheet = include_str!("page.css");
        for number in 0..COLORS.len() {
            let hex = Style::of(number).hex();
            let stroke = sheet.matches(&format!("[stroke=\"{hex}\"]")).count();
            assert!(stroke >= 1, "{hex}: {stroke}");
            assert!(sheet.contains(&format!("[fill=\"{hex}\"]")), "{hex}");
        }
    }
}
