//! The strain of jelly and rope relative to their rest shape: the positions of their particles in the first frame of a
//! stream.
//!
//! The deformation gradient F of a particle is the least-squares map of its neighbours' rest positions X to their current
//! positions x: F = sum over j of (x_j - x) c_j^T, where c_j = k_j A^-1 (X_j - X) and
//! A = sum of k_j (X_j - X)(X_j - X)^T, with weights k that decrease with the distance at rest. It needs no history, so that
//! errors do not accumulate. The strain is B - 1, B = F F^T (left Cauchy-Green).
//!
//! The residual of the fit is the bend: the distance of a particle from where its neighbours and F put it,
//! sum of k_j (x_j - x - F (X_j - X)) / sum of k_j. It detects particles that alternate about their line, which F does not
//! see.

use std::ops::Range;

use rayon::prelude::*;

use eddy_frames::Material;

/// Range of neighbours (spacings at rest).
const RANGE: f64 = 2.1;
/// Largest number of neighbours: the nearest ones.
const MAX_NEIGHBOURS: usize = 12;
/// Features of a particle's shape: Bxx - 1, Byy - 1, Bxy, and the bend along x and y.
pub const SHAPE_FEATURES: usize = 5;
/// Scale of strains and of bends (in spacings at rest), so that usual values are about 1.
pub const SCALE: [f32; SHAPE_FEATURES] = [10.0, 10.0, 10.0, 60.0, 60.0];
/// Limit of the scaled features.
pub const LIMIT: f32 = 4.0;
/// Smallest number of neighbours that determines a deformation.
const MIN_NEIGHBOURS: usize = 3;
/// Ratio of the eigenvalues of A below which the neighbours are considered collinear.
const MIN_EIGENVALUE_RATIO: f64 = 0.05;
/// Particles per cell that are searched. Usually there are about five; the limit keeps the time linear if all particles are in
/// one place.
const MAX_PER_CELL: usize = 128;

/// The rest shapes of the particles of B windows: R = B N rows.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RestShape {
    /// First link of each particle, and the end of the last, `[R + 1]`. A particle without links counts as unstrained.
    first: Vec<u32>,
    links: Vec<Link>,
    /// Weight of each link, and the neighbour's rest position relative to the particle (domain lengths). Separate lists, as
    /// they are read many times per frame.
    neighbours: Vec<WeightedNeighbour>,
    offsets: Vec<[f32; 2]>,
    /// N.
    particles: usize,
}

/// A neighbour of a particle at rest.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Link {
    /// Its row.
    pub particle: u32,
    /// c (1 / domain lengths).
    pub coefficient: [f32; 2],
    /// Coefficient of the bend (spacings at rest / domain lengths).
    pub share: f32,
}

/// A neighbour and its normalised weight.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WeightedNeighbour {
    /// Its row.
    pub particle: u32,
    /// Its weight divided by the sum over the particle's neighbours.
    pub share: f32,
}

impl RestShape {
    /// The rest shapes of particles at `position` (domain lengths), `[R]`, in windows of equally many particles; `spacing` is
    /// the distance between neighbours (domain lengths). Only particles of the same material and window are neighbours.
    ///
    /// # Panics
    /// If the numbers of materials and positions differ, or are not divisible by the number of windows.
    pub fn new(position: &[[f32; 2]], material: &[Material], windows: usize, spacing: f32) -> Self {
        assert_eq!(position.len(), material.len());
        assert!(windows > 0 && position.len().is_multiple_of(windows), "windows: {windows}");
        let range = RANGE * f64::from(spacing);
        if windows == 1 {
            // A single stream: not worth waking other threads.
            return Self::of_window(position, material, range);
        }
        let particles = (position.len() / windows).max(1);
        let places = position.par_chunks(particles).zip(material.par_chunks(particles));
        let shapes: Vec<_> =
            places.map(|(x, material)| Self::of_window(x, material, range)).collect();
        let mut joined = Self { first: vec![0], particles, ..Self::default() };
        for shape in shapes {
            let (row, link) = (joined.len() as u32, joined.links.len() as u32);
            joined.first.extend(shape.first[1..].iter().map(|first| first + link));
            let moved = |link: Link| Link { particle: link.particle + row, ..link };
            joined.links.extend(shape.links.into_iter().map(moved));
            let moved = |neighbour: WeightedNeighbour| WeightedNeighbour {
                particle: neighbour.particle + row,
                ..neighbour
            };
            joined.neighbours.extend(shape.neighbours.into_iter().map(moved));
            joined.offsets.extend(shape.offsets);
        }
        joined
    }

