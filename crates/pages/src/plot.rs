//! Plots of named curves as SVG.

use std::error::Error;

use maud::{Markup, PreEscaped, html};
use plotters::{
    chart::{ChartBuilder, ChartContext},
    element::Polygon,
    prelude::{
        Cartesian2d, DrawingBackend, IntoDrawingArea as _, IntoFont as _, LineSeries, SVGBackend,
    },
    style::{Color as _, ShapeStyle, TRANSPARENT},
};

use super::{
    Axis,
    scale::AxisRange,
    style::{AXIS, INK, PALE, Style},
};
use crate::picture::{Canvas, CanvasBackend};

/// Width and height of the drawing (drawing units, about half a pixel on a screen).
const SIZE: (u32, u32) = (1120, 700);
/// Font size.
const LETTERS: u32 = 30;
/// Space for labels below and to the left.
const LABELS: (u32, u32) = (84, 124);
/// Radius of a mark.
const MARK: f64 = 9.0;
/// Approximate number of marks on a curve with more points.
const MARKS: usize = 7;
/// Margins above and to the right of the axes: in pages, and in images with title and names.
const PAGE_MARGINS: [u32; 2] = [8, 24];
const IMAGE_MARGINS: [u32; 2] = [44, 300];
/// Height of a line of names in images.
const LINE: i32 = 22;

/// A named curve.
#[derive(Clone, Debug, Default)]
pub struct Series {
    /// Its name in the legend.
    pub name: String,
    /// Its points, in the units of the axes. Numbers that cannot be shown (NaN, zero on a logarithmic axis) are gaps.
    pub points: Vec<[f64; 2]>,
    /// An interval around the curve: x, lower end, upper end.
    pub band: Vec<[f64; 3]>,
    /// Whether to draw points without a line.
    pub scattered: bool,
}

/// Curves on two axes.
#[derive(Clone, Debug, Default)]
pub struct LinePlot {
    /// Title.
    pub title: String,
    /// The horizontal axis.
    pub x: Axis,
    /// The vertical axis.
    pub y: Axis,
    /// The curves. The index gives the style, so the same index looks the same in all plots.
    pub series: Vec<Series>,
}

/// Pixel coordinates.
type Pixel = (i32, i32);
/// What a drawing shows where.
struct Drawn {
    /// The pixel of the last point of each series.
    last: Vec<Option<Pixel>>,
    /// Pixels of the lower and upper end of each axis.
    ends: [[i32; 2]; 2],
}

type Chart<'a, B> = ChartContext<'a, B, Cartesian2d<AxisRange, AxisRange>>;

impl Series {
    /// A curve over 1, 2, 3, ...: one number per frame ahead.
    pub fn ahead(name: impl Into<String>, numbers: &[f64]) -> Self {
        let point = |(index, &number): (usize, &f64)| [(index + 1) as f64, number];
        let points = numbers.iter().enumerate().map(point).collect();
        Self { name: name.into(), points, ..Self::default() }
    }
}

impl LinePlot {
    /// Plots side by side with titles, and one legend if it is the same for all. `None` if all plots are empty.
    pub(super) fn figures(plots: &[Self]) -> Option<Markup> {
        let drawn: Vec<(&Self, String)> =
            plots.iter().filter_map(|plot| Some((plot, plot.svg()?))).collect();
        let legends: Vec<String> =
            drawn.iter().map(|(plot, _)| plot.legend().into_string()).collect();
        let same = legends.len() > 1 && legends.iter().all(|legend| *legend == legends[0]);
        let shared = legends.first().filter(|_| same);
        (!drawn.is_empty()).then(|| {
            html! {
                @if let Some(legend) = shared { (PreEscaped(legend)) }
                div.plots {
                    @for ((plot, svg), legend) in drawn.iter().zip(&legends) {
                        figure.plot {
                            figcaption { (plot.title) }
                            (PreEscaped(svg))
                            @if !same { (PreEscaped(legend)) }
                        }
                    }
                }
            }
        })
    }

    fn legend(&self) -> Markup {
        html! {
            ul.legend {
                @for (number, series) in self.series.iter().enumerate() {
                    @if self.shows(series) {
                        li { (Style::of(number).sample(!series.scattered)) (series.name) }
                    }
                }
            }
        }
    }

