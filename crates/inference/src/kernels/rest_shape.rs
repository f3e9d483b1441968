//! How far jelly and rope are strained from their rest shape: where their particles were in the first
//! frame of a stream.
//!
//! The deformation gradient F of a particle is the one that carries its neighbours of then, X, to those
//! of now, x, with the least squares: F = sum over j of (x_j - x) c_j^T, where c_j = k_j A^-1 (X_j - X)
//! and A = sum of k_j (X_j - X)(X_j - X)^T, with weights k that fall with the distance then. It needs no
//! history, so that its errors do not add up. The strain is B - 1, B = F F^T (left Cauchy-Green).
//!
//! What F leaves is the bend: how far a particle is from where its neighbours and F have it,
//! sum of k_j (x_j - x - F (X_j - X)) / sum of k_j. It is what shows particles that have gone out of line,
//! one this way, the next that way, of which no F knows.

use std::ops::Range;

use rayon::prelude::*;

use eddy_frames::Material;

/// Range of neighbours (distances between particles at rest).
const RANGE: f64 = 2.1;
/// At most so many neighbours: the nearest.
const MOST: usize = 12;
/// Features of a particle's shape: Bxx - 1, Byy - 1, Bxy, and the bend along x and y.
pub const SHAPE_FEATURES: usize = 5;
/// What they are multiplied by, strains and bends (in spacings at rest), so that what is usual is about 1.
pub const SCALE: [f32; SHAPE_FEATURES] = [10.0, 10.0, 10.0, 60.0, 60.0];
/// How large they get.
pub const LARGEST: f32 = 4.0;
/// With fewer, there is no telling.
const FEWEST: usize = 3;
/// The smaller eigenvalue of A, relative to the larger, below which neighbours are in a line.
const FLATTEST: f64 = 0.05;
/// Particles of a cell that are looked at. At a distance from each other there are five or so; where all
/// are in one place, the search still takes a time in proportion to their number.
const CROWD: usize = 128;

/// The rest shapes of the particles of B windows, R = B N rows one below the other.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RestShape {
    /// Where each particle's links begin, and where the last one's end, `[R + 1]`. Without links it counts
    /// as not strained.
    first: Vec<u32>,
    links: Vec<Link>,
    /// Of each link, and where the neighbour rests from the particle (domain lengths): lists of their own,
    /// which are read many times a frame.
    neighbours: Vec<WeightedNeighbour>,
    offsets: Vec<[f32; 2]>,
    /// N.
    particles: usize,
}

/// A neighbour.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Link {
    /// Its row.
    pub particle: u32,
    /// c (1 / domain lengths).
    pub coefficient: [f32; 2],
    /// Share in the bend: spacings at rest by domain length.
    pub share: f32,
}

/// A neighbour, and how much it counts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct WeightedNeighbour {
    /// Its row.
    pub particle: u32,
    /// Its share in the weights of the particle's neighbours.
    pub share: f32,
}