    /// The rest shape of one window.
    fn of_window(position: &[[f32; 2]], material: &[Material], range: f64) -> Self {
        let cells = Cells::new(position, material, range);
        let mut shape = Self { first: vec![0], particles: position.len(), ..Self::default() };
        for (particle, material) in material.iter().enumerate() {
            if material.keeps_shape() {
                for (link, neighbour, offset) in coefficients(&cells.nearest(particle), range) {
                    shape.links.push(link);
                    shape.neighbours.push(neighbour);
                    shape.offsets.push(offset);
                }
            }
            shape.first.push(shape.links.len() as u32);
        }
        shape
    }

    /// The rest shapes in another order of particles: `order[i]` is the row that becomes row i.
    ///
    /// # Panics
    /// If `order` is not a permutation of the rows.
    pub fn permuted(&self, order: &[u32]) -> Self {
        assert_eq!(order.len(), self.len());
        let mut place = vec![0; order.len()];
        for (row, &from) in order.iter().enumerate() {
            place[from as usize] = row as u32;
        }
        let mut first = Vec::with_capacity(order.len() + 1);
        let mut links = Vec::with_capacity(self.links.len());
        let mut neighbours = Vec::with_capacity(self.neighbours.len());
        let mut offsets = Vec::with_capacity(self.offsets.len());
        first.push(0);
        for &from in order {
            let moved = |link: &Link| Link { particle: place[link.particle as usize], ..*link };
            links.extend(self.links(from as usize).iter().map(moved));
            let moved = |neighbour: &WeightedNeighbour| WeightedNeighbour {
                particle: place[neighbour.particle as usize],
                ..*neighbour
            };
            neighbours.extend(self.neighbours(from as usize).iter().map(moved));
            offsets.extend_from_slice(self.offsets(from as usize));
            first.push(links.len() as u32);
        }
        Self { first, links, neighbours, offsets, particles: self.particles }
    }

    /// R.
    pub fn len(&self) -> usize {
        self.first.len().saturating_sub(1)
    }

    /// Whether there is no particle.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The shape of one particle, from the positions of a frame, `[R]`: strain and bend ([`SHAPE_FEATURES`]), scaled and limited;
    /// zeros without a rest shape.
    #[inline(always)]
    pub fn shape_of(&self, particle: usize, position: &[[f32; 2]]) -> [f32; SHAPE_FEATURES] {
        let links = self.links(particle);
        if links.is_empty() {
            return [0.0; SHAPE_FEATURES];
        }
        let (f, bend) = deformation(links, position, position[particle]);
        limited(scaled(f, bend))
    }

    /// The gradient by the positions, `[T R, 2]`, from `gradient`, that by the shape, `[T R, 5]`.
    ///
    /// # Panics
    /// If the numbers of positions and gradients differ or are not a multiple of R.
    pub fn backward(&self, position: &[[f32; 2]], gradient: &[f32]) -> Vec<f32> {
        let rows = self.rows(position);
        assert_eq!(gradient.len(), SHAPE_FEATURES * position.len());
        let (gradient, _) = gradient.as_chunks::<SHAPE_FEATURES>();
        let mut sums = vec![[0.0; 2]; position.len()];
        // One thread per window and frame: sums are in the order of the particles.
        let parts = sums.par_chunks_mut(self.particles.max(1)).enumerate();
        parts.for_each(|(part, sums)| {
            let begin = part * self.particles;
            let frame = begin / rows * rows;
            let position = &position[frame..frame + rows];
            for own in 0..sums.len() {
                let particle = begin - frame + own;
                let links = self.links(particle);
                if links.is_empty() {
                    continue;
                }
                let (f, bend) = deformation(links, position, position[particle]);
                let mut by = gradient[begin + own];
                for ((by, shape), scale) in by.iter_mut().zip(scaled(f, bend)).zip(SCALE) {
                    *by *= if shape.abs() > LIMIT { 0.0 } else { scale };
                }
                let [xx, yy, xy, by_bend @ ..] = by;
                let by_f = [
                    [0, 1].map(|c| 2.0 * xx * f[0][c] + xy * f[1][c]),
                    [0, 1].map(|c| 2.0 * yy * f[1][c] + xy * f[0][c]),
                ];
                for Link { particle: neighbour, coefficient, share } in links {
                    let neighbour = frame + *neighbour as usize - begin;
                    for axis in 0..2 {
                        let by_x = by_f[axis][0] * coefficient[0]
                            + by_f[axis][1] * coefficient[1]
                            + by_bend[axis] * share;
                        sums[neighbour][axis] += by_x;
                        sums[own][axis] -= by_x;
                    }
                }
            }
        });
        sums.into_flattened()
    }

