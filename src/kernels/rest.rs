//! How far jelly and rope are strained from their rest shape: where their particles were in the first
//! frame of a stream.
//!
//! The deformation gradient F of a particle is the one that carries its neighbours of then, X, to those
//! of now, x, with the least squares: F = sum over j of (x_j - x) c_j^T, where c_j = k_j A^-1 (X_j - X)
//! and A = sum of k_j (X_j - X)(X_j - X)^T, with weights k that fall with the distance then. It needs no
//! history, so that its errors do not add up. The strain is B - 1, B = F F^T (left Cauchy-Green).

use rayon::prelude::*;

use crate::frame::Material;

/// Range of neighbours (distances between particles at rest).
const RANGE: f64 = 2.1;
/// At most so many neighbours: the nearest.
const MOST: usize = 12;
/// With fewer, there is no telling.
const FEWEST: usize = 3;
/// The smaller eigenvalue of A, relative to the larger, below which neighbours are in a line.
const FLATTEST: f64 = 0.05;
/// Particles of a cell that are looked at. At a distance from each other there are five or so; where all
/// are in one place, the search still takes a time in proportion to their number.
const CROWD: usize = 128;

/// The rest shape of the particles of one frame, or of several.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Rest {
    /// Where each particle's links begin, and where the last one's end, `[R + 1]`. Without links it counts
    /// as not strained.
    first: Vec<u32>,
    links: Vec<Link>,
    /// First particle of each of the joined shapes.
    begins: Vec<usize>,
}

/// A neighbour.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Link {
    /// Its row.
    particle: u32,
    /// c (1 / domain lengths).
    coefficient: [f32; 2],
}

impl Rest {
    /// The shape of particles at `position` (domain lengths), neighbours at rest being `spacing` apart
    /// (domain lengths). Neighbours are of the same material.
    ///
    /// # Panics
    /// When there are not as many materials as positions.
    pub fn new(position: &[[f32; 2]], material: &[Material], spacing: f32) -> Self {
        assert_eq!(position.len(), material.len());
        let range = RANGE * f64::from(spacing);
        let cells = Cells::new(position, material, range);
        let mut first = vec![0];
        let mut links = Vec::new();
        for (particle, material) in material.iter().enumerate() {
            if keeps_shape(*material) {
                let near = cells.nearest(particle);
                links.extend(coefficients(&near, range));
            }
            first.push(links.len() as u32);
        }
        Self { first, links, begins: vec![0] }
    }

