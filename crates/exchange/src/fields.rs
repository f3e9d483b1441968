//! Fields of particles that follow from their positions: density and strain, both relative to the first frame of a stream.

use std::collections::HashMap;

use eddy_frames::{Frame, Material};
use eddy_inference::kernels::spacing::{median, spacing};

/// Radius of the kernel of the density (spacings).
const RADIUS: f32 = 2.5;
/// Maximum distance of neighbours in the first frame (spacings): the eight around a particle of a lattice.
const REACH: f32 = 1.6;
/// Maximum number of particles of a cell that are summed over: where particles are pressed together, all pairs would be the
/// square of their number.
const MAX_CANDIDATES: usize = 256;
/// Smallest ratio of the extents of a neighbourhood, squared, that has a strain in both directions.
const MIN_FLATNESS: f32 = 1e-3;

/// Fields of one frame.
pub(super) struct Fields {
    /// Density relative to the median of the first frame, `[N]`: 1 is packed as densely as there. Lower at free surfaces,
    /// where the kernel reaches beyond the particles.
    pub(super) density: Vec<f32>,
    /// Green-Lagrange strain since the first frame as xx, yy, xy, `[N]`. NaN without neighbours of the same material in at
    /// least two directions, and where the number of particles has changed.
    pub(super) strain: Vec<[f32; 3]>,
}

/// The first frame of a stream, which fields are relative to.
pub(super) struct Reference {
    /// Radius of the kernel (domain lengths).
    radius: f32,
    /// Median of the kernel sums.
    packed: f32,
    position: Vec<[f32; 2]>,
    /// Neighbours of particle k: `neighbours[ends[k]..ends[k + 1]]`.
    neighbours: Vec<u32>,
    ends: Vec<usize>,
}

impl Reference {
    /// The reference `frame`.
    pub(super) fn new(frame: &Frame) -> Self {
        let spacing = spacing(&frame.position);
        // A single particle has no spacing.
        let spacing = if spacing > 0.0 && spacing.is_finite() { spacing } else { 1.0 };
        let radius = RADIUS * spacing;
        let packed = median(kernel_sums(&frame.position, radius)).max(f32::MIN_POSITIVE);
        let reach = REACH * spacing;
        let cells = Cells::new(&frame.position, reach);
        let (mut neighbours, mut ends) = (Vec::new(), vec![0]);
        let material: &[Material] = &frame.material;
        for (k, &at) in frame.position.iter().enumerate() {
            for (cell, _) in cells.around(at) {
                let near = cell.iter().take(MAX_CANDIDATES).filter(|&&other| {
                    let other = other as usize;
                    other != k
                        && material[other] == material[k]
                        && squared(difference(frame.position[other], at)) <= reach * reach
                });
                neighbours.extend(near);
            }
            ends.push(neighbours.len());
        }
        Self { radius, packed, position: frame.position.clone(), neighbours, ends }
    }

    /// Whether the strain of this frame is known: its particles are those of the reference.
    pub(super) fn has_strain_of(&self, frame: &Frame) -> bool {
        frame.len() == self.position.len()
    }

    /// The fields of a frame of the same stream.
    pub(super) fn fields(&self, frame: &Frame) -> Fields {
        let sums = kernel_sums(&frame.position, self.radius);
        let density = sums.into_iter().map(|sum| sum / self.packed).collect();
        let strain = match self.has_strain_of(frame) {
            true => (0..frame.len()).map(|k| self.strain(k, &frame.position)).collect(),
            false => vec![[f32::NAN; 3]; frame.len()],
        };
        Fields { density, strain }
    }

    /// Green-Lagrange strain of particle `k`, from the deformation gradient F that fits the displacements of its neighbours
    /// best: with rest distances X and present ones x, F = (sum x X^T) (sum X X^T)^-1.
    fn strain(&self, k: usize, position: &[[f32; 2]]) -> [f32; 3] {
        let [mut xx, mut xy, mut yy] = [0.0_f32; 3];
        let mut moment = [[0.0_f32; 2]; 2];
        for &other in &self.neighbours[self.ends[k]..self.ends[k + 1]] {
            let rest = difference(self.position[other as usize], self.position[k]);
            let now = difference(position[other as usize], position[k]);
            xx += rest[0] * rest[0];
            xy += rest[0] * rest[1];
            yy += rest[1] * rest[1];
            for (row, now) in moment.iter_mut().zip(now) {
                row[0] += now * rest[0];
                row[1] += now * rest[1];
            }
        }
        let determinant = xx * yy - xy * xy;
        if determinant <= MIN_FLATNESS * (xx + yy) * (xx + yy) {
            return [f32::NAN; 3];
        }
        let [[a, b], [c, d]] = moment.map(|[along_x, along_y]| {
            let first = (along_x * yy - along_y * xy) / determinant;
            [first, (along_y * xx - along_x * xy) / determinant]
        });
        [0.5 * (a * a + c * c - 1.0), 0.5 * (b * b + d * d - 1.0), 0.5 * (a * b + c * d)]
    }
}

/// The sum of a kernel over the particles around each, itself included.
fn kernel_sums(position: &[[f32; 2]], radius: f32) -> Vec<f32> {
    let cells = Cells::new(position, radius);
    let sum = |&at: &[f32; 2]| {
        let of_cell = |(cell, weight): (&[u32], f32)| {
            let of = |&other: &u32| {
                let ratio = squared(difference(position[other as usize], at)) / (radius * radius);
                (1.0 - ratio).max(0.0).powi(3)
            };
            let stride = cell.len().div_ceil(MAX_CANDIDATES);
            weight * cell.iter().step_by(stride).map(of).sum::<f32>()
        };
        cells.around(at).map(of_cell).sum()
    };
    position.iter().map(sum).collect()
}

