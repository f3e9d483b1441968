//! A liquid keeps its area: where predicted particles are closer together than those of a liquid ever are,
//! they are moved apart, as by the pressure of something incompressible (Kugelstadt et al. 2019, "Implicit
//! density projection for volume conserving liquids").
//!
//! The network's errors of a frame are small, but they add up: a pool would lose a quarter of its area in
//! a second.
//!
//! 1. Fill: how full each node of a grid is, 1 in the middle of a body at rest.
//! 2. Solve: the pressure p with laplacian p = fullest - fill, where there is too much; p = 0 at the surface, no slope at
//!    walls, and it never pulls.
//! 3. Shift: each particle of a liquid goes down the slope of p.

use std::ops::Range;

use crate::{
    frame::{Domain, Material},
    kernels::nodes::weights,
    model::Ballistic,
};

/// Width of a cell (spacings).
const CELL: f32 = 2.0;
/// How full a node is when pressure sets in: with particles in disorder, nodes of the truth are at times this
/// full.
const FULLEST: f32 = 1.25;
/// A node less full than this is beyond the surface.
const SURFACE: f32 = 0.5;
/// How often the pressure at all nodes is made to agree with that at their neighbours.
const SWEEPS: usize = 20;
/// By how much each of these goes too far, on purpose (successive over-relaxation).
const OVER: f32 = 1.7;
/// The longest shift along an axis (cells).
const LONGEST: f32 = 0.5;
/// Nodes before the domain's lower corner: one in the stencils of particles, and one around all.
const MARGIN: usize = 2;

/// The pressure in one frame.
#[derive(Debug)]
pub(super) struct Volume {
    acts: bool,
    corner: [f32; 2],
    /// Cell width (domain lengths).
    width: f32,
    /// Nodes along an axis.
    extent: [usize; 2],
    /// Nodes between walls, along an axis.
    inside: [Range<usize>; 2],
    /// How full each node is, and with liquid, `[nodes up, nodes across]`.
    fill: Vec<f32>,
    liquid: Vec<f32>,
    /// (fill - fullest) of nodes with too much.
    excess: Vec<f32>,
    /// 1 / neighbours between walls, 0 where there is no pressure.
    share: Vec<f32>,
    pressure: Vec<f32>,
    /// A row of the new pressure.
    row: Vec<f32>,
    /// The columns of each row where there is pressure.
    columns: Vec<Range<usize>>,
}

/// The node at the beginning of a stencil, on an axis, and how far beyond it a particle is (cells).
#[inline(always)]
fn base(place: f32) -> (usize, f32) {
    let first = (place - 0.5).floor();
    (first as usize, place - first)
}

/// The slopes of a stencil's [`weights`].
#[inline(always)]
fn slopes(beyond: f32) -> [f32; 3] {
    [beyond - 1.5, 2.0 - 2.0 * beyond, beyond - 0.5]
}

impl Volume {
    /// For particles that are `spacing` apart at rest (domain lengths).
    pub(super) fn new(spacing: f32) -> Self {
        Self {
            acts: false,
            corner: [0.0; 2],
            width: CELL * spacing,
            extent: [0; 2],
            inside: [0..0, 0..0],
            fill: Vec::new(),
            liquid: Vec::new(),
            excess: Vec::new(),
            share: Vec::new(),
            pressure: Vec::new(),
            row: Vec::new(),
            columns: Vec::new(),
        }
    }

    /// Finds the pressure among particles at `position`.
    #[inline(always)]
    pub(super) fn find(
        &mut self,
        position: &[[f32; 2]],
        material: &[Material],
        domain: &Domain,
        walls: &Ballistic,
    ) {
        self.acts = false;
        if !material.contains(&Material::Liquid) {
            return;
        }
        self.make_room(domain, walls);
        self.fill(position, material);
        self.acts = self.limit();
        if self.acts {
            for _ in 0..SWEEPS {
                self.sweep(0);
                self.sweep(1);
            }
            self.extend();
        }
    }

    /// Moves some liquid particles among those that the pressure was found for.
    #[inline(always)]
    pub(super) fn give_way(
        &self,
        position: &mut [[f32; 2]],
        velocity: &mut [[f32; 2]],
        material: &[Material],
        walls: &Ballistic,
    ) {
        if !self.acts {
            return;
        }
        for ((x, v), &material) in position.iter_mut().zip(velocity).zip(material) {
            if material != Material::Liquid {
                continue;
            }
            let shift = self.shift(*x);
            for axis in 0..2 {
                let moved = x[axis] + shift[axis];
                let (lower, upper) = (walls.lower[axis], walls.upper[axis]);
                let place = if moved < lower {
                    lower
                } else if moved > upper {
                    upper
                } else {
                    moved
                };
                v[axis] += (place - x[axis]) / walls.dt;
                x[axis] = place;
            }
        }
    }

