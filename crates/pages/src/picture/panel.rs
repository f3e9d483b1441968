//! Pictures of frames.

use super::canvas::{Canvas, LINE};
use eddy_frames::{
    Domain, Frame, Material,
    palette::{self, BLACK, GREY, Rgb},
    tool::Shape,
};

/// Margin around the domain (pixels).
const MARGIN: usize = 10;

/// Radius of a disc relative to the square root of its particle's share of the domain: discs of a filled region just
/// overlap.
const RADIUS: f32 = 0.35;

/// Minimum and maximum radius of a disc (pixels).
const RADII: (f32, f32) = (1.0, 4.0);

/// Minimum width and height of the domain (pixels).
const MIN_SIDE: usize = 16;

/// Steps of the speed scale.
const STEPS: usize = 96;

/// Meaning of the colours.
#[derive(Clone, Debug, PartialEq)]
pub enum Coloring {
    /// By material; these occur.
    Material(Vec<Material>),
    /// By speed, up to this maximum (domain lengths per second).
    Speed(f32),
}

/// Draws frames of one domain at a fixed scale.
#[derive(Clone, Debug)]
pub struct Painter {
    domain: Domain,
    coloring: Coloring,
    /// Width and height of the domain (pixels).
    extent: [usize; 2],
    /// Radius of a particle (pixels).
    radius: f32,
}

impl Painter {
    /// For frames of about `particles` particles; the longer side of the domain has `size` pixels.
    pub fn new(domain: Domain, particles: usize, size: usize, coloring: Coloring) -> Self {
        let [width, height] = [0, 1].map(|axis| domain.upper[axis] - domain.lower[axis]);
        let scale = size as f32 / width.max(height);
        let extent =
            [width, height].map(|length| ((length * scale).round() as usize).max(MIN_SIDE));
        let share = extent[0] as f32 * extent[1] as f32 / particles.max(1) as f32;
        let radius = (RADIUS * share.sqrt()).clamp(RADII.0, RADII.1);
        Self { domain, coloring, extent, radius }
    }

    /// Draws a frame and shapes over it, with its time below it.
    pub fn panel(&self, frame: &Frame, shapes: &[Shape]) -> Canvas {
        self.titled(Some(frame), shapes, &format!("t = {:.3} s", frame.stamp.seconds()))
    }

    /// Draws a frame and shapes over it, with its title and time below it. A missing frame leaves its domain empty, and says so.
    pub fn named_panel(&self, title: &str, frame: Option<&Frame>, shapes: &[Shape]) -> Canvas {
        let time = frame.map(|frame| format!("t = {:.3} s", frame.stamp.seconds()));
        self.titled(frame, shapes, &format!("{title}  {}", time.as_deref().unwrap_or("no frame")))
    }

    /// Panels side by side.
    pub fn beside(&self, panels: &[Canvas]) -> Canvas {
        row(panels)
    }

    /// Draws a frame with a line of text below it.
    fn titled(&self, frame: Option<&Frame>, shapes: &[Shape], title: &str) -> Canvas {
        let [width, height] = self.extent;
        let mut canvas = Canvas::new(width + 2 * MARGIN, height + 2 * MARGIN + LINE);
        canvas.outline(MARGIN - 1, MARGIN - 1, width + 2, height + 2, GREY);
        if let Some(frame) = frame {
            canvas.paste(&self.particles(frame, shapes), MARGIN, MARGIN);
        }
        canvas.text(title, MARGIN, MARGIN + height + 6, BLACK);
        canvas
    }

    /// Draws the particles of a frame, and shapes over them, only.
    pub fn particles(&self, frame: &Frame, shapes: &[Shape]) -> Canvas {
        let [width, height] = self.extent;
        let mut canvas = Canvas::new(width, height);
        for particle in 0..frame.len() {
            let place = self.place(frame.position[particle]);
            canvas.disc(place, self.radius, self.color(frame, particle));
        }
        shapes.iter().for_each(|shape| self.shape(&mut canvas, shape));
        canvas
    }

