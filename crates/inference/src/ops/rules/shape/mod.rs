//! Jelly and rope keep their shape: predicted particles that are out of line with their neighbours, or stretched further
//! than these materials allow, are moved to the positions that their neighbours and the rest shape imply
//! ("As-rigid-as-possible surface modeling", Sorkine and Alexa 2007, with strain limits instead of rotations).
//!
//! Without it, the errors of a network accumulate until a body crumples within a second.
//!
//! 1. Gather: positions in the order of the hidden state.
//! 2. Limit: the deformation gradient F of each particle with limited stretches ([`ShapeRule::strain_limit`]).
//! 3. Offset: the distance of a particle from the mean of its neighbours if they have their rest shape, deformed by F: the
//!    mean of (F + F_j) (X - X_j) / 2 with X the rest positions.
//! 4. Relax, [`ShapeRule::sweeps`] times: each particle moves to its neighbours' mean plus that offset.
//! 5. Scatter: writes the positions back and changes the velocities accordingly.

use std::ops::Range;

use serde::{Deserialize, Serialize};

use super::{
    Ballistic, InFrame, Launch, Most, Network, Observed, Predicted, RuleOperation, WrongConstant,
    bodies::Bodies,
};
use crate::kernels::rest_shape::{RestShape, deformation};
use eddy_threads::DisjointSlice;

/// Constants of the rule that jelly and rope keep their shape: each particle moves to the position that its neighbours and
/// the rest shape imply.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShapeRule {
    /// Largest strain: stretches of the deformation gradient are limited to 1 - `strain_limit`..1 + `strain_limit`; at least 0,
    /// below 1.
    pub strain_limit: f32,
    /// Number of relaxation sweeps, 1 to 1000.
    pub sweeps: usize,
}

/// Rows per item.
const ROWS: usize = 256;

/// A deformation gradient, row-major.
type Gradient = [[f32; 2]; 2];

/// The steps before and after the sweeps; an item is a block of rows of the hidden state.
const GATHER: usize = 0;
const LIMIT: usize = 1;
const OFFSET: usize = 2;
/// The first sweep.
const RELAX: usize = 3;

impl RuleOperation for ShapeRule {
    const STANDARD: Option<Self> = Some(Self { strain_limit: 0.03, sweeps: 5 });
    const DEVICE: &'static str = include_str!("device.cu");
    /// A limited deformation gradient, positions before and after a sweep, an offset.
    const DEVICE_NUMBERS: usize = 4 + 2 * 2 + 2;

    type Scratch = Scratch;
    type InFrame<'a> = Shape<'a>;

    fn check(&self, _: &Network) -> Result<(), WrongConstant> {
        let strain = self.strain_limit;
        let expected = "at least 0 and below 1";
        WrongConstant::unless((0.0..1.0).contains(&strain), "strain_limit", strain, expected)?;
        WrongConstant::unless_sweeps(self.sweeps)
    }

    fn steps(&self) -> usize {
        RELAX + self.sweeps + 1
    }

    fn begin<'a>(&self, scratch: &'a mut Scratch, observed: &Observed<'a>) -> Shape<'a> {
        scratch.shape(*self, observed.rest, observed.order)
    }

    fn device_constants(&self, _: &Network) -> Vec<(&'static str, f32)> {
        vec![("strain_limit", self.strain_limit), ("sweeps", self.sweeps as f32)]
    }

    fn launches(&self, most: &Most) -> Vec<Launch> {
        let limit = Launch::new("shape_limit", most.particles);
        let relax = Launch::new("shape_relax", most.particles);
        let sweeps = (0..self.sweeps).map(|step| Launch { step, ..relax });
        [limit].into_iter().chain(sweeps).collect()
    }
}

/// Scratch buffers between steps, by rows of the hidden state.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    /// Positions before and after a sweep, alternating.
    place: [Vec<[f32; 2]>; 2],
    limited: Vec<Gradient>,
    offset: Vec<[f32; 2]>,
}

/// The rule in one frame.
pub(crate) struct Shape<'a> {
    rule: ShapeRule,
    rest: &'a RestShape,
    /// The frame's particle in each row.
    order: &'a [u32],
    place: [DisjointSlice<'a, [f32; 2]>; 2],
    limited: DisjointSlice<'a, Gradient>,
    offset: DisjointSlice<'a, [f32; 2]>,
}