impl RestShape {
    /// The shapes of particles at `position` (domain lengths), `[R]`, in so many windows of equally many
    /// particles; neighbours at rest are `spacing` apart (domain lengths). Only particles of the same
    /// material and window are neighbours.
    ///
    /// # Panics
    /// When there are not as many materials as positions, or they are not so many windows.
    pub fn new(position: &[[f32; 2]], material: &[Material], windows: usize, spacing: f32) -> Self {
        assert_eq!(position.len(), material.len());
        assert!(windows > 0 && position.len().is_multiple_of(windows), "windows: {windows}");
        let range = RANGE * f64::from(spacing);
        if windows == 1 {
            // A stream's: no other threads are woken for it.
            return Self::of(position, material, range);
        }
        let particles = (position.len() / windows).max(1);
        let places = position.par_chunks(particles).zip(material.par_chunks(particles));
        let shapes: Vec<_> = places.map(|(x, material)| Self::of(x, material, range)).collect();
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

    /// The shape of one window.
    fn of(position: &[[f32; 2]], material: &[Material], range: f64) -> Self {
        let cells = Cells::new(position, material, range);
        let mut shape = Self { first: vec![0], particles: position.len(), ..Self::default() };
        for (particle, material) in material.iter().enumerate() {
            if keeps_shape(*material) {
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

    /// The same shapes in another order of the particles: `order` has the row here of each row there.
    ///
    /// # Panics
    /// When `order` is no permutation of the rows.
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

    /// Whether there are no particles.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The shape of each particle in each of T frames, `[T R, 5]`, from the positions, `[T R]`: strain
    /// and bend ([`SHAPE_FEATURES`]), scaled and limited; zeros for what has no rest shape.
    ///
    /// # Panics
    /// When there are not R positions for each frame.
    pub fn shape(&self, position: &[[f32; 2]]) -> Vec<f32> {
        let rows = self.rows(position);
        let mut shape = vec![[0.0; SHAPE_FEATURES]; position.len()];
        let frames = shape.par_chunks_mut(rows).zip(position.par_chunks(rows));
        frames.for_each(|(shape, position)| {
            shape.par_iter_mut().enumerate().for_each(|(particle, shape)| {
                *shape = self.shape_of(particle, position);
            });
        });
        shape.into_flattened()
    }

    /// The shape of one particle, from the positions of a frame, `[R]`.
    #[inline(always)]
    pub fn shape_of(&self, particle: usize, position: &[[f32; 2]]) -> [f32; SHAPE_FEATURES] {
        let links = self.links(particle);
        if links.is_empty() {
            return [0.0; SHAPE_FEATURES];
        }
        let (f, bend) = deformation(links, position, position[particle]);
        limited(scaled(f, bend))
    }

    /// The gradient `[T R, 2]` by the positions, `[T R]`, from that of the shape, `[T R, 5]`.
    ///
    /// # Panics
    /// When there are not R positions and rows for each frame.
    pub fn backward(&self, position: &[[f32; 2]], gradient: &[f32]) -> Vec<f32> {
        let rows = self.rows(position);
        assert_eq!(gradient.len(), SHAPE_FEATURES * position.len());
        let (gradient, _) = gradient.as_chunks::<SHAPE_FEATURES>();
        let mut sums = vec![[0.0; 2]; position.len()];
        // A window of a frame is one thread's: its sums are in the order of the particles.
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
                    *by *= if shape.abs() > LARGEST { 0.0 } else { scale };
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

    /// R, or 1 where there are none, with a look at the number of positions.
    fn rows(&self, position: &[[f32; 2]]) -> usize {
        let rows = self.len().max(1);
        assert!(position.len().is_multiple_of(rows), "{} positions, {rows} rows", position.len());
        rows
    }

    /// What a particle is linked to.
    #[inline(always)]
    pub fn links(&self, particle: usize) -> &[Link] {
        &self.links[self.numbers(particle)]
    }

    /// How much each of these counts.
    #[inline(always)]
    pub fn neighbours(&self, particle: usize) -> &[WeightedNeighbour] {
        &self.neighbours[self.numbers(particle)]
    }

    /// Where each of these rests, from the particle (domain lengths).
    #[inline(always)]
    pub fn offsets(&self, particle: usize) -> &[[f32; 2]] {
        &self.offsets[self.numbers(particle)]
    }

    /// Whether any particle has a shape.
    pub fn is_shapeless(&self) -> bool {
        self.links.is_empty()
    }

    #[inline(always)]
    fn numbers(&self, particle: usize) -> Range<usize> {
        self.first[particle] as usize..self.first[particle + 1] as usize
    }
}

/// Whether a rest shape means anything for a material.
fn keeps_shape(material: Material) -> bool {
    matches!(material, Material::Jelly | Material::Rope)
}

/// F, by rows, and the bend (spacings at rest).
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

/// The features, before they are limited.
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
    // A loop: what `map` calls may not be inlined, and so use other instructions.
    for number in &mut shape {
        *number = number.clamp(-LARGEST, LARGEST);
    }
    shape
}

/// A neighbour at rest: its row, and where it is from the particle (domain lengths).
type Near = (u32, [f64; 2]);

/// Links to these neighbours; none where they do not tell a deformation.
fn coefficients(
    near: &[Near],
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
    // The smaller eigenvalue is what the larger leaves of the determinant.
    let told = near.len() >= FEWEST && determinant > FLATTEST * largest * largest;
    let near = if told { near } else { &[] };
    let spacing = range / RANGE;
    near.iter().map(move |&(particle, [x, y])| {
        let k = weight([x, y]);
        let c = [(yy * x - xy * y), (xx * y - xy * x)].map(|c| k * c / determinant);
        // What is left of the weighted mean once F has carried it along.
        let share = (k - c[0] * mean[0] - c[1] * mean[1]) / (sum * spacing);
        let link = Link { particle, coefficient: c.map(|c| c as f32), share: share as f32 };
        (link, WeightedNeighbour { particle, share: (k / sum) as f32 }, [x as f32, y as f32])
    })
}

/// Particles by the square cell they are in, as wide as neighbours range. Cells share the places of a
/// table as long as there are particles, so that it does not matter how far apart these are.
struct Cells<'a> {
    position: &'a [[f32; 2]],
    material: &'a [Material],
    range: f64,
    /// Where the particles of each place begin, and where the last one's end.
    first: Vec<u32>,
    order: Vec<u32>,
}

impl<'a> Cells<'a> {
    fn new(position: &'a [[f32; 2]], material: &'a [Material], range: f64) -> Self {
        let places = position.len().next_power_of_two();
        let mut cells =
            Self { position, material, range, first: vec![0; places + 2], order: Vec::new() };
        let place: Vec<_> = position.iter().map(|&x| cells.place(cells.cell(x))).collect();
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

    /// The cell at a position; the lowest for what is not a number.
    fn cell(&self, position: [f32; 2]) -> [i32; 2] {
        position.map(|x| (f64::from(x) / self.range).floor() as i32)
    }

    /// Its place in the table.
    fn place(&self, [a, b]: [i32; 2]) -> usize {
        let mixed = (a as u32).wrapping_mul(0x9e37_79b1) ^ (b as u32).wrapping_mul(0x85eb_ca77);
        (mixed ^ mixed >> 15) as usize & (self.first.len() - 3)
    }

    /// The nearest particles in range, of the same material.
    fn nearest(&self, particle: usize) -> Vec<Near> {
        let (x, range) = (self.position[particle], self.range);
        let [a, b] = self.cell(x);
        // Squared distance, row, place from here.
        let mut near: Vec<(f64, u32, [f64; 2])> = Vec::with_capacity(MOST + 1);
        for k in 0..9 {
            let cell = [a.wrapping_add(k % 3 - 1), b.wrapping_add(k / 3 - 1)];
            let place = self.place(cell);
            let there = &self.order[self.first[place] as usize..self.first[place + 1] as usize];
            for &other in there.iter().take(CROWD) {
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
                    near.truncate(MOST);
                }
            }
        }
        near.into_iter().map(|(_, row, apart)| (row, apart)).collect()
    }
}

#[cfg(test)]
mod tests;