    /// Fills a shape.
    fn shape(&self, canvas: &mut Canvas, Shape { part, color }: &Shape) {
        let Domain { lower, upper } = self.domain;
        let [width, height] = self.extent;
        // One for both axes, but for rounding.
        let pixel = (upper[0] - lower[0]) / width as f32;
        for row in 0..height {
            for column in 0..width {
                let x = lower[0] + (column as f32 + 0.5) * pixel;
                let y = upper[1] - (row as f32 + 0.5) * pixel;
                let cover = (0.5 - part.distance([x, y]) / pixel).clamp(0.0, 1.0);
                if cover > 0.0 {
                    canvas.blend([column as i32, row as i32], *color, cover);
                }
            }
        }
    }

    /// The legend of the colours.
    fn legend(&self) -> Canvas {
        match &self.coloring {
            Coloring::Material(materials) => of_materials(materials),
            Coloring::Speed(top) => of_speeds(*top),
        }
    }

    /// A panel with the legend below it.
    pub fn picture(&self, panel: &Canvas) -> Canvas {
        below(panel, &self.legend())
    }

    /// Rows of panels with the legend below them.
    pub fn strip(&self, rows: &[Vec<Canvas>]) -> Canvas {
        let rows = rows.iter().map(|panels| row(panels));
        let picture = rows.reduce(|above, next| below(&above, &next));
        below(&picture.unwrap_or_else(|| Canvas::new(0, 0)), &self.legend())
    }

    /// Pixel coordinates of a position; the second axis points up.
    fn place(&self, position: [f32; 2]) -> [f32; 2] {
        let share = |axis: usize| {
            let (lower, upper) = (self.domain.lower[axis], self.domain.upper[axis]);
            (position[axis] - lower) / (upper - lower)
        };
        let [width, height] = self.extent.map(|extent| extent as f32);
        [share(0) * width, (1.0 - share(1)) * height]
    }

    fn color(&self, frame: &Frame, particle: usize) -> Rgb {
        match self.coloring {
            Coloring::Material(_) => palette::of_material(frame.material[particle]),
            Coloring::Speed(top) => {
                let [x, y] = frame.velocity[particle];
                palette::of_share(x.hypot(y) / top.max(f32::MIN_POSITIVE))
            }
        }
    }
}

/// Pictures side by side.
fn row(panels: &[Canvas]) -> Canvas {
    let width = panels.iter().map(Canvas::width).sum();
    let height = panels.iter().map(Canvas::height).max().unwrap_or(0);
    let mut row = Canvas::new(width, height);
    let mut left = 0;
    for panel in panels {
        row.paste(panel, left, 0);
        left += panel.width();
    }
    row
}

fn below(picture: &Canvas, legend: &Canvas) -> Canvas {
    let width = picture.width().max(legend.width());
    let mut both = Canvas::new(width, picture.height() + legend.height());
    both.paste(picture, 0, 0);
    both.paste(legend, 0, picture.height());
    both
}

/// Height of a legend (pixels).
const LEGEND: usize = LINE + 4;

fn of_materials(materials: &[Material]) -> Canvas {
    // A disc, its name, a gap.
    let width = |material: &Material| 16 + Canvas::width_of(material.name()) + 14;
    let mut legend = Canvas::new(MARGIN + materials.iter().map(width).sum::<usize>(), LEGEND);
    let mut left = MARGIN;
    for material in materials {
        legend.disc([left as f32 + 5.0, 7.5], 5.0, palette::of_material(*material));
        legend.text(material.name(), left + 16, 1, BLACK);
        left += width(material);
    }
    legend
}