    /// Shapes behind each other, as their particles' rows are.
    pub fn join<'a>(shapes: impl IntoIterator<Item = &'a Self>) -> Self {
        let mut joined = Self { first: vec![0], ..Self::default() };
        for Self { first, links, begins } in shapes {
            let (row, link) = (joined.len(), joined.links.len());
            joined.begins.extend(begins.iter().map(|begin| begin + row));
            joined.first.extend(first[1..].iter().map(|first| first + link as u32));
            let moved = |link: &Link| Link { particle: link.particle + row as u32, ..*link };
            joined.links.extend(links.iter().map(moved));
        }
        joined
    }

    /// How many particles there are.
    pub fn len(&self) -> usize {
        self.first.len().saturating_sub(1)
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The strain of each particle, `[R, 3]`: Bxx - 1, Byy - 1, Bxy, each within -1 and 1.
    ///
    /// # Panics
    /// When there are not as many positions as particles.
    pub fn strain(&self, position: &[[f32; 2]]) -> Vec<f32> {
        assert_eq!(position.len(), self.len());
        let mut strain = vec![[0.0; 3]; position.len()];
        strain.par_iter_mut().enumerate().for_each(|(particle, strain)| {
            *strain = self.strain_of(particle, position);
        });
        strain.into_flattened()
    }

    /// The strain of one particle.
    #[inline(always)]
    pub fn strain_of(&self, particle: usize, position: &[[f32; 2]]) -> [f32; 3] {
        let links = self.links(particle);
        if links.is_empty() {
            return [0.0; 3];
        }
        strain(deformation(links, position, position[particle]))
            .map(|number| number.clamp(-1.0, 1.0))
    }

    /// The gradient `[R, 2]` by the positions from that of the strain, `[R, 3]`.
    ///
    /// # Panics
    /// When there are not as many positions or rows as particles.
    pub fn backward(&self, position: &[[f32; 2]], gradient: &[f32]) -> Vec<f32> {
        assert_eq!([position.len(), gradient.len()], [self.len(), 3 * self.len()]);
        let (gradient, _) = gradient.as_chunks::<3>();
        let mut sums = vec![[0.0; 2]; position.len()];
        let ends = self.begins.iter().skip(1).copied().chain([self.len()]);
        let mut parts = Vec::new();
        let mut rest = sums.as_mut_slice();
        for (&begin, end) in self.begins.iter().zip(ends) {
            let (part, others) = rest.split_at_mut(end - begin);
            parts.push((begin, part));
            rest = others;
        }
        parts.into_par_iter().for_each(|(begin, sums)| {
            for particle in begin..begin + sums.len() {
                let links = self.links(particle);
                if links.is_empty() {
                    continue;
                }
                let f = deformation(links, position, position[particle]);
                let mut by = gradient[particle];
                for (by, strain) in by.iter_mut().zip(strain(f)) {
                    if strain.abs() > 1.0 {
                        *by = 0.0;
                    }
                }
                let [xx, yy, xy] = by;
                let by_f = [
                    [0, 1].map(|c| 2.0 * xx * f[0][c] + xy * f[1][c]),
                    [0, 1].map(|c| 2.0 * yy * f[1][c] + xy * f[0][c]),
                ];
                for Link { particle: neighbour, coefficient } in links {
                    for axis in 0..2 {
                        let by_x = by_f[axis][0] * coefficient[0] + by_f[axis][1] * coefficient[1];
                        sums[*neighbour as usize - begin][axis] += by_x;
                        sums[particle - begin][axis] -= by_x;
                    }
                }
            }
        });
        sums.into_flattened()
    }

    #[inline(always)]
    fn links(&self, particle: usize) -> &[Link] {
        &self.links[self.first[particle] as usize..self.first[particle + 1] as usize]
    }
}

/// Whether a rest shape means anything for a material.
fn keeps_shape(material: Material) -> bool {
    matches!(material, Material::Jelly | Material::Rope)
}

/// F, by rows.
#[inline(always)]
fn deformation(links: &[Link], position: &[[f32; 2]], [x, y]: [f32; 2]) -> [[f32; 2]; 2] {
    let mut f = [[0.0; 2]; 2];
    for Link { particle, coefficient } in links {
        let [to_x, to_y] = position[*particle as usize];
        let apart = [to_x - x, to_y - y];
        for row in 0..2 {
            for column in 0..2 {
                f[row][column] += apart[row] * coefficient[column];
            }
        }
    }
    f
}

/// Bxx - 1, Byy - 1, Bxy.
#[inline(always)]
fn strain([[a, b], [c, d]]: [[f32; 2]; 2]) -> [f32; 3] {
    [a * a + b * b - 1.0, c * c + d * d - 1.0, a * c + b * d]
}

/// A neighbour at rest: its row, and where it is from the particle (domain lengths).
type Near = (u32, [f64; 2]);

/// Links to these neighbours; none where they do not tell a deformation.
fn coefficients(near: &[Near], range: f64) -> impl Iterator<Item = Link> {
    let weight = move |[x, y]: [f64; 2]| (1.0 - (x * x + y * y) / (range * range)).powi(2);
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for &(_, [x, y]) in near {
        let k = weight([x, y]);
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
    near.iter().map(move |&(particle, [x, y])| {
        let k = weight([x, y]) / determinant;
        let coefficient = [k * (yy * x - xy * y), k * (xx * y - xy * x)];
        Link { particle, coefficient: coefficient.map(|c| c as f32) }
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