impl Scratch {
    /// The rule for particles with the rest shape `rest`, where `order` has the particle of each row.
    fn shape<'a>(
        &'a mut self,
        rule: ShapeRule,
        rest: &'a RestShape,
        order: &'a [u32],
    ) -> Shape<'a> {
        let Self { place, limited, offset } = self;
        let rows = order.len();
        place.iter_mut().for_each(|list| list.resize(rows, [0.0; 2]));
        limited.resize(rows, Gradient::default());
        offset.resize(rows, [0.0; 2]);
        let place = place.each_mut().map(|list| DisjointSlice::new(list));
        Shape {
            rule,
            rest,
            order,
            place,
            limited: DisjointSlice::new(limited),
            offset: DisjointSlice::new(offset),
        }
    }
}

impl InFrame for Shape<'_> {
    /// None if no particle has a rest shape.
    fn items(&self, _: usize, _: &Observed<'_>) -> usize {
        self.blocks()
    }

    #[inline(always)]
    fn run(
        &self,
        step: usize,
        item: usize,
        observed: &Observed<'_>,
        _: &Bodies,
        predicted: &Predicted<'_>,
    ) {
        let Predicted { position, velocity, .. } = predicted;
        self.step(step, item, (position, velocity), &observed.ballistic);
    }
}

impl Shape<'_> {
    fn blocks(&self) -> usize {
        if self.rest.is_shapeless() { 0 } else { self.order.len().div_ceil(ROWS) }
    }

    /// Runs an item of a step on the predicted positions and velocities.
    #[inline(always)]
    fn step(
        &self,
        step: usize,
        item: usize,
        (position, velocity): (&DisjointSlice<'_, [f32; 2]>, &DisjointSlice<'_, [f32; 2]>),
        walls: &Ballistic,
    ) {
        let rows = item * ROWS..((item + 1) * ROWS).min(self.order.len());
        match step {
            GATHER => self.gather(rows, position),
            LIMIT => self.limit(rows),
            OFFSET => self.offset(rows),
            step if step < RELAX + self.rule.sweeps => self.relax(step - RELAX, rows, walls),
            _ => self.scatter(rows, position, velocity, walls),
        }
    }

    #[inline(always)]
    fn gather(&self, rows: Range<usize>, position: &DisjointSlice<'_, [f32; 2]>) {
        // SAFETY: this step only reads the positions, and only this item uses these rows.
        let (position, [first, second]) = unsafe {
            let place = [self.place[0].part(rows.clone()), self.place[1].part(rows.clone())];
            (position.read(0..position.len()), place)
        };
        for ((&particle, first), second) in self.order[rows].iter().zip(first).zip(second) {
            // Particles without a rest shape keep their position in both.
            (*first, *second) = (position[particle as usize], position[particle as usize]);
        }
    }

    #[inline(always)]
    fn limit(&self, rows: Range<usize>) {
        // SAFETY: this step only reads the positions, and only this item uses these rows.
        let (place, limits) =
            unsafe { (self.place[0].read(0..self.order.len()), self.limited.part(rows.clone())) };
        for (row, limit) in rows.zip(limits) {
            let links = self.rest.links(row);
            *limit = match links {
                [] => [[1.0, 0.0], [0.0, 1.0]],
                links => limited(deformation(links, place, place[row]).0, self.rule.strain_limit),
            };
        }
    }

    #[inline(always)]
    fn offset(&self, rows: Range<usize>) {
        // SAFETY: this step only reads the gradients, and only this item uses these rows.
        let (limited, offsets) =
            unsafe { (self.limited.read(0..self.order.len()), self.offset.part(rows.clone())) };
        for (row, offset) in rows.zip(offsets) {
            let own = limited[row];
            // A local sum stays in a register.
            let mut sum = [0.0; 2];
            for (neighbour, &[x, y]) in self.rest.neighbours(row).iter().zip(self.rest.offsets(row))
            {
                let theirs = limited[neighbour.particle as usize];
                for axis in 0..2 {
                    let (a, b) = (own[axis][0] + theirs[axis][0], own[axis][1] + theirs[axis][1]);
                    sum[axis] -= 0.5 * neighbour.share * (a * x + b * y);
                }
            }
            *offset = sum;
        }
    }

    #[inline(always)]
    fn relax(&self, sweep: usize, rows: Range<usize>, walls: &Ballistic) {
        let (from, to) = (&self.place[sweep % 2], &self.place[(sweep + 1) % 2]);
        // SAFETY: a sweep reads one of the lists and the offsets and writes the other list, where only this item uses these
        // rows.
        let (from, offsets, to) = unsafe {
            (from.read(0..self.order.len()), self.offset.read(rows.clone()), to.part(rows.clone()))
        };
        for ((row, offset), to) in rows.zip(offsets).zip(to) {
            let neighbours = self.rest.neighbours(row);
            if neighbours.is_empty() {
                continue;
            }
            let mut place = *offset;
            for neighbour in neighbours {
                let position = from[neighbour.particle as usize];
                place[0] += neighbour.share * position[0];
                place[1] += neighbour.share * position[1];
            }
            for axis in 0..2 {
                to[axis] = walls.clamp_axis(axis, place[axis]);
            }
        }
    }

    #[inline(always)]
    fn scatter(
        &self,
        rows: Range<usize>,
        position: &DisjointSlice<'_, [f32; 2]>,
        velocity: &DisjointSlice<'_, [f32; 2]>,
        walls: &Ballistic,
    ) {
        // SAFETY: this step only reads these lists.
        let places = unsafe { self.place[self.rule.sweeps % 2].read(rows.clone()) };
        for (row, place) in rows.zip(places) {
            if self.rest.links(row).is_empty() {
                continue;
            }
            let particle = self.order[row] as usize;
            // SAFETY: a particle has one row, which only this item uses.
            let (x, v) = unsafe {
                let x = position.part(particle..particle + 1);
                (&mut x[0], &mut velocity.part(particle..particle + 1)[0])
            };
            for axis in 0..2 {
                v[axis] += (place[axis] - x[axis]) / walls.dt;
            }
            *x = *place;
        }
    }
}