fn of_speeds(top: f32) -> Canvas {
    let (low, high) = ("speed 0".to_owned(), format!("{top:.2}"));
    let scale = MARGIN + Canvas::width_of(&low) + 8;
    let end = scale + STEPS + 8;
    let mut legend = Canvas::new(end + Canvas::width_of(&high) + MARGIN, LEGEND);
    legend.text(&low, MARGIN, 1, BLACK);
    for step in 0..STEPS {
        let color = palette::of_share(step as f32 / (STEPS - 1) as f32);
        legend.fill(scale + step, 2, 1, 11, color);
    }
    legend.text(&high, end, 1, BLACK);
    legend
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{
        Stamp,
        tool::{Outline, Pose},
    };

    fn frame(domain: Domain, position: [f32; 2]) -> Frame {
        Frame {
            stream: 0,
            sequence: 0,
            stamp: Stamp(0),
            dt: 0.1,
            domain,
            position: vec![position],
            velocity: vec![[0.0, 2.0]],
            material: vec![Material::Rope],
        }
    }

    /// Where the first pixel of this colour is.
    fn find(canvas: &Canvas, color: Rgb) -> Option<[usize; 2]> {
        let at = canvas.pixels().iter().position(|&pixel| pixel == color)?;
        Some([at % canvas.width(), at / canvas.width()])
    }

    #[test]
    fn a_particle_is_drawn_at_its_position_in_a_domain_of_any_shape() {
        let domain = Domain { lower: [-1.0, 2.0], upper: [3.0, 4.0] };
        let painter = Painter::new(domain, 1, 200, Coloring::Material(vec![Material::Rope]));
        let panel = painter.panel(&frame(domain, [2.0, 3.5]), &[]);
        assert_eq!(panel.width(), 200 + 2 * MARGIN);
        assert_eq!(panel.height(), 100 + 2 * MARGIN + LINE);
        let [x, y] = find(&panel, palette::of_material(Material::Rope)).unwrap();
        // The topmost pixel of a disc of radius 4 around (150, 25).
        assert!(x.abs_diff(MARGIN + 150) <= 2 && y.abs_diff(MARGIN + 21) <= 1, "{x}, {y}");
    }

    #[test]
    fn a_shape_covers_its_area_over_the_particles() {
        let domain = Domain { lower: [-1.0, 2.0], upper: [3.0, 4.0] };
        let painter = Painter::new(domain, 1, 200, Coloring::Material(vec![Material::Rope]));
        let pose = Pose { position: [2.0, 3.5], angle: 0.25 };
        let part = Outline::Rectangle { size: [0.4, 0.2] }.posed(pose).remove(0);
        let canvas =
            painter.particles(&frame(domain, [2.0, 3.5]), &[Shape { part, color: [0; 3] }]);
        assert_eq!(canvas.pixels()[25 * 200 + 150], [0; 3], "over the particle");
        let ink: f32 = canvas.pixels().iter().map(|p| 1.0 - f32::from(p[0]) / 255.0).sum();
        assert!((ink - 200.0).abs() < 2.0, "{ink} of 20 x 10 pixels");
    }

    #[test]
    fn frames_are_drawn_side_by_side_and_a_missing_one_leaves_its_domain_empty() {
        let painter = Painter::new(Domain::UNIT, 1, 100, Coloring::Speed(2.0));
        let [there, missing]: [Option<Frame>; 2] = [Some(frame(Domain::UNIT, [0.5, 0.5])), None];
        let both = painter.beside(&[
            painter.named_panel("/a", missing.as_ref(), &[]),
            painter.named_panel("/b", there.as_ref(), &[]),
        ]);
        let panel = painter.panel(there.as_ref().unwrap(), &[]);
        assert_eq!((both.width(), both.height()), (2 * panel.width(), panel.height()));
        let color = palette::of_share(1.0);
        let [alone, beside] = [&panel, &both].map(|canvas| find(canvas, color).unwrap());
        assert_eq!(beside, [alone[0] + panel.width(), alone[1]]);
    }

    #[test]
    fn a_strip_has_a_row_for_each_list_of_panels() {
        let painter = Painter::new(Domain::UNIT, 1, 100, Coloring::Speed(2.0));
        let panel = painter.panel(&frame(Domain::UNIT, [0.5, 0.5]), &[]);
        let one = painter.strip(&[vec![panel.clone(); 3]]);
        let two = painter.strip(&[vec![panel.clone(); 3], vec![panel.clone(); 3]]);
        assert_eq!((one.width(), two.width()), (3 * panel.width(), 3 * panel.width()));
        assert_eq!(two.height() - one.height(), panel.height());
    }

    #[test]
    fn a_particle_at_maximum_speed_has_the_lightest_colour() {
        let painter = Painter::new(Domain::UNIT, 1, 100, Coloring::Speed(2.0));
        let panel = painter.panel(&frame(Domain::UNIT, [0.5, 0.5]), &[]);
        assert!(find(&panel, palette::of_share(1.0)).is_some());
        let still = Painter::new(Domain::UNIT, 1, 100, Coloring::Speed(0.0));
        assert!(
            find(&still.panel(&frame(Domain::UNIT, [0.5, 0.5]), &[]), palette::of_share(1.0))
                .is_some()
        );
    }
}
