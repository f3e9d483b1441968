//! The bodies of jelly, and the elements that cover one at rest.

use std::ops::Range;

use eddy_frames::Material;

use crate::kernels::rest_shape::RestShape;

/// Distance of particles that are connected (spacings): nearest neighbours in a body that is somewhat stretched, but not bodies that
/// almost touch.
const CONNECTED: f32 = 1.5;
/// Share of the particles of a full element that fill it.
const FILLED: f64 = 0.4;
/// Largest area of a body's bounding box for each of its particles (squared spacings).
const MOST_AREA: f64 = 256.0;
/// Points along a side of an element.
const POINTS: usize = 2;

/// The rows of each body, ascending; bodies in the order of their first rows.
pub(super) fn bodies(
    (rest, rows): (&RestShape, Range<usize>),
    material: &[Material],
    spacing: f32,
) -> Vec<Vec<u32>> {
    /// The row that stands for the body of a row.
    fn root(of: &mut [u32], row: u32) -> u32 {
        let mut row = row;
        while of[row as usize] != row {
            of[row as usize] = of[of[row as usize] as usize];
            row = of[row as usize];
        }
        row
    }
    let is_jelly = |row: usize| material[row] == Material::Jelly;
    let mut of: Vec<u32> = (0..rows.len() as u32).collect();
    for row in (0..rows.len()).filter(|row| is_jelly(*row)) {
        let own = rows.start + row;
        for (link, [x, y]) in rest.links(own).iter().zip(rest.offsets(own)) {
            if x * x + y * y > (CONNECTED * spacing).powi(2) {
                continue;
            }
            let ends = [row as u32, link.particle - rows.start as u32];
            let [one, other] = ends.map(|end| root(&mut of, end));
            of[one.max(other) as usize] = one.min(other);
        }
    }
    let mut bodies: Vec<Vec<u32>> = Vec::new();
    let mut number = vec![None; rows.len()];
    for row in (0..rows.len()).filter(|row| is_jelly(*row)) {
        let body = root(&mut of, row as u32) as usize;
        let body = *number[body].get_or_insert_with(|| {
            bodies.push(Vec::new());
            bodies.len() - 1
        });
        bodies[body].push(row as u32);
    }
    bodies
}

/// The elements that cover a body at rest.
pub(super) struct Cover {
    origin: [f64; 2],
    pub(super) width: [f64; 2],
    /// Elements along each axis.
    cells: [usize; 2],
    /// The element whose shape functions are those of an element's particles: itself, or the nearest filled neighbour. None where there
    /// is no particle.
    home: Vec<Option<[usize; 2]>>,
}

/// A node, and its shape function at a place, with the gradient (1 / domain lengths).
pub(super) type Corner = (usize, f64, [f64; 2]);

impl Cover {
    /// Elements of at least this width, unless the body is narrower, that end where the particles' area does. None if its box is far
    /// larger than the particles' area.
    pub(super) fn new(places: &[[f64; 2]], spacing: f64, width: f64) -> Option<Self> {
        let (mut origin, mut widths, mut cells) = ([0.0; 2], [0.0; 2], [1; 2]);
        for axis in 0..2 {
            let along = places.iter().map(|place| place[axis]);
            let low = along.clone().fold(f64::MAX, f64::min) - 0.5 * spacing;
            let extent = along.fold(f64::MIN, f64::max) + 0.5 * spacing - low;
            // A little more than the quotient, which rounding may have left below a whole number.
            cells[axis] = ((extent / width + 1e-6) as usize).max(1);
            (origin[axis], widths[axis]) = (low, extent / cells[axis] as f64);
        }
        let count = cells[0].saturating_mul(cells[1]);
        let area = widths[0] * widths[1] * count as f64 / (spacing * spacing);
        if area > MOST_AREA * places.len() as f64 {
            return None;
        }
        let mut cover = Self { origin, width: widths, cells, home: Vec::new() };
        let mut counts = vec![0u32; count];
        for &place in places {
            counts[cover.index(cover.own_element(place))] += 1;
        }
        let least = FILLED * widths[0] * widths[1] / (spacing * spacing);
        let is_filled = |element: [usize; 2]| f64::from(counts[cover.index(element)]) >= least;
        // Not further away than a neighbour: shape functions grow with the distance.
        let nearest_filled = |own: [usize; 2]| {
            let near = |axis: usize| near(own[axis], cells[axis]);
            let squared_distance = |other: &[usize; 2]| -> f64 {
                let along = |axis: usize| (own[axis].abs_diff(other[axis]) as f64) * widths[axis];
                along(0) * along(0) + along(1) * along(1)
            };
            near(1)
                .flat_map(|y| near(0).map(move |x| [x, y]))
                .filter(|&other| is_filled(other))
                .min_by(|a, b| squared_distance(a).total_cmp(&squared_distance(b)))
        };
        let home = |index: usize| {
            let own = [index % cells[0], index / cells[0]];
            match counts[index] {
                0 => None,
                // Itself, if no neighbour is filled either: a part of the body that is thinner than an element.
                _ => Some(nearest_filled(own).unwrap_or(own)),
            }
        };
        cover.home = (0..count).map(home).collect();
        Some(cover)
    }