    /// R, but at least 1; checks the number of positions.
    fn rows(&self, position: &[[f32; 2]]) -> usize {
        let rows = self.len().max(1);
        assert!(position.len().is_multiple_of(rows), "{} positions, {rows} rows", position.len());
        rows
    }

    /// The links of a particle.
    #[inline(always)]
    pub fn links(&self, particle: usize) -> &[Link] {
        &self.links[self.numbers(particle)]
    }

    /// The weights of these links.
    #[inline(always)]
    pub fn neighbours(&self, particle: usize) -> &[WeightedNeighbour] {
        &self.neighbours[self.numbers(particle)]
    }

    /// The rest positions of the linked particles, relative to the particle (domain lengths).
    #[inline(always)]
    pub fn offsets(&self, particle: usize) -> &[[f32; 2]] {
        &self.offsets[self.numbers(particle)]
    }

    /// Whether no particle has a rest shape.
    pub fn is_shapeless(&self) -> bool {
        self.links.is_empty()
    }

    #[inline(always)]
    fn numbers(&self, particle: usize) -> Range<usize> {
        self.first[particle] as usize..self.first[particle + 1] as usize
    }
}

/// F, row-major, and the bend (spacings at rest).
#[inline(always)]
pub fn deformation(
    links: &[Link],
    position: &[[f32; 2]],
    [x, y]: [f32; 2],
) -> ([[f32; 2]; 2], [f32; 2]) {
    let (mut f, mut bend) = ([[0.0; 2]; 2], [0.0; 2]);
    for Link { particle, coefficient, share } in links {
        let [to_x, to_y] = position[*particle as usize];
        let apart = [to_x - x, to_y - y];
        for row in 0..2 {
            for column in 0..2 {
                f[row][column] += apart[row] * coefficient[column];
            }
            bend[row] += apart[row] * share;
        }
    }
    (f, bend)
}

/// The features before they are limited.
#[inline(always)]
fn scaled([[a, b], [c, d]]: [[f32; 2]; 2], [x, y]: [f32; 2]) -> [f32; SHAPE_FEATURES] {
    let mut shape = [a * a + b * b - 1.0, c * c + d * d - 1.0, a * c + b * d, x, y];
    for (shape, scale) in shape.iter_mut().zip(SCALE) {
        *shape *= scale;
    }
    shape
}

#[inline(always)]
fn limited(mut shape: [f32; SHAPE_FEATURES]) -> [f32; SHAPE_FEATURES] {
    // A loop: the closure of `map` may not be inlined and would lose the SIMD instruction set.
    for number in &mut shape {
        *number = number.clamp(-LIMIT, LIMIT);
    }
    shape
}

/// A neighbour at rest: its row, and its position relative to the particle (domain lengths).
type Neighbour = (u32, [f64; 2]);