    /// How a particle of a liquid is moved (domain lengths).
    #[inline(always)]
    fn shift(&self, position: [f32; 2]) -> [f32; 2] {
        let [x, y] = self.place(position);
        let ((a, x), (b, y)) = (base(x), base(y));
        let (across, up) = ([weights(x), slopes(x)], [weights(y), slopes(y)]);
        let mut slope = [0.0; 2];
        for j in 0..3 {
            let row = &self.pressure[(b + j) * self.extent[0] + a..][..3];
            let sum = |by: &[f32; 3]| by[0] * row[0] + by[1] * row[1] + by[2] * row[2];
            slope[0] += up[0][j] * sum(&across[1]);
            slope[1] += up[1][j] * sum(&across[0]);
        }
        [-slope[0], -slope[1]].map(|way| way.clamp(-LONGEST, LONGEST) * self.width)
    }

    /// Where a particle is (cells from node 0); inside the domain.
    #[inline(always)]
    fn place(&self, position: [f32; 2]) -> [f32; 2] {
        let mut place = [0.0; 2];
        for axis in 0..2 {
            let cells = (position[axis] - self.corner[axis]) / self.width;
            // What is not a number is at the lowest place.
            let most = (self.extent[axis] - 2 * MARGIN) as f32;
            place[axis] = cells.max(0.0).min(most) + MARGIN as f32;
        }
        place
    }

    fn make_room(&mut self, domain: &Domain, walls: &Ballistic) {
        self.corner = domain.lower;
        for axis in 0..2 {
            let cells = ((domain.upper[axis] - domain.lower[axis]) / self.width).ceil();
            self.extent[axis] = cells as usize + 2 * MARGIN;
            let node = |wall: f32, by: f32| (wall - domain.lower[axis]) / self.width + by;
            let first = node(walls.lower[axis], MARGIN as f32 - 0.5).ceil() as usize;
            let last = node(walls.upper[axis], MARGIN as f32 + 0.5).floor() as usize;
            self.inside[axis] = first.max(1)..(last + 1).min(self.extent[axis] - 1);
        }
        let nodes = self.extent[0] * self.extent[1];
        let Self { fill, liquid, excess, share, pressure, .. } = self;
        for list in [fill, liquid, excess, share, pressure] {
            list.clear();
            list.resize(nodes, 0.0);
        }
        self.row.resize(self.extent[0], 0.0);
        self.columns.clear();
        self.columns.resize(self.extent[1], 0..0);
    }

    /// In the order of the particles.
    #[inline(always)]
    fn fill(&mut self, position: &[[f32; 2]], material: &[Material]) {
        let one = 1.0 / (CELL * CELL);
        for (&position, &material) in position.iter().zip(material) {
            let [x, y] = self.place(position);
            let ((a, x), (b, y)) = (base(x), base(y));
            let (across, up) = (weights(x), weights(y));
            let wet = if material == Material::Liquid { 1.0 } else { 0.0 };
            for (j, up) in up.into_iter().enumerate() {
                let nodes = (b + j) * self.extent[0] + a;
                for i in 0..3 {
                    let mass = one * up * across[i];
                    self.fill[nodes + i] += mass;
                    self.liquid[nodes + i] += mass * wet;
                }
            }
        }
    }

    /// Where there can be pressure, and what for. Says whether there is anywhere.
    #[inline(always)]
    fn limit(&mut self) -> bool {
        let [columns, rows] = &self.inside;
        let mut any = false;
        for j in rows.clone() {
            let row = j * self.extent[0];
            let above = u8::from(j > rows.start) + u8::from(j + 1 < rows.end);
            let (mut first, mut end) = (columns.end, columns.start);
            for i in columns.clone() {
                let fill = self.fill[row + i];
                if fill < SURFACE {
                    continue;
                }
                let beside = u8::from(i > columns.start) + u8::from(i + 1 < columns.end);
                self.share[row + i] = 1.0 / f32::from(above + beside);
                (first, end) = (first.min(i), i + 1);
                if fill > FULLEST {
                    // Others are not moved: snow packs, solids have their shape.
                    self.excess[row + i] = (fill - FULLEST) * self.liquid[row + i] / fill;
                    any |= self.excess[row + i] > 0.0;
                }
            }
            self.columns[j] = first.min(end)..end;
        }
        any
    }

    /// One sweep over the nodes of one colour of the checkerboard.
    #[inline(always)]
    fn sweep(&mut self, colour: usize) {
        let across = self.extent[0];
        for j in self.inside[1].clone() {
            let Range { start, end } = self.columns[j];
            if start == end {
                continue;
            }
            let count = end - start;
            let list = |row: usize, from: usize| &self.pressure[row * across + from..][..count];
            let (here, left, right) = (list(j, start), list(j, start - 1), list(j, start + 1));
            let (below, above) = (list(j - 1, start), list(j + 1, start));
            let (excess, share) = (
                &self.excess[j * across + start..][..count],
                &self.share[j * across + start..][..count],
            );
            let new = &mut self.row[..count];
            for i in 0..count {
                let sum = left[i] + right[i] + below[i] + above[i] + excess[i];
                let relaxed = (here[i] + OVER * (sum * share[i] - here[i])).max(0.0);
                let its_turn = (start + i + j) % 2 == colour;
                new[i] = if its_turn { relaxed } else { here[i] };
            }
            self.pressure[j * across + start..][..count].copy_from_slice(&self.row[..count]);
        }
    }

