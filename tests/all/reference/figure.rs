//! The README's plot, drawn from the table in `checkpoints/README.md`, which names the commands behind its numbers.

use std::{fmt::Write as _, fs};

use super::root;

/// Rows of the table that are drawn as curves: first cell, label, colour, vertical shift of the label (pixels).
const CURVES: [(&str, &str, &str, f64); 4] = [
    ("this model, mean of five kinds", "shipped model", "#0072b2", 6.0),
    ("MPM restarted from the same frames", "MPM restarted", "#d55e00", 0.0),
    ("MPM on half the grid", "MPM on half the grid", "#e69f00", -4.0),
    ("truth with initial positions displaced by 1e-4", "truth, displaced by 1e-4", "#777777", 0.0),
];

const WIDTH: f64 = 760.0;
const HEIGHT: f64 = 300.0;
/// Margins of the plot: left, top, right, bottom (pixels).
const MARGIN: [f64; 4] = [52.0, 16.0, 210.0, 44.0];

/// The numbers of the first row with this name.
fn row(table: &str, name: &str) -> Vec<f64> {
    let line = table.lines().find(|line| line.starts_with(&format!("| {name} |")));
    let line = line.unwrap_or_else(|| panic!("no row `{name}`"));
    line.split('|').skip(2).filter_map(|cell| cell.trim().parse().ok()).take(6).collect()
}

/// Position of a frame and a skill (pixels); frames on a logarithmic scale.
fn place(frame: f64, skill: f64) -> (f64, f64) {
    let [left, top, right, bottom] = MARGIN;
    let x = left + frame.log(100.0) * (WIDTH - left - right);
    (x, top + (1.0 - skill) * (HEIGHT - top - bottom))
}

/// The plot as SVG.
pub fn svg() -> String {
    let table = fs::read_to_string(root().join("checkpoints/README.md")).unwrap();
    let header = table.lines().find(|line| line.starts_with("| | frame 1 |")).unwrap();
    let frames = header.replace("frame ", "");
    let frames: Vec<f64> = frames.split('|').filter_map(|cell| cell.trim().parse().ok()).collect();
    assert_eq!(frames.len(), 6, "{header}");
    let mut svg = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" font-family=\"sans-serif\" font-size=\"13\">\n\
         <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/>\n"
    );
    let mut line = |from: (f64, f64), to: (f64, f64), color: &str| {
        let ((x1, y1), (x2, y2)) = (from, to);
        writeln!(
            svg,
            "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" stroke=\"{color}\"/>"
        )
        .unwrap();
    };
    for skill in [0.0, 0.25, 0.5, 0.75, 1.0] {
        line(
            place(1.0, skill),
            place(100.0, skill),
            if skill == 0.0 { "#333333" } else { "#dddddd" },
        );
    }
    let mut words = |(x, y): (f64, f64), anchor: &str, color: &str, text: &str| {
        writeln!(svg, "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" fill=\"{color}\">{text}</text>").unwrap();
    };
    for skill in [0.0, 0.5, 1.0] {
        let (x, y) = place(1.0, skill);
        words((x - 8.0, y + 4.0), "end", "#333333", &format!("{skill}"));
    }
    for &frame in &frames {
        let (x, y) = place(frame, 0.0);
        words((x, y + 18.0), "middle", "#333333", &format!("{frame}"));
    }
    let (middle, bottom) = (place(10.0, 0.0).0, HEIGHT - 8.0);
    words(
        (middle, bottom),
        "middle",
        "#333333",
        "frames ahead (16 ms each); skill: 1 perfect, 0 the best trivial predictor",
    );
    for (name, label, color, shift) in CURVES {
        let skills = row(&table, name);
        assert_eq!(skills.len(), frames.len(), "{name}");
        let points: Vec<_> =
            frames.iter().zip(&skills).map(|(&frame, &skill)| place(frame, skill)).collect();
        let path: Vec<_> = points.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
        writeln!(
            svg,
            "<polyline points=\"{}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"2\"/>",
            path.join(" ")
        )
        .unwrap();
        for (x, y) in &points {
            writeln!(svg, "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"3\" fill=\"{color}\"/>")
                .unwrap();
        }
        let (x, y) = points[points.len() - 1];
        let last = skills[skills.len() - 1];
        let y = y + 4.0 + shift;
        writeln!(
            svg,
            "<text x=\"{:.1}\" y=\"{y:.1}\" fill=\"{color}\">{last:.2} {label}</text>",
            x + 8.0
        )
        .unwrap();
    }
    svg + "</svg>\n"
}
