//! Values of a plot that the page shows under the pointer.

use super::{Axis, LinePlot, Scale, Series, style::Style};

/// Approximate maximum number of points of a series whose values are shown under the pointer.
const HOVER_POINTS: usize = 100;

impl LinePlot {
    /// The values that the page shows under the pointer, as lines of fields separated by tabs. For each axis: title, `linear`
    /// or `log`, its ends in pixels, its ends in coordinates. For each series: name, colour, `line` or `scatter`, its points
    /// as `x,y`.
    pub(super) fn values(&self, coordinates: [[f64; 2]; 2], pixels: [[i32; 2]; 2]) -> String {
        let word = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(" ");
        let axis = |(axis, ([low, high], [from, to])): (&Axis, ([f64; 2], [i32; 2]))| {
            let scale = match axis.scale {
                Scale::Linear => "linear",
                Scale::Logarithmic => "log",
            };
            format!("{}\t{scale}\t{from}\t{to}\t{low}\t{high}", word(&axis.title))
        };
        let axes = [&self.x, &self.y].into_iter().zip(coordinates.into_iter().zip(pixels));
        let shown =
            |&&[x, y]: &&[f64; 2]| self.x.coordinate(x).is_some() && self.y.coordinate(y).is_some();
        let series = |(number, series): (usize, &Series)| {
            let points: Vec<&[f64; 2]> = series.points.iter().filter(shown).collect();
            let every = points.len().div_ceil(HOVER_POINTS).max(1);
            let last = points.len().saturating_sub(1);
            let chosen = points.iter().enumerate().filter(|(k, _)| k % every == 0 || *k == last);
            let chosen = chosen.map(|(_, [x, y])| format!("{},{}", brief(*x), brief(*y)));
            let kind = if series.scattered { "scatter" } else { "line" };
            let color = Style::of(number).hex();
            let chosen = chosen.collect::<Vec<_>>().join(" ");
            (!chosen.is_empty())
                .then(|| format!("{}\t{color}\t{kind}\t{chosen}", word(&series.name)))
        };
        let series = self.series.iter().enumerate().filter_map(series);
        axes.map(axis).chain(series).collect::<Vec<_>>().join("\n")
    }
}

/// A number with four significant digits, in its shortest form.
fn brief(number: f64) -> String {
    let [plain, rounded] = [number.to_string(), format!("{number:.3e}")];
    if plain.len() <= rounded.len() { plain } else { rounded }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_values_under_the_pointer_are_where_they_are_drawn() {
        let points = (1..=250).map(|x| [f64::from(x), 1.0 / f64::from(x)]).collect();
        let plot = LinePlot {
            title: "t".into(),
            x: Axis::linear("frames"),
            y: Axis::logarithmic("error"),
            series: vec![Series { name: "a < b".into(), points, ..Series::default() }],
        };
        let svg = plot.svg().unwrap();
        let (_, values) = svg.split_once("data-plot=\"").unwrap();
        let values = values.split_once('"').unwrap().0.replace("&lt;", "<");
        let [x, y, series] = values.lines().collect::<Vec<_>>()[..] else { panic!("{values}") };
        let fields = |line: &str| line.split('\t').map(str::to_owned).collect::<Vec<_>>();
        assert_eq!(
            (&fields(x)[..2], &fields(y)[1]),
            (&["frames".into(), "linear".into()][..], &"log".to_owned())
        );
        let series = fields(series);
        assert_eq!(series[..3], ["a < b", "#0072B2", "line"]);
        let pairs: Vec<&str> = series[3].split(' ').collect();
        assert!((80..=HOVER_POINTS + 1).contains(&pairs.len()), "{}", pairs.len());
        assert_eq!((pairs[0], pairs[1], pairs[pairs.len() - 1]), ("1,1", "4,0.25", "250,0.004"));
        // The first point of the line.
        let (_, line) = svg.split_once("stroke=\"#0072B2\"").unwrap();
        let (_, line) = line.split_once("points=\"").unwrap();
        let first: Vec<f64> =
            line.split_once(' ').unwrap().0.split(',').map(|word| word.parse().unwrap()).collect();
        let pixel = |line: &str, coordinate: f64| {
            let ends: Vec<f64> = fields(line)[2..].iter().map(|end| end.parse().unwrap()).collect();
            ends[0] + (ends[1] - ends[0]) * (coordinate - ends[2]) / (ends[3] - ends[2])
        };
        for (line, coordinate, drawn) in [(x, 1.0, first[0]), (y, 0.0, first[1])] {
            assert!((pixel(line, coordinate) - drawn).abs() <= 2.0, "{line}: {drawn}");
        }
    }
}