    /// The drawing; `None` if no point can be shown.
    pub(super) fn svg(&self) -> Option<String> {
        let ends = self.ends()?;
        let mut svg = String::new();
        // Drawing into memory does not fail.
        let drawn = self.draw(SVGBackend::with_string(&mut svg, SIZE), ends, PAGE_MARGINS).ok()?;
        // The page sets the size; inline SVG needs no namespace.
        let (_, drawing) = svg.split_once('>')?;
        let (width, height) = SIZE;
        let words = format!("{}: {} over {}", self.title, self.y.title, self.x.title);
        let values = self.values(ends, drawn.ends);
        let opening = html! {
            svg viewBox={ "0 0 " (width) " " (height) } role="img" aria-label=(words) data-plot=(values) {}
        };
        let opening = opening.into_string();
        Some(opening.strip_suffix("</svg>")?.to_owned() + drawing)
    }

    /// The plot as an image, with its title and the names of the series beside their last points; `None` if no point
    /// can be shown.
    pub fn canvas(&self) -> Option<Canvas> {
        let ends = self.ends()?;
        let mut canvas = Canvas::new(SIZE.0 as usize, SIZE.1 as usize);
        let Drawn { last, .. } = self.draw(CanvasBackend(&mut canvas), ends, IMAGE_MARGINS).ok()?;
        let area = CanvasBackend(&mut canvas).into_drawing_area();
        let style = ("sans-serif", LETTERS).into_font().color(&INK);
        area.draw_text(&self.title, &style, (LABELS.1 as i32, 12)).ok()?;
        let mut taken = Vec::new();
        for (series, at) in self.series.iter().zip(last) {
            let Some(at) = at else { continue };
            let width = area.estimate_text_size(&series.name, &style).ok()?.0;
            let place = free_place(&mut taken, at, width as i32);
            area.draw_text(&series.name, &style, place).ok()?;
        }
        drop(area);
        Some(canvas)
    }

    /// Ends of both axes; `None` if no point can be shown.
    fn ends(&self) -> Option<[[f64; 2]; 2]> {
        let points = || self.series.iter().flat_map(|series| self.coordinates(&series.points));
        let ends_of_bands = || self.series.iter().flat_map(|series| self.band(&series.band));
        let x = self.x.ends(points().flatten().map(|[x, _]| x))?;
        let within = points().flatten().map(|[_, y]| y);
        let y =
            self.y.ends(within.chain(ends_of_bands().flat_map(|[_, low, high]| [low, high])))?;
        Some([x, y])
    }

    fn shows(&self, series: &Series) -> bool {
        self.coordinates(&series.points).iter().flatten().next().is_some()
    }

    /// The points in coordinates of the axes; `None` if one cannot be shown.
    fn coordinates(&self, points: &[[f64; 2]]) -> Vec<Option<[f64; 2]>> {
        let point = |&[x, y]: &[f64; 2]| Some([self.x.coordinate(x)?, self.y.coordinate(y)?]);
        points.iter().map(point).collect()
    }

    fn band(&self, band: &[[f64; 3]]) -> Vec<[f64; 3]> {
        let interval = |&[x, low, high]: &[f64; 3]| {
            Some([self.x.coordinate(x)?, self.y.coordinate(low)?, self.y.coordinate(high)?])
        };
        band.iter().filter_map(interval).collect()
    }

