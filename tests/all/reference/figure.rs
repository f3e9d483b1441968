//! The README's plot, drawn from the table in `docs/src/background/other_simulators.md`, which names the commands behind its
//! numbers: error against the time of a predicted frame.

use std::{fmt::Write as _, fs};

use super::root;

/// A line of the plot.
struct Series {
    label: &'static str,
    colour: &'static str,
    /// Corners of its marks; none: circles.
    corners: &'static [[f64; 2]],
    /// Rows of the table (first cells), whose points are joined; the last one is filled.
    rows: &'static [&'static str],
}

const SERIES: [Series; 6] = [
    Series {
        label: "eddy: trained for 6, 16, 35 minutes",
        colour: "#0072b2",
        corners: &[],
        rows: &["eddy, six minutes", "eddy, 16 minutes", "**eddy, 35 minutes**"],
    },
    Series {
        label: "MPM restarted: on a quarter of the grid, half, all",
        colour: "#d55e00",
        corners: &SQUARE,
        rows: &["MPM on a quarter of the grid", "MPM on half the grid", "MPM restarted"],
    },
    Series {
        label: "MPM with half the substeps",
        colour: "#e69f00",
        corners: &SQUARE,
        rows: &["MPM with half the substeps"],
    },
    Series {
        label: "NeuralMPM: 6 and 16 minutes",
        colour: "#009e73",
        corners: &UP,
        rows: &["NeuralMPM", "NeuralMPM, 16 minutes"],
    },
    Series {
        label: "Transolver: 6 and 16 minutes",
        colour: "#cc79a7",
        corners: &DIAMOND,
        rows: &["Transolver", "Transolver, 16 minutes"],
    },
    Series {
        label: "GNS: 6 and 16 minutes",
        colour: "#56b4e9",
        corners: &DOWN,
        rows: &["GNS", "GNS, 16 minutes"],
    },
];
/// Corners of marks, relative to [`RADIUS`].
const SQUARE: [[f64; 2]; 4] = [[-0.9, -0.9], [0.9, -0.9], [0.9, 0.9], [-0.9, 0.9]];
const DIAMOND: [[f64; 2]; 4] = [[0.0, -1.3], [1.3, 0.0], [0.0, 1.3], [-1.3, 0.0]];
const UP: [[f64; 2]; 3] = [[0.0, -1.2], [1.2, 0.9], [-1.2, 0.9]];
const DOWN: [[f64; 2]; 3] = [[0.0, 1.2], [1.2, -0.9], [-1.2, -0.9]];
/// Radius of a mark (pixels).
const RADIUS: f64 = 4.0;
/// Frames ahead, one panel each.
const PANELS: [&str; 3] = ["1", "20", "100"];

const WIDTH: f64 = 820.0;
const HEIGHT: f64 = 376.0;
/// Of the first panel: left, top, width, height; and the distance to the next one (pixels).
const PANEL: [f64; 4] = [64.0, 28.0, 228.0, 220.0];
const NEXT: f64 = 252.0;
/// Of the legend: left, top, width of a column, height of a row (pixels).
const LEGEND: [f64; 4] = [64.0, 312.0, 350.0, 20.0];
/// The axes, which are logarithmic: milliseconds of a frame on one thread, and squared errors relative to the best trivial
/// predictor.
const COST: [f64; 2] = [0.5, 3000.0];
const ERROR: [f64; 2] = [0.04, 12.0];

/// Place of a value on a logarithmic axis, 0 to 1.
fn along([low, high]: [f64; 2], value: f64) -> f64 {
    assert!((low..=high).contains(&value), "{value} is outside the axis {low}..{high}");
    (value / low).ln() / (high / low).ln()
}

/// Place of a point of a panel (pixels).
fn place(panel: usize, cost: f64, error: f64) -> [f64; 2] {
    let [left, top, width, height] = PANEL;
    [
        left + panel as f64 * NEXT + along(COST, cost) * width,
        top + (1.0 - along(ERROR, error)) * height,
    ]
}

fn cells(line: &str) -> Vec<&str> {
    line.split('|').map(|cell| cell.trim().trim_matches('*')).collect()
}

/// Marks with these corners around points, the last one filled.
fn marks(svg: &mut String, points: &[[f64; 2]], corners: &[[f64; 2]], colour: &str) {
    for (number, [x, y]) in points.iter().enumerate() {
        let fill = if number + 1 == points.len() { colour } else { "#ffffff" };
        let paint = format!("fill=\"{fill}\" stroke=\"{colour}\" stroke-width=\"1.5\"");
        if corners.is_empty() {
            writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"{RADIUS}\" {paint}/>").unwrap();
        } else {
            let corner =
                |[dx, dy]: &[f64; 2]| format!("{:.1},{:.1}", x + RADIUS * dx, y + RADIUS * dy);
            let corners: Vec<_> = corners.iter().map(corner).collect();
            writeln!(svg, "<polygon points=\"{}\" {paint}/>", corners.join(" ")).unwrap();
        }
    }
}

