//! Fields of particles that follow from their positions: density and strain, both relative to the first frame of a stream.

use std::{array, collections::HashMap};

use eddy_frames::{Frame, Material};
use eddy_inference::kernels::spacing::{median, spacing};

/// Radius of the kernel of the density (spacings).
const RADIUS: f32 = 2.5;
/// Maximum distance of neighbours in the first frame (spacings): the 8 around a particle of a square lattice, 18 of a cubic one.
const REACH: f32 = 1.6;
/// Maximum number of particles of a cell that are summed over: where particles are pressed together, all pairs would be the
/// square of their number.
const MAX_CANDIDATES: usize = 256;
/// Smallest determinant of the second moments of a neighbourhood, relative to that of equal extents, that has a strain in all
/// directions: in the plane, extents of 1 and .03.
const MIN_FLATNESS: f32 = 4e-3;

/// Fields of one frame.
pub(super) struct Fields {
    /// Density relative to the median of the first frame, `[N]`: 1 is packed as densely as there. Lower at free surfaces,
    /// where the kernel reaches beyond the particles.
    pub(super) density: Vec<f32>,
    /// Green-Lagrange strain since the first frame with the components of [`strain_components`], `[N, D (D + 1) / 2]`. NaN
    /// without neighbours of the same material in at least `D` directions, and where the number of particles has changed.
    pub(super) strain: Vec<f32>,
}

/// Names and axes of the components of a symmetric tensor, in the order of VTK.
pub(super) const fn strain_components<const D: usize>() -> &'static [(&'static str, [usize; 2])] {
    match D {
        2 => &[("xx", [0, 0]), ("yy", [1, 1]), ("xy", [0, 1])],
        _ => &[
            ("xx", [0, 0]),
            ("yy", [1, 1]),
            ("zz", [2, 2]),
            ("xy", [0, 1]),
            ("yz", [1, 2]),
            ("xz", [0, 2]),
        ],
    }
}

/// The first frame of a stream, which fields are relative to.
pub(super) struct Reference<const D: usize> {
    /// Radius of the kernel (domain lengths).
    radius: f32,
    /// Median of the kernel sums.
    packed: f32,
    position: Vec<[f32; D]>,
    /// Neighbours of particle k: `neighbours[ends[k]..ends[k + 1]]`.
    neighbours: Vec<u32>,
    ends: Vec<usize>,
}