    /// Draws axes and series.
    fn draw<B: DrawingBackend<ErrorType: 'static>>(
        &self,
        backend: B,
        [x, y]: [[f64; 2]; 2],
        [top, right]: [u32; 2],
    ) -> Result<Drawn, Box<dyn Error>> {
        let root = backend.into_drawing_area();
        let (below, left) = LABELS;
        let (x, y) = (self.x.range(x), self.y.range(y));
        let labels = [&x, &y].map(AxisRange::labels);
        let mut chart = ChartBuilder::on(&root)
            .margin(8)
            .margin_top(top)
            .margin_right(right)
            .x_label_area_size(below)
            .y_label_area_size(left)
            .build_cartesian_2d(x, y)?;
        let letters = ("sans-serif", LETTERS).into_font().color(&INK);
        chart
            .configure_mesh()
            .x_labels(labels[0])
            .y_labels(labels[1])
            .light_line_style(TRANSPARENT)
            .bold_line_style(PALE.stroke_width(2))
            .axis_style(AXIS.stroke_width(2))
            .label_style(letters.clone())
            .axis_desc_style(letters)
            .x_desc(&self.x.title)
            .y_desc(&self.y.title)
            .draw()?;
        for (number, series) in self.series.iter().enumerate() {
            self.draw_band(&mut chart, series, Style::of(number))?;
        }
        for (number, series) in self.series.iter().enumerate() {
            self.draw_series(&mut chart, series, number)?;
        }
        let last = |series: &Series| {
            let [x, y] = self.coordinates(&series.points).into_iter().flatten().next_back()?;
            Some(chart.backend_coord(&(x, y)))
        };
        let last = self.series.iter().map(last).collect();
        let (across, down) = chart.plotting_area().get_pixel_range();
        drop(chart);
        root.present()?;
        Ok(Drawn { last, ends: [[across.start, across.end], [down.end, down.start]] })
    }

    fn draw_band<B: DrawingBackend<ErrorType: 'static>>(
        &self,
        chart: &mut Chart<'_, B>,
        series: &Series,
        style: Style,
    ) -> Result<(), Box<dyn Error>> {
        let band = self.band(&series.band);
        let lower = band.iter().map(|&[x, low, _]| (x, low));
        let upper = band.iter().rev().map(|&[x, _, high]| (x, high));
        let corners: Vec<_> = lower.chain(upper).collect();
        if band.len() > 1 {
            chart.draw_series([Polygon::new(corners, style.color.mix(0.15))])?;
        }
        Ok(())
    }

    fn draw_series<B: DrawingBackend<ErrorType: 'static>>(
        &self,
        chart: &mut Chart<'_, B>,
        series: &Series,
        number: usize,
    ) -> Result<(), Box<dyn Error>> {
        let style = Style::of(number);
        let points = self.coordinates(&series.points);
        if !series.scattered {
            for piece in points.split(Option::is_none).filter(|piece| piece.len() > 1) {
                let line = piece.iter().flatten().map(|&[x, y]| (x, y));
                chart.draw_series(LineSeries::new(line, style.color.stroke_width(style.width)))?;
            }
        }
        let fill: ShapeStyle = style.color.filled();
        // Curves through the same points have their marks at different ones.
        let every = if series.scattered { 1 } else { points.len().div_ceil(MARKS).max(1) };
        let marked = points.iter().skip(number % every).step_by(every).flatten();
        for &[x, y] in marked {
            let (x, y) = chart.backend_coord(&(x, y));
            let corners = style.mark.outline([f64::from(x), f64::from(y)], MARK);
            let corners = corners.iter().map(|[x, y]| (x.round() as i32, y.round() as i32));
            let area = chart.plotting_area().strip_coord_spec();
            let (left, top) = area.get_base_pixel();
            let corners: Vec<_> = corners.map(|(x, y)| (x - left, y - top)).collect();
            area.draw(&Polygon::new(corners, fill))?;
        }
        Ok(())
    }
}