    /// Beyond a wall pressure is what it is at the wall.
    fn extend(&mut self) {
        let across = self.extent[0];
        let [columns, rows] = self.inside.clone();
        for j in rows.clone() {
            let row = j * across;
            self.pressure[row + columns.start - 1] = self.pressure[row + columns.start];
            self.pressure[row + columns.end] = self.pressure[row + columns.end - 1];
        }
        for (to, from) in [(rows.start - 1, rows.start), (rows.end, rows.end - 1)] {
            let from = from * across;
            self.pressure.copy_within(from..from + across, to * across);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::{Frame, Stamp};

    const SPACING: f32 = 1.0 / 128.0;
    const WALLS: Ballistic =
        Ballistic { gravity: [0.0, -9.8], dt: 0.016, lower: [0.03; 2], upper: [0.97; 2] };

    /// A block of 40 x 20 particles whose corner is at `corner`, so many spacings apart.
    fn block(corner: [f32; 2], apart: f32, material: Material) -> Frame {
        let at =
            |k: usize| [corner[0] + apart * (k % 40) as f32, corner[1] + apart * (k / 40) as f32];
        let position: Vec<_> = (0..800).map(at).collect();
        Frame {
            stream: 0,
            sequence: 1,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain::UNIT,
            velocity: vec![[0.0; 2]; position.len()],
            material: vec![material; position.len()],
            position,
        }
    }

    fn found(frame: &Frame) -> Volume {
        let mut volume = Volume::new(SPACING);
        volume.find(&frame.position, &frame.material, &frame.domain, &WALLS);
        volume
    }

    /// Moves all particles of a frame so many times.
    fn moved(mut frame: Frame, times: usize) -> Frame {
        for _ in 0..times {
            let volume = found(&frame);
            let Frame { position, velocity, material, .. } = &mut frame;
            volume.give_way(position, velocity, material, &WALLS);
        }
        frame
    }

    /// The largest that a node is full.
    fn fullest(frame: &Frame) -> f32 {
        let mut volume = Volume::new(SPACING);
        volume.make_room(&frame.domain, &WALLS);
        volume.fill(&frame.position, &frame.material);
        volume.fill.into_iter().fold(0.0, f32::max)
    }

    fn centre(frame: &Frame) -> [f64; 2] {
        [0, 1].map(|axis| {
            frame.position.iter().map(|place| f64::from(place[axis])).sum::<f64>()
                / frame.position.len() as f64
        })
    }

    #[test]
    fn a_block_at_rest_fills_its_nodes_and_stays() {
        let frame = block([0.3, 0.3], SPACING, Material::Liquid);
        assert!((fullest(&frame) - 1.0).abs() < 0.01, "{}", fullest(&frame));
        assert!(!found(&frame).acts);
    }

    #[test]
    fn a_block_pressed_together_expands_around_its_centre() {
        let frame = block([0.3, 0.3], 0.8 * SPACING, Material::Liquid);
        let (before, at) = (fullest(&frame), centre(&frame));
        let frame = moved(frame, 10);
        assert!(before > 1.5 && fullest(&frame) < 1.3, "{before}, {}", fullest(&frame));
        let to = centre(&frame);
        assert!(
            (0..2).all(|axis| (to[axis] - at[axis]).abs() < 0.1 * f64::from(SPACING)),
            "{at:?} {to:?}"
        );
    }

    #[test]
    fn a_pool_pressed_against_floor_and_wall_rises() {
        let frame = block(WALLS.lower, 0.8 * SPACING, Material::Liquid);
        let at = centre(&frame);
        let frame = moved(frame, 10);
        assert!(fullest(&frame) < 1.35, "{}", fullest(&frame));
        let to = centre(&frame);
        assert!(to[0] > at[0] && to[1] > at[1], "{at:?} {to:?}");
    }

    #[test]
    fn what_is_no_liquid_keeps_its_place() {
        for material in [Material::Jelly, Material::Snow, Material::Rope] {
            let frame = block([0.3, 0.3], 0.8 * SPACING, material);
            assert!(!found(&frame).acts);
        }
    }

    #[test]
    fn what_is_no_number_or_outside_moves_nothing_far() {
        let mut frame = block([0.3, 0.3], 0.8 * SPACING, Material::Liquid);
        frame.position[0] = [f32::NAN; 2];
        frame.position[1] = [f32::INFINITY, f32::NEG_INFINITY];
        frame.position[2] = [-7.0, 7.0];
        let volume = found(&frame);
        assert!(volume.acts);
        for &place in &frame.position {
            let shift = volume.shift(place);
            assert!(shift.iter().all(|x| x.abs() <= LONGEST * CELL * SPACING), "{shift:?}");
        }
    }
}