impl<const D: usize> Reference<D> {
    /// The reference `frame`.
    pub(super) fn new(frame: &Frame<D>) -> Self {
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
    pub(super) fn has_strain_of(&self, frame: &Frame<D>) -> bool {
        frame.len() == self.position.len()
    }

    /// The fields of a frame of the same stream.
    pub(super) fn fields(&self, frame: &Frame<D>) -> Fields {
        let sums = kernel_sums(&frame.position, self.radius);
        let density = sums.into_iter().map(|sum| sum / self.packed).collect();
        let strain = match self.has_strain_of(frame) {
            true => (0..frame.len()).flat_map(|k| self.strain(k, &frame.position)).collect(),
            false => vec![f32::NAN; frame.len() * strain_components::<D>().len()],
        };
        Fields { density, strain }
    }

    /// Green-Lagrange strain of particle `k`, from the deformation gradient F that fits the displacements of its neighbours
    /// best: with rest distances X and present ones x, F = (sum x X^T) (sum X X^T)^-1.
    fn strain(&self, k: usize, position: &[[f32; D]]) -> impl Iterator<Item = f32> + use<D> {
        let [mut rests, mut moments] = [[[0.0_f32; D]; D]; 2];
        for &other in &self.neighbours[self.ends[k]..self.ends[k + 1]] {
            let rest = difference(self.position[other as usize], self.position[k]);
            let now = difference(position[other as usize], position[k]);
            for (row, (along, now)) in (0..D).zip(rest.into_iter().zip(now)) {
                for (column, rest) in rest.into_iter().enumerate() {
                    rests[row][column] += along * rest;
                    moments[row][column] += now * rest;
                }
            }
        }
        let cofactor: [[f32; D]; D] =
            array::from_fn(|row| array::from_fn(|column| cofactor(&rests, row, column)));
        let determinant = (0..D).map(|k| rests[0][k] * cofactor[0][k]).sum::<f32>();
        let trace: f32 = (0..D).map(|k| rests[k][k]).sum();
        let is_flat =
            determinant <= (0..D).fold(MIN_FLATNESS, |least, _| least * (trace / D as f32));
        // Of a symmetric matrix, whose inverse is that of its cofactors over its determinant.
        let gradient = moments.map(|moment| {
            cofactor.map(|of| (0..D).map(|k| moment[k] * of[k]).sum::<f32>() / determinant)
        });
        strain_components::<D>().iter().map(move |&(_, [a, b])| {
            let product: f32 = gradient.iter().map(|row| row[a] * row[b]).sum();
            let unit = if a == b { 1.0 } else { 0.0 };
            if is_flat { f32::NAN } else { 0.5 * (product - unit) }
        })
    }
}

/// What the element of a matrix is multiplied with in its determinant.
fn cofactor<const D: usize>(of: &[[f32; D]; D], row: usize, column: usize) -> f32 {
    let [[a, b], [c, d]] =
        [1, 2].map(|down| [1, 2].map(|right| of[(row + down) % D][(column + right) % D]));
    match D {
        2 if row == column => a,
        2 => -a,
        _ => a * d - b * c,
    }
}

/// The sum of a kernel over the particles around each, itself included.
fn kernel_sums<const D: usize>(position: &[[f32; D]], radius: f32) -> Vec<f32> {
    let cells = Cells::new(position, radius);
    let sum = |&at: &[f32; D]| {
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

/// Particles by square or cubic cell.
struct Cells<const D: usize> {
    width: f32,
    cells: HashMap<[i32; D], Vec<u32>>,
}

impl<const D: usize> Cells<D> {
    fn new(position: &[[f32; D]], width: f32) -> Self {
        let mut cells = Self { width, cells: HashMap::new() };
        for (k, &at) in position.iter().enumerate() {
            cells.cells.entry(cells.cell(at)).or_default().push(k as u32);
        }
        cells
    }

    /// The cast saturates.
    fn cell(&self, at: [f32; D]) -> [i32; D] {
        at.map(|x| (x / self.width).floor() as i32)
    }

    /// The cells around a position that have particles, and the number that each of at most [`MAX_CANDIDATES`] of its
    /// particles stands for.
    fn around(&self, at: [f32; D]) -> impl Iterator<Item = (&[u32], f32)> {
        let own = self.cell(at);
        let places = 3_i32.pow(D as u32);
        (0..places).filter_map(move |place| {
            let offset = |axis| place / 3_i32.pow((D - 1 - axis) as u32) % 3 - 1;
            let around = array::from_fn(|axis| own[axis].saturating_add(offset(axis)));
            let cell = self.cells.get(&around)?;
            let counted = cell.len().div_ceil(cell.len().div_ceil(MAX_CANDIDATES));
            Some((&cell[..], cell.len() as f32 / counted as f32))
        })
    }
}

fn difference<const D: usize>(a: [f32; D], b: [f32; D]) -> [f32; D] {
    array::from_fn(|axis| a[axis] - b[axis])
}

fn squared<const D: usize>(vector: [f32; D]) -> f32 {
    vector.into_iter().map(|x| x * x).sum()
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

    fn assert_near<const N: usize>(found: &[f32], expected: [f32; N]) {
        for (number, expected) in expected.iter().enumerate() {
            assert!((found[number] - expected).abs() < 1e-3, "{:?}", &found[..N]);
        }
    }

    #[test]
    fn the_first_frame_has_density_one_and_no_strain() {
        let Fields { density, strain } = fields(|x| x);
        assert!((density[MIDDLE] - 1.0).abs() < 1e-5, "{}", density[MIDDLE]);
        assert!(density[0] < 0.6, "a corner: {}", density[0]);
        assert!(strain.iter().all(|e| e.abs() < 1e-4));
    }

    #[test]
    fn a_square_pressed_to_four_fifths_is_denser_and_strained_along_one_axis() {
        let Fields { density, strain } = fields(|[x, y]| [0.8 * x + 0.3, y]);
        assert!((density[MIDDLE] - 1.25).abs() < 0.05, "{}", density[MIDDLE]);
        // (0.8^2 - 1) / 2.
        assert_near(&strain[3 * MIDDLE..], [-0.18, 0.0, 0.0]);
    }

    #[test]
    fn a_rotation_is_no_strain_and_a_shear_is() {
        let (sin, cos) = 0.7_f32.sin_cos();
        let turned = fields(|[x, y]| [cos * x - sin * y, sin * x + cos * y]);
        assert!(turned.strain.iter().all(|e| e.abs() < 1e-3));
        let sheared = fields(|[x, y]| [x + 0.2 * y, y]);
        // F = [[1, 0.2], [0, 1]].
        assert_near(&sheared.strain[3 * MIDDLE..], [0.0, 0.02, 0.1]);
    }

    #[test]
    fn a_block_in_space_is_denser_and_strained_along_all_axes() {
        const SIDE: usize = 9;
        let block = |deformed: fn([f32; 3]) -> [f32; 3]| {
            let place = |k: usize| {
                [k % SIDE, k / SIDE % SIDE, k / SIDE / SIDE].map(|number| number as f32 * SPACING)
            };
            let position: Vec<_> = (0..SIDE.pow(3)).map(|k| deformed(place(k))).collect();
            Frame {
                stream: 1,
                sequence: 0,
                stamp: Stamp(0),
                dt: 0.016,
                domain: Domain { lower: [0.0; 3], upper: [1.0; 3] },
                velocity: position.clone(),
                material: vec![Material::Jelly; position.len()],
                position,
            }
        };
        let rest = block(|x| x);
        let middle = SIDE.pow(3) / 2;
        // F = [[1, 0, 0.2], [0, 0.8, 0], [0, 0, 1]].
        let pressed = block(|[x, y, z]| [x + 0.2 * z, 0.8 * y, z]);
        let Fields { density, strain } = Reference::new(&rest).fields(&pressed);
        // In the middle of the block, as a lattice has few particles that its surface does not touch.
        let at_rest = Reference::new(&rest).fields(&rest).density[middle];
        assert!((density[middle] / at_rest - 1.25).abs() < 0.05, "{}", density[middle]);
        assert_near(&strain[6 * middle..], [0.0, -0.18, 0.02, 0.0, 0.0, 0.1]);
        let turned = block(|[x, y, z]| [0.6 * x - 0.8 * z, y, 0.8 * x + 0.6 * z]);
        let turned = Reference::new(&rest).fields(&turned);
        assert!(turned.strain.iter().all(|e| e.abs() < 1e-3));
        // F = [[1, .1, .2], [.3, 1, .4], [.5, .6, 1]].
        let sheared = block(|[x, y, z]| {
            [x + 0.1 * y + 0.2 * z, 0.3 * x + y + 0.4 * z, 0.5 * x + 0.6 * y + z]
        });
        let sheared = Reference::new(&rest).fields(&sheared);
        assert_near(&sheared.strain[6 * middle..], [0.17, 0.185, 0.1, 0.35, 0.51, 0.41]);
        // A layer whose particles lie above and below a plane by turns.
        for (thickness, is_flat) in [(0.0, true), (0.01, true), (0.05, false)] {
            let mut layer = block(|x| x);
            layer.position.truncate(SIDE * SIDE);
            layer.velocity.truncate(SIDE * SIDE);
            layer.material.truncate(SIDE * SIDE);
            for (k, [.., z]) in layer.position.iter_mut().enumerate() {
                *z = if k % 2 == 0 { thickness * SPACING } else { -thickness * SPACING };
            }
            let strain = Reference::new(&layer).fields(&layer).strain;
            assert_eq!(strain[6 * (SIDE * SIDE / 2)].is_nan(), is_flat, "{thickness}");
        }
    }

    #[test]
    fn without_neighbours_or_with_another_number_of_particles_there_is_no_strain() {
        let mut line = lattice(|x| x);
        line.position.truncate(SIDE);
        line.velocity.truncate(SIDE);
        line.material.truncate(SIDE);
        let of_line = Reference::new(&line).fields(&line);
        assert!(of_line.strain.iter().all(|e| e.is_nan()));
        let fewer = Reference::new(&lattice(|x| x)).fields(&line);
        assert!(fewer.strain.iter().all(|e| e.is_nan()));
        assert_eq!((fewer.density.len(), fewer.strain.len()), (SIDE, 3 * SIDE));
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