/// Upper left corner of a name of this width beside a point, moved down while it overlaps other names.
fn free_place(taken: &mut Vec<(i32, i32, i32)>, (x, y): (i32, i32), width: i32) -> Pixel {
    let (left, mut top) = (x + 2 * MARK as i32, y - LINE / 2);
    let overlaps = |top: i32| {
        move |&&(from, to, other): &&(i32, i32, i32)| {
            (other - top).abs() < LINE && from < left + width && left < to
        }
    };
    while let Some(&(_, _, other)) = taken.iter().find(overlaps(top)) {
        top = other + LINE;
    }
    taken.push((left, left + width, top));
    (left, top)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn plot(axis: fn(String) -> Axis, points: Vec<[f64; 2]>) -> LinePlot {
        let series = Series { name: "a < b".into(), points, ..Series::default() };
        LinePlot {
            title: "t".into(),
            x: Axis::linear("frames"),
            y: axis("error".into()),
            series: vec![series],
        }
    }

    fn figure(axis: fn(String) -> Axis, points: Vec<[f64; 2]>) -> Option<String> {
        Some(LinePlot::figures(&[plot(axis, points)])?.into_string())
    }

    /// Every coordinate of a picture is on it.
    fn is_within(svg: &str) {
        assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        for list in svg.split("points=\"").skip(1) {
            let (list, _) = list.split_once('"').unwrap();
            for number in list.split([',', ' ']).filter(|word| !word.is_empty()) {
                let number: f64 = number.parse().unwrap();
                assert!((-20.0..=f64::from(SIZE.0)).contains(&number), "{number} in {list}");
            }
        }
    }

    #[test]
    fn without_points_to_show_there_is_no_plot() {
        for points in [vec![], vec![[1.0, f64::NAN]], vec![[f64::INFINITY, 1.0]]] {
            assert_eq!(figure(Axis::linear, points.clone()), None);
            assert_eq!(figure(Axis::logarithmic, points), None);
        }
        assert_eq!(figure(Axis::logarithmic, vec![[1.0, 0.0], [2.0, -1.0]]), None);
    }

    #[test]
    fn an_image_has_its_points_names_and_title() {
        let empty = plot(Axis::logarithmic, vec![[0.0, 1.0]]);
        assert_eq!(plot(Axis::logarithmic, vec![[1.0, -1.0]]).canvas(), None);
        let with_points = plot(Axis::logarithmic, vec![[1.0, 1.0]]);
        let ink = |canvas: &Canvas, [left, right]: [usize; 2]| {
            let dark = |(index, p): (usize, &[u8; 3])| {
                (left..right).contains(&(index % canvas.width())) && p.iter().all(|&c| c < 100)
            };
            canvas.pixels().iter().enumerate().filter(|&(i, p)| dark((i, p))).count()
        };
        let canvas = with_points.canvas().unwrap();
        let middle = (LABELS.1 as usize + SIZE.0 as usize - IMAGE_MARGINS[1] as usize) / 2;
        assert!(ink(&canvas, [middle + 12, middle + 60]) > 20, "the name is beside the point");
        assert_eq!((canvas.width(), canvas.height()), (SIZE.0 as usize, SIZE.1 as usize));
        assert!(empty.canvas().is_some(), "zero is a frame");
    }

    #[test]
    fn names_do_not_overlap() {
        let mut taken = Vec::new();
        let first = free_place(&mut taken, (50, 50), 80);
        let second = free_place(&mut taken, (55, 52), 80);
        assert!(second.1 >= first.1 + LINE);
        assert_eq!(free_place(&mut taken, (300, 50), 80).1, first.1);
    }

    #[test]
    fn all_coordinates_lie_within_the_drawing() {
        for points in [
            vec![[1.0, 1.0]],
            vec![[1.0, 0.5], [2.0, f64::NAN], [3.0, 0.25], [4.0, f64::INFINITY]],
            vec![[1.0, 1e-300], [2.0, 1e-3], [3.0, 0.0]],
            vec![[0.0, 1e150], [1e-9, 1e150]],
            vec![[1.0, 7.0], [2.0, 7.0]],
        ] {
            for axis in [Axis::linear, Axis::logarithmic] {
                let svg = figure(axis, points.clone()).unwrap();
                is_within(&svg);
                assert!(svg.contains("a &lt; b") && svg.contains("frames"), "{svg}");
            }
        }
    }

    #[test]
    fn plots_with_the_same_legend_share_one() {
        let points = || vec![[1.0, 1.0], [2.0, 2.0]];
        let mut plots = [plot(Axis::linear, points()), plot(Axis::linear, points())];
        let legends = |plots: &[LinePlot]| {
            let html = LinePlot::figures(plots).unwrap().into_string();
            html.matches("class=\"legend\"").count()
        };
        assert_eq!(legends(&plots), 1);
        plots[1].series[0].name = "another".into();
        assert_eq!(legends(&plots), 2);
    }

    #[test]
    fn a_gap_splits_a_line_and_a_band_is_translucent() {
        let mut plot = plot(Axis::linear, (0..6).map(|x| [f64::from(x), 1.0]).collect());
        let lines = |plot: &LinePlot| {
            let svg = plot.svg().unwrap();
            svg.matches("<polyline fill=\"none\" opacity=\"1\" stroke=\"#0072B2\"").count()
        };
        assert_eq!(lines(&plot), 1);
        plot.series[0].points[3][1] = f64::NAN;
        assert_eq!(lines(&plot), 2);
        plot.series[0].scattered = true;
        assert_eq!(lines(&plot), 0);
        assert!(!plot.svg().unwrap().contains("0.15"));
        plot.series[0].band = vec![[0.0, 0.5, 2.0], [5.0, 0.5, 2.0]];
        assert!(plot.svg().unwrap().contains("opacity=\"0.15\""));
    }
}