/// Particles by square cell.
struct Cells {
    width: f32,
    cells: HashMap<[i32; 2], Vec<u32>>,
}

impl Cells {
    fn new(position: &[[f32; 2]], width: f32) -> Self {
        let mut cells = Self { width, cells: HashMap::new() };
        for (k, &at) in position.iter().enumerate() {
            cells.cells.entry(cells.cell(at)).or_default().push(k as u32);
        }
        cells
    }

    /// The cast saturates.
    fn cell(&self, at: [f32; 2]) -> [i32; 2] {
        at.map(|x| (x / self.width).floor() as i32)
    }

    /// The cells around a position that have particles, and the number that each of at most [`MAX_CANDIDATES`] of its
    /// particles stands for.
    fn around(&self, at: [f32; 2]) -> impl Iterator<Item = (&[u32], f32)> {
        let [column, row] = self.cell(at);
        let offsets = (-1..=1).flat_map(|x| (-1..=1).map(move |y| [x, y]));
        offsets.filter_map(move |[x, y]| {
            let cell = self.cells.get(&[column.saturating_add(x), row.saturating_add(y)])?;
            let counted = cell.len().div_ceil(cell.len().div_ceil(MAX_CANDIDATES));
            Some((&cell[..], cell.len() as f32 / counted as f32))
        })
    }
}

fn difference(a: [f32; 2], b: [f32; 2]) -> [f32; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

fn squared([x, y]: [f32; 2]) -> f32 {
    x * x + y * y
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{Domain, Stamp};

    const SPACING: f32 = 1.0 / 128.0;
    const SIDE: usize = 20;
    /// A particle in the middle.
    const MIDDLE: usize = 10 * SIDE + 10;

    /// A square lattice, deformed.
    fn lattice(deformed: impl Fn([f32; 2]) -> [f32; 2]) -> Frame {
        let place = |k: usize| [(k % SIDE) as f32 * SPACING, (k / SIDE) as f32 * SPACING];
        Frame {
            stream: 1,
            sequence: 0,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain::UNIT,
            position: (0..SIDE * SIDE).map(|k| deformed(place(k))).collect(),
            velocity: vec![[0.0; 2]; SIDE * SIDE],
            material: vec![Material::Jelly; SIDE * SIDE],
        }
    }

    fn fields(deformed: impl Fn([f32; 2]) -> [f32; 2]) -> Fields {
        Reference::new(&lattice(|x| x)).fields(&lattice(deformed))
    }

    #[test]
    fn the_first_frame_has_density_one_and_no_strain() {
        let Fields { density, strain } = fields(|x| x);
        assert!((density[MIDDLE] - 1.0).abs() < 1e-5, "{}", density[MIDDLE]);
        assert!(density[0] < 0.6, "a corner: {}", density[0]);
        assert!(strain.as_flattened().iter().all(|e| e.abs() < 1e-4));
    }

    #[test]
    fn a_square_pressed_to_four_fifths_is_denser_and_strained_along_one_axis() {
        let Fields { density, strain } = fields(|[x, y]| [0.8 * x + 0.3, y]);
        assert!((density[MIDDLE] - 1.25).abs() < 0.05, "{}", density[MIDDLE]);
        // (0.8^2 - 1) / 2.
        for (found, expected) in strain[MIDDLE].into_iter().zip([-0.18, 0.0, 0.0]) {
            assert!((found - expected).abs() < 1e-3, "{:?}", strain[MIDDLE]);
        }
    }

    #[test]
    fn a_rotation_is_no_strain_and_a_shear_is() {
        let (sin, cos) = 0.7_f32.sin_cos();
        let turned = fields(|[x, y]| [cos * x - sin * y, sin * x + cos * y]);
        assert!(turned.strain.as_flattened().iter().all(|e| e.abs() < 1e-3));
        let sheared = fields(|[x, y]| [x + 0.2 * y, y]);
        // F = [[1, 0.2], [0, 1]].
        for (found, expected) in sheared.strain[MIDDLE].into_iter().zip([0.0, 0.02, 0.1]) {
            assert!((found - expected).abs() < 1e-3, "{:?}", sheared.strain[MIDDLE]);
        }
    }

    #[test]
    fn without_neighbours_or_with_another_number_of_particles_there_is_no_strain() {
        let mut line = lattice(|x| x);
        line.position.truncate(SIDE);
        line.velocity.truncate(SIDE);
        line.material.truncate(SIDE);
        let of_line = Reference::new(&line).fields(&line);
        assert!(of_line.strain.as_flattened().iter().all(|e| e.is_nan()));
        let fewer = Reference::new(&lattice(|x| x)).fields(&line);
        assert!(fewer.strain.as_flattened().iter().all(|e| e.is_nan()));
        assert_eq!((fewer.density.len(), fewer.strain.len()), (SIDE, SIDE));
    }

    #[test]
    fn particles_pressed_into_one_point_count_all() {
        let mut pressed = lattice(|_| [0.5; 2]);
        for _ in 0..6 {
            let position = pressed.position.clone();
            pressed.position.extend(position);
        }
        let many = pressed.position.len();
        assert!(many > 20_000);
        let sums = kernel_sums(&pressed.position, SPACING);
        assert!((sums[0] / many as f32 - 1.0).abs() < 0.01, "{} of {many}", sums[0]);
    }
}
