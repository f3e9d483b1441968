//! Named points on two logarithmic axes.

use super::{
    canvas::{Canvas, LINE},
    palette::{BLACK, GREY, Rgb},
};

/// Size of the area within the axes (pixels).
const AREA: [usize; 2] = [720, 480];
/// Space left of, above, right of and below it (pixels).
const SPACE: [usize; 4] = [70, 50, 190, 50];
/// Radius of a point (pixels).
const RADIUS: f32 = 5.0;
/// Room around the points, as a share of a decade.
const ROOM: f64 = 0.15;
/// Lines of a grid.
const PALE: Rgb = [225; 3];
/// Colours of points, from the palette of Okabe and Ito ("Color Universal Design", 2008).
const COLORS: [Rgb; 4] = [[0, 114, 178], [86, 180, 233], [213, 94, 0], [120, 120, 120]];

/// How a point is drawn, with the number of its colour (0 to 3).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mark {
    /// A disc.
    Disc(usize),
    /// A square.
    Square(usize),
}

/// A named point.
#[derive(Clone, Debug)]
pub struct ScatterPoint {
    /// What it is.
    pub name: String,
    /// Where it is, in the units of the axes. Only positive numbers have a place.
    pub place: [f64; 2],
    /// How it is drawn.
    pub mark: Mark,
}

/// Named points on two logarithmic axes.
#[derive(Clone, Debug)]
pub struct Scatter {
    /// Above the picture.
    pub title: String,
    /// Below the horizontal axis.
    pub x: String,
    /// Above the vertical axis.
    pub y: String,
    /// The points.
    pub points: Vec<ScatterPoint>,
}

/// One axis.
struct Axis {
    /// Logarithms of its ends, to base 10.
    ends: [f64; 2],
    /// Its length (pixels).
    length: usize,
}

impl Axis {
    /// An axis that holds these positive numbers.
    fn around(numbers: impl Iterator<Item = f64> + Clone, length: usize) -> Self {
        let logs = numbers.map(f64::log10);
        let least = logs.clone().fold(f64::INFINITY, f64::min) - ROOM;
        let most = logs.fold(f64::NEG_INFINITY, f64::max) + ROOM;
        Self { ends: [least, most], length }
    }

    /// Where a number is (pixels from the axis' lower end).
    fn place(&self, number: f64) -> f64 {
        let [least, most] = self.ends;
        (number.log10() - least) / (most - least) * self.length as f64
    }

    /// 1, 2 and 5 times powers of ten on the axis.
    fn ticks(&self) -> Vec<f64> {
        let [least, most] = self.ends;
        let powers = least.floor() as i32..=most.ceil() as i32;
        let all = powers.flat_map(|power| [1.0, 2.0, 5.0].map(|k| k * 10f64.powi(power)));
        all.filter(|tick| (least..=most).contains(&tick.log10())).collect()
    }
}

impl Scatter {
    /// The picture; `None` when no point has a place.
    pub fn draw(&self) -> Option<Canvas> {
        let placed = |point: &&ScatterPoint| point.place.iter().all(|x| *x > 0.0 && x.is_finite());
        let points: Vec<&ScatterPoint> = self.points.iter().filter(placed).collect();
        if points.is_empty() {
            return None;
        }
        let [left, top, right, bottom] = SPACE;
        let [width, height] = AREA;
        let mut canvas = Canvas::new(left + width + right, top + height + bottom);
        let axis =
            |axis: usize| Axis::around(points.iter().map(move |p| p.place[axis]), AREA[axis]);
        let (x, y) = (axis(0), axis(1));
        for tick in x.ticks() {
            let at = left + x.place(tick) as usize;
            canvas.fill(at, top, 1, height, PALE);
            let word = number(tick);
            let start = at.saturating_sub(Canvas::width_of(&word) / 2);
            canvas.text(&word, start, top + height + 6, BLACK);
        }
        for tick in y.ticks() {
            let at = top + height - y.place(tick) as usize;
            canvas.fill(left, at, width, 1, PALE);
            let word = number(tick);
            let start = left.saturating_sub(Canvas::width_of(&word) + 8);
            canvas.text(&word, start, at.saturating_sub(7), BLACK);
        }
        canvas.outline(left, top, width, height, GREY);
        canvas.text(&self.title, left, 6, BLACK);
        canvas.text(&self.y, left, 6 + LINE, BLACK);
        let start = (left + width).saturating_sub(Canvas::width_of(&self.x));
        canvas.text(&self.x, start, top + height + 6 + LINE, BLACK);
        let mut taken: Vec<[usize; 3]> = Vec::new();
        for point in points {
            let at = [
                left as f32 + x.place(point.place[0]) as f32,
                (top + height) as f32 - y.place(point.place[1]) as f32,
            ];
            mark(&mut canvas, at, point.mark);
            let [start, line] = free_place(&mut taken, at, Canvas::width_of(&point.name));
            canvas.text(&point.name, start, line, BLACK);
        }
        Some(canvas)
    }
}