/// The links to these neighbours; none if they do not determine a deformation.
fn coefficients(
    near: &[Neighbour],
    range: f64,
) -> impl Iterator<Item = (Link, WeightedNeighbour, [f32; 2])> {
    let weight = move |[x, y]: [f64; 2]| (1.0 - (x * x + y * y) / (range * range)).powi(2);
    let (mut sum, mut mean) = (0.0, [0.0; 2]);
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for &(_, [x, y]) in near {
        let k = weight([x, y]);
        sum += k;
        mean = [mean[0] + k * x, mean[1] + k * y];
        xx += k * x * x;
        xy += k * x * y;
        yy += k * y * y;
    }
    let determinant = xx * yy - xy * xy;
    let middle = 0.5 * (xx + yy);
    let largest = middle + (0.25 * (xx - yy).powi(2) + xy * xy).sqrt();
    // The smaller eigenvalue is the determinant divided by the larger one.
    let determined =
        near.len() >= MIN_NEIGHBOURS && determinant > MIN_EIGENVALUE_RATIO * largest * largest;
    let near = if determined { near } else { &[] };
    let spacing = range / RANGE;
    near.iter().map(move |&(particle, [x, y])| {
        let k = weight([x, y]);
        let c = [(yy * x - xy * y), (xx * y - xy * x)].map(|c| k * c / determinant);
        // The weighted mean minus its image under F.
        let share = (k - c[0] * mean[0] - c[1] * mean[1]) / (sum * spacing);
        let link = Link { particle, coefficient: c.map(|c| c as f32), share: share as f32 };
        (link, WeightedNeighbour { particle, share: (k / sum) as f32 }, [x as f32, y as f32])
    })
}

/// A hash table of particles by square cells as wide as the range of neighbours. Its size depends on the number of particles,
/// not on the extent of their positions.
struct Cells<'a> {
    position: &'a [[f32; 2]],
    material: &'a [Material],
    range: f64,
    /// First particle of each bucket, and the end of the last.
    first: Vec<u32>,
    order: Vec<u32>,
}

impl<'a> Cells<'a> {
    fn new(position: &'a [[f32; 2]], material: &'a [Material], range: f64) -> Self {
        let places = position.len().next_power_of_two();
        let mut cells =
            Self { position, material, range, first: vec![0; places + 2], order: Vec::new() };
        let place: Vec<_> = position.iter().map(|&x| cells.bucket(cells.cell(x))).collect();
        for &place in &place {
            cells.first[place + 2] += 1;
        }
        for place in 2..cells.first.len() {
            cells.first[place] += cells.first[place - 1];
        }
        cells.order.resize(position.len(), 0);
        for (particle, place) in place.into_iter().enumerate() {
            let next = &mut cells.first[place + 1];
            cells.order[*next as usize] = particle as u32;
            *next += 1;
        }
        cells
    }

    /// The cell at a position; NaN is cast to 0.
    fn cell(&self, position: [f32; 2]) -> [i32; 2] {
        position.map(|x| (f64::from(x) / self.range).floor() as i32)
    }

    /// The bucket of a cell.
    fn bucket(&self, [a, b]: [i32; 2]) -> usize {
        let mixed = (a as u32).wrapping_mul(0x9e37_79b1) ^ (b as u32).wrapping_mul(0x85eb_ca77);
        (mixed ^ mixed >> 15) as usize & (self.first.len() - 3)
    }

    /// The nearest particles of the same material in range.
    fn nearest(&self, particle: usize) -> Vec<Neighbour> {
        let (x, range) = (self.position[particle], self.range);
        let [a, b] = self.cell(x);
        // Squared distance, row, relative position.
        let mut near: Vec<(f64, u32, [f64; 2])> = Vec::with_capacity(MAX_NEIGHBOURS + 1);
        for k in 0..9 {
            let cell = [a.wrapping_add(k % 3 - 1), b.wrapping_add(k / 3 - 1)];
            let place = self.bucket(cell);
            let there = &self.order[self.first[place] as usize..self.first[place + 1] as usize];
            for &other in there.iter().take(MAX_PER_CELL) {
                let row = other as usize;
                let same = self.material[row] == self.material[particle] && row != particle;
                if !same || self.cell(self.position[row]) != cell {
                    continue;
                }
                let apart =
                    [0, 1].map(|axis| f64::from(self.position[row][axis]) - f64::from(x[axis]));
                let squared = apart[0] * apart[0] + apart[1] * apart[1];
                if squared < range * range {
                    let nearer = |kept: &(f64, u32, _)| (kept.0, kept.1) < (squared, other);
                    let at = near.partition_point(nearer);
                    near.insert(at, (squared, other, apart));
                    near.truncate(MAX_NEIGHBOURS);
                }
            }
        }
        near.into_iter().map(|(_, row, apart)| (row, apart)).collect()
    }
}

#[cfg(test)]
mod tests;