/// The plot as SVG.
#[expect(clippy::too_many_lines, reason = "the parts of one plot, one after another")]
pub fn svg() -> String {
    let page = fs::read_to_string(root().join("docs/src/background/other_simulators.md")).unwrap();
    let line = |first: &str| {
        let found = page.lines().find(|line| {
            let rest = line.strip_prefix("| ").and_then(|line| line.strip_prefix(first));
            rest.is_some_and(|rest| rest.starts_with([' ', '|']))
        });
        found.unwrap_or_else(|| panic!("no row `{first}`"))
    };
    let header = cells(line("skill at frame"));
    let column = |name: &str| header.iter().position(|cell| *cell == name).unwrap();
    let value = |row: &str, name: &str| -> f64 {
        let row = cells(line(row));
        row[column(name)]
            .replace(',', "")
            .parse()
            .unwrap_or_else(|_| panic!("{row:?}: no number under `{name}`"))
    };
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"sans-serif\" font-size=\"13\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n"
    );
    let mut words = |[x, y]: [f64; 2], anchor: &str, text: &str| {
        writeln!(
            svg,
            "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" fill=\"#333333\">{text}</text>"
        )
        .unwrap();
    };
    let [left, top, width, height] = PANEL;
    let [legend_left, legend_top, legend_width, legend_row] = LEGEND;
    let legend = |number: usize| {
        [
            legend_left + (number % 2) as f64 * legend_width,
            legend_top + (number / 2) as f64 * legend_row,
        ]
    };
    for (error, text) in [(0.1, ".1"), (1.0, "1"), (10.0, "10")] {
        let [x, y] = place(0, COST[0], error);
        words([x - 6.0, y + 4.0], "end", text);
    }
    let [x, y] = place(PANELS.len() - 1, COST[1], 1.0);
    words([x - 4.0, y - 5.0], "end", "best trivial predictor");
    for (panel, frames) in PANELS.iter().enumerate() {
        let middle = left + panel as f64 * NEXT + width / 2.0;
        let plural = if *frames == "1" { "" } else { "s" };
        words([middle, top - 10.0], "middle", &format!("{frames} frame{plural} ahead"));
        for cost in [1.0, 10.0, 100.0, 1000.0] {
            let [x, y] = place(panel, cost, ERROR[0]);
            words([x, y + 16.0], "middle", &cost.to_string());
        }
    }
    words(
        [left + NEXT + width / 2.0, top + height + 36.0],
        "middle",
        "ms for a frame of 2,500 particles on one CPU thread (filled: the longest training, all of the grid)",
    );
    for (number, Series { label, .. }) in SERIES.iter().enumerate() {
        let [x, y] = legend(number);
        words([x + 12.0, y + 4.0], "start", label);
    }
    let (x, y) = (16.0, top + height / 2.0);
    writeln!(
        svg,
        "<text transform=\"translate({x:.1},{y:.1}) rotate(-90)\" text-anchor=\"middle\" fill=\"#333333\">squared error / best trivial predictor</text>"
    )
    .unwrap();
    for panel in 0..PANELS.len() {
        for (error, colour) in
            [(0.1, "#dddddd"), (1.0, "#333333"), (10.0, "#dddddd"), (ERROR[0], "#dddddd")]
        {
            let ([x1, y], [x2, _]) = (place(panel, COST[0], error), place(panel, COST[1], error));
            writeln!(svg, "<line x1=\"{x1:.1}\" y1=\"{y:.1}\" x2=\"{x2:.1}\" y2=\"{y:.1}\" stroke=\"{colour}\"/>").unwrap();
        }
    }
    for (number, Series { colour, corners, rows, .. }) in SERIES.iter().enumerate() {
        marks(&mut svg, &[legend(number)], corners, colour);
        for (panel, frames) in PANELS.iter().enumerate() {
            let at = |row| place(panel, value(row, "CPU, ms"), 1.0 - value(row, frames));
            let points: Vec<_> = rows.iter().copied().map(at).collect();
            if points.len() > 1 {
                let path: Vec<_> = points.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
                let path = path.join(" ");
                writeln!(svg, "<polyline points=\"{path}\" fill=\"none\" stroke=\"{colour}\"/>")
                    .unwrap();
            }
            marks(&mut svg, &points, corners, colour);
        }
    }
    svg + "</svg>\n"
}