fn mark(canvas: &mut Canvas, [x, y]: [f32; 2], mark: Mark) {
    let color = |number: usize| COLORS[number % COLORS.len()];
    match mark {
        Mark::Disc(number) => canvas.disc([x, y], RADIUS, color(number)),
        Mark::Square(number) => {
            let side = 2 * RADIUS as usize - 1;
            let corner = [x, y].map(|at| (at - RADIUS).max(0.0) as usize);
            canvas.fill(corner[0], corner[1], side, side, color(number));
        }
    }
}

/// Where words beside a point start: lower down while others are there.
fn free_place(taken: &mut Vec<[usize; 3]>, [x, y]: [f32; 2], width: usize) -> [usize; 2] {
    let start = (x + RADIUS) as usize + 4;
    let mut line = (y as usize).saturating_sub(7);
    let meets = |line: usize| {
        move |&&[from, to, other]: &&[usize; 3]| {
            other.abs_diff(line) < LINE - 4 && from < start + width && start < to
        }
    };
    while let Some(&[_, _, other]) = taken.iter().find(meets(line)) {
        line = other + LINE - 4;
    }
    taken.push([start, start + width, line]);
    [start, line]
}

/// A tick's number without needless digits.
fn number(tick: f64) -> String {
    if (1e-3..1e4).contains(&tick) { format!("{tick}") } else { format!("{tick:e}") }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scatter(places: &[[f64; 2]]) -> Scatter {
        let point = |&place| ScatterPoint { name: "a".into(), place, mark: Mark::Disc(0) };
        let points = places.iter().map(point).collect();
        Scatter { title: "t".into(), x: "x".into(), y: "y".into(), points }
    }

    /// The middle of all pixels of this colour.
    fn middle(canvas: &Canvas, color: Rgb) -> [f32; 2] {
        let at = |(index, _)| [index % canvas.width(), index / canvas.width()];
        let found: Vec<[usize; 2]> =
            canvas.pixels().iter().enumerate().filter(|(_, p)| **p == color).map(at).collect();
        let sum = found.iter().fold([0; 2], |sum, at| [sum[0] + at[0], sum[1] + at[1]]);
        sum.map(|sum| sum as f32 / found.len() as f32)
    }

    #[test]
    fn equal_ratios_are_equal_distances() {
        let axis = Axis::around([0.1, 10.0].into_iter(), 100);
        let (low, middle, high) = (axis.place(0.1), axis.place(1.0), axis.place(10.0));
        assert!((high - middle - (middle - low)).abs() < 1e-9 && low > 0.0 && high < 100.0);
        assert_eq!(axis.ticks(), [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0]);
    }

    #[test]
    fn a_lone_point_is_in_the_middle() {
        let canvas = scatter(&[[1.0, 0.3]]).draw().unwrap();
        let [x, y] = middle(&canvas, COLORS[0]);
        let expected = [SPACE[0] + AREA[0] / 2, SPACE[1] + AREA[1] / 2].map(|at| at as f32);
        assert!((x - expected[0]).abs() < 2.0 && (y - expected[1]).abs() < 2.0, "{x}, {y}");
    }

    #[test]
    fn what_has_no_logarithm_has_no_place() {
        assert_eq!(scatter(&[[0.0, 1.0], [1.0, f64::NAN], [-1.0, 1.0]]).draw(), None);
        assert!(scatter(&[[0.0, 1.0], [1.0, 1.0]]).draw().is_some());
    }

    #[test]
    fn names_do_not_cover_each_other() {
        let mut taken = Vec::new();
        let first = free_place(&mut taken, [50.0, 50.0], 80);
        let second = free_place(&mut taken, [55.0, 52.0], 80);
        assert!(second[1] >= first[1] + LINE - 4);
        assert_eq!(free_place(&mut taken, [300.0, 50.0], 80)[1], first[1]);
    }
}