    /// The place of an element in a list.
    fn index(&self, [x, y]: [usize; 2]) -> usize {
        y * self.cells[0] + x
    }

    /// Of the body's box along an axis (domain lengths).
    fn extent(&self, axis: usize) -> f64 {
        self.width[axis] * self.cells[axis] as f64
    }

    /// The part that a place is in, of so many along each axis.
    fn part(&self, place: [f64; 2], count: [usize; 2]) -> [usize; 2] {
        [0, 1].map(|axis| {
            let at = (place[axis] - self.origin[axis]) / self.extent(axis) * count[axis] as f64;
            (at.max(0.0) as usize).min(count[axis] - 1)
        })
    }

    /// The element that a place is in.
    fn own_element(&self, place: [f64; 2]) -> [usize; 2] {
        self.part(place, self.cells)
    }

    /// The element whose shape functions are those of a particle's place.
    pub(super) fn element(&self, place: [f64; 2]) -> [usize; 2] {
        let own = self.own_element(place);
        self.home[self.index(own)].unwrap_or(own)
    }

    /// The nodes of a part's element, with their shape functions at its middle. Beside elements with particles, it has the element of one of
    /// its own.
    pub(super) fn corners_of(&self, part: &Part) -> [Corner; 4] {
        let own = self.home[self.index(self.own_element(part.middle))];
        self.corners(part.middle, own.unwrap_or_else(|| self.element(part.first)))
    }

    /// A node's place in the order along the shorter side first, in which coupled ones are near each other.
    fn node(&self, [x, y]: [usize; 2]) -> usize {
        match self.cells[0] <= self.cells[1] {
            true => y * (self.cells[0] + 1) + x,
            false => x * (self.cells[1] + 1) + y,
        }
    }

    /// The nodes of elements that particles belong to, ascending.
    pub(super) fn used_nodes(&self) -> Vec<usize> {
        let corners = |[x, y]: &[usize; 2]| CORNERS.map(|[dx, dy]| self.node([x + dx, y + dy]));
        let mut nodes: Vec<_> = self.home.iter().flatten().flat_map(corners).collect();
        nodes.sort_unstable();
        nodes.dedup();
        nodes
    }

    /// The corners of an element, with their shape functions at a place, which may lie beside it.
    pub(super) fn corners(&self, place: [f64; 2], element: [usize; 2]) -> [Corner; 4] {
        let within: [f64; 2] = [0, 1].map(|axis| {
            (place[axis] - self.origin[axis]) / self.width[axis] - element[axis] as f64
        });
        CORNERS.map(|corner| {
            let node = self.node([element[0] + corner[0], element[1] + corner[1]]);
            let part =
                |axis: usize| if corner[axis] == 1 { within[axis] } else { 1.0 - within[axis] };
            let sign = |axis: usize| if corner[axis] == 1 { 1.0 } else { -1.0 };
            let gradient = [sign(0) * part(1) / self.width[0], sign(1) * part(0) / self.width[1]];
            (node, part(0) * part(1), gradient)
        })
    }

    /// The quarters of elements.
    pub(super) fn quarters(&self, places: &[[f64; 2]]) -> Vec<Part> {
        self.parts(places, self.cells.map(|cells| POINTS * cells)).into_iter().flatten().collect()
    }

    /// The parts of about this width at the surface: there are no particles in a part beside them.
    pub(super) fn surface(&self, places: &[[f64; 2]], width: f64) -> Vec<Part> {
        let [across, up] = [0, 1].map(|axis| ((self.extent(axis) / width).round() as usize).max(1));
        let parts = self.parts(places, [across, up]);
        let is_inner = |index: usize| {
            let [x, y] = [index % across, index / across];
            let around = near(y, up).flat_map(|y| near(x, across).map(move |x| y * across + x));
            around.filter(|&other| parts[other].is_some()).count() == 9
        };
        (0..parts.len())
            .filter(|&index| parts[index].is_some() && !is_inner(index))
            .filter_map(|index| parts[index])
            .collect()
    }

    /// So many parts of the body's box along each axis, row by row; none where there is no particle.
    fn parts(&self, places: &[[f64; 2]], count: [usize; 2]) -> Vec<Option<Part>> {
        let mut parts: Vec<Option<Part>> = vec![None; count[0] * count[1]];
        for place in places {
            let [x, y] = self.part(*place, count);
            let part = &mut parts[y * count[0] + x];
            let part = part.get_or_insert_with(|| Part { first: *place, ..Part::default() });
            part.particles += 1.0;
            for (middle, place) in part.middle.iter_mut().zip(place) {
                *middle += (place - *middle) / part.particles;
            }
        }
        parts
    }
}

/// A place among so many along an axis, with those beside it.
fn near(at: usize, count: usize) -> Range<usize> {
    at.saturating_sub(1)..(at + 2).min(count)
}

/// A part of a body.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Part {
    /// The mean place of its particles at rest (domain lengths).
    pub(super) middle: [f64; 2],
    /// The place of one of them.
    first: [f64; 2],
    /// Their number.
    pub(super) particles: f64,
}

/// The corners of an element.
const CORNERS: [[usize; 2]; 4] = [[0, 0], [1, 0], [0, 1], [1, 1]];