/// The gradient with limited stretches (singular values); an inversion is undone.
#[inline(always)]
fn limited([[a, b], [c, d]]: Gradient, strain: f32) -> Gradient {
    // Any 2 x 2 matrix is a scaled rotation, [[p, -q], [q, p]], plus a scaled reflection, [[r, s], [s, -r]]: its singular
    // values are the sum and the difference of the two scales.
    let (p, q) = (0.5 * (a + d), 0.5 * (c - b));
    let (r, s) = (0.5 * (a - d), 0.5 * (c + b));
    let (rotation, reflection) = ((p * p + q * q).sqrt(), (r * r + s * s).sqrt());
    let most = (rotation + reflection).clamp(1.0 - strain, 1.0 + strain);
    let least = (rotation - reflection).clamp(1.0 - strain, 1.0 + strain);
    let p_scale = 0.5 * (most + least) / rotation.max(f32::MIN_POSITIVE);
    let r_scale = 0.5 * (most - least) / reflection.max(f32::MIN_POSITIVE);
    let (p, q, r, s) = (p * p_scale, q * p_scale, r * r_scale, s * r_scale);
    [[p + r, s - q], [s + q, p - r]]
}

#[cfg(test)]
mod tests {
    use rand::{RngExt as _, SeedableRng as _};
    use rand_chacha::ChaCha8Rng;

    use super::super::Rules;
    use super::*;
    use eddy_frames::Material;

    const SPACING: f32 = 1.0 / 128.0;
    const COLUMNS: usize = 24;
    const RULE: ShapeRule = Rules::STANDARD.shape.unwrap();
    const STRAIN: f32 = RULE.strain_limit;
    const WALLS: Ballistic =
        Ballistic { gravity: [0.0, -9.8], dt: 0.016, lower: [0.03; 2], upper: [0.97; 2] };

    /// A block of 24 x 12 particles.
    fn block() -> Vec<[f32; 2]> {
        let at = |k: usize| [(k % COLUMNS) as f32, (k / COLUMNS) as f32];
        (0..COLUMNS * 12).map(|k| at(k).map(|x| 0.4 + SPACING * x)).collect()
    }

    /// Positions of a deformed block after the rule was applied `times` times, and velocities, which were zero before the
    /// last time.
    fn corrected(
        material: Material,
        mut position: Vec<[f32; 2]>,
        times: usize,
    ) -> [Vec<[f32; 2]>; 2] {
        let rest = RestShape::new(&block(), &vec![material; position.len()], 1, SPACING);
        let order: Vec<u32> = (0..position.len() as u32).collect();
        let mut velocity = Vec::new();
        for _ in 0..times {
            velocity = vec![[0.0; 2]; position.len()];
            let mut scratch = Scratch::default();
            let shape = scratch.shape(RULE, &rest, &order);
            let (x, v) = (DisjointSlice::new(&mut position), DisjointSlice::new(&mut velocity));
            let items = shape.blocks();
            for step in 0..RULE.steps() {
                (0..items).for_each(|item| shape.step(step, item, (&x, &v), &WALLS));
            }
        }
        [position, velocity]
    }

    /// Root mean square of the relative change of distances to the right and upper neighbours.
    fn distortion(position: &[[f32; 2]]) -> f32 {
        let off = |a: usize, b: usize| {
            let [x, y] = [0, 1].map(|axis| position[b][axis] - position[a][axis]);
            (x.hypot(y) / SPACING - 1.0).powi(2)
        };
        let pairs = (0..position.len()).flat_map(|k| {
            let right = (k % COLUMNS + 1 < COLUMNS).then_some(k + 1);
            let above = (k + COLUMNS < position.len()).then_some(k + COLUMNS);
            right.into_iter().chain(above).map(move |other| (k, other))
        });
        let (sum, count) = pairs.fold((0.0, 0), |(sum, n), (a, b)| (sum + off(a, b), n + 1));
        (sum / count as f32).sqrt()
    }

    fn farthest(a: &[[f32; 2]], b: &[[f32; 2]]) -> f32 {
        let apart = |(a, b): (&[f32; 2], &[f32; 2])| (a[0] - b[0]).hypot(a[1] - b[1]);
        a.iter().zip(b).map(apart).fold(0.0, f32::max)
    }

    #[test]
    fn a_block_that_moved_rotated_and_is_a_little_strained_stays() {
        let (sin, cos) = 0.7f32.sin_cos();
        let moved = |[x, y]: [f32; 2]| {
            let (x, y) = (1.02 * (x - 0.5), 0.985 * (y - 0.5));
            [0.5 + cos * x - sin * y, 0.45 + sin * x + cos * y]
        };
        let position: Vec<_> = block().into_iter().map(moved).collect();
        let [after, velocity] = corrected(Material::Jelly, position.clone(), 1);
        assert!(farthest(&after, &position) < 1e-3 * SPACING);
        let fastest = farthest(&velocity, &vec![[0.0; 2]; velocity.len()]);
        assert!(fastest < 1e-3 * SPACING / WALLS.dt, "{fastest}");
    }

    #[test]
    fn particles_out_of_line_return_and_the_centre_stays() {
        let mut random = ChaCha8Rng::seed_from_u64(3);
        let mut jolted = |x: [f32; 2]| x.map(|x| x + random.random_range(-0.2..0.2) * SPACING);
        let position: Vec<_> = block().into_iter().map(&mut jolted).collect();
        for material in [Material::Jelly, Material::Rope] {
            let [after, velocity] = corrected(material, position.clone(), 1);
            let (before, left) = (distortion(&position), distortion(&after));
            assert!(before > 0.15 && left < 0.25 * before, "{before} {left}");
            let mean = |list: &[[f32; 2]], axis: usize| {
                list.iter().map(|x| x[axis]).sum::<f32>() / list.len() as f32
            };
            for axis in 0..2 {
                let shift = mean(&after, axis) - mean(&position, axis);
                assert!(shift.abs() < 0.02 * SPACING, "{shift}");
                let faster = mean(&velocity, axis) - shift / WALLS.dt;
                assert!(faster.abs() < 1e-3, "{faster}");
            }
        }
    }

    #[test]
    fn a_block_compressed_to_half_its_width_expands() {
        let pressed = |[x, y]: [f32; 2]| [0.5 + 0.5 * (x - 0.5), y];
        let position: Vec<_> = block().into_iter().map(pressed).collect();
        let [after, _] = corrected(Material::Jelly, position.clone(), 100);
        let (before, left) = (distortion(&position), distortion(&after));
        assert!(before > 0.3 && left < 1.2 * STRAIN, "{before} {left}");
    }

    #[test]
    fn particles_without_a_rest_shape_stay() {
        for material in [Material::Liquid, Material::Snow] {
            let position: Vec<_> = block().into_iter().map(|[x, y]| [0.5 * x, y]).collect();
            let [after, velocity] = corrected(material, position.clone(), 1);
            assert_eq!(after, position);
            assert!(velocity.iter().all(|v| *v == [0.0; 2]));
        }
    }

    #[test]
    fn limited_gradients_keep_their_directions() {
        let (sin, cos) = 0.3f32.sin_cos();
        let turned = |x: f32, y: f32| [[cos * x, -sin * y], [sin * x, cos * y]];
        for (found, expected) in [
            (turned(1.01, 0.99), turned(1.01, 0.99)),
            (turned(1.5, 1.0), turned(1.0 + STRAIN, 1.0)),
            (turned(0.2, 1.2), turned(1.0 - STRAIN, 1.0 + STRAIN)),
            (turned(1.2, -0.4), turned(1.0 + STRAIN, 1.0 - STRAIN)),
        ] {
            let limited = limited(found, STRAIN);
            let off = limited.as_flattened().iter().zip(expected.as_flattened());
            assert!(off.clone().all(|(a, b)| (a - b).abs() < 1e-5), "{limited:?} {expected:?}");
        }
        assert!(limited([[0.0; 2]; 2], STRAIN).as_flattened().iter().all(|x| x.is_finite()));
    }
}
