//! The fill and the pressure of a frame, and how particles move down its gradient.

use std::ops::Range;

use super::{AreaRule, BEYOND, MARGIN};
use crate::{kernels::nodes::weights, ops::ballistic::Ballistic};
use eddy_frames::{Domain, Material};

/// An empty range that can be extended to any nodes.
const NONE: Range<usize> = Range { start: usize::MAX, end: 0 };

/// The pressure in one frame.
#[derive(Debug)]
pub(crate) struct Pressure {
    rule: AreaRule,
    /// Whether it is above zero anywhere.
    acts: bool,
    corner: [f32; 2],
    /// Cell width (domain lengths).
    width: f32,
    /// Nodes along an axis.
    extent: [usize; 2],
    /// Nodes between the walls, along an axis.
    inside: [Range<usize>; 2],
    /// Fill of each node, by all particles and by liquid, `[rows, columns]`.
    fill: Vec<[f32; 2]>,
    /// Liquid above the limit of the fill, as much of it as is removed in a frame.
    excess: Vec<f32>,
    /// 1 / number of neighbours between the walls; 0 where the pressure is zero.
    inverse_neighbours: Vec<f32>,
    pressure: Vec<f32>,
    /// A row of the next iteration's pressure.
    row: Vec<f32>,
    /// The relaxation factor at every other node, else 0.
    relaxation: Vec<f32>,
    /// The columns of each row with particles; [`NONE`] if it has none.
    touched: Vec<Range<usize>>,
    /// The share of a node's stencil that is between the walls, along an axis.
    open: [Vec<f32>; 2],
}

/// The first node of a stencil on an axis, and the particle's distance from it (cells).
#[inline(always)]
fn base(place: f32) -> (usize, f32) {
    let first = (place - 0.5).floor();
    (first as usize, place - first)
}

/// The integral of the quadratic spline from minus infinity to `x` (cells).
fn spline_until(x: f32) -> f32 {
    let tail = |x: f32| (1.5 - x).max(0.0).powi(3) / 6.0;
    match x {
        x if x > 0.5 => 1.0 - tail(x),
        x if x < -0.5 => tail(-x),
        x => 0.5 + 0.75 * x - x.powi(3) / 3.0,
    }
}

/// The derivatives of a stencil's [`weights`].
#[inline(always)]
fn weight_gradients(beyond: f32) -> [f32; 3] {
    [beyond - 1.5, 2.0 - 2.0 * beyond, beyond - 0.5]
}

impl Pressure {
    /// For particles with this spacing at rest (domain lengths).
    pub(super) fn new(rule: AreaRule, spacing: f32) -> Self {
        Self {
            rule,
            acts: false,
            corner: [0.0; 2],
            width: rule.cell_width * spacing,
            extent: [0; 2],
            inside: [0..0, 0..0],
            fill: Vec::new(),
            excess: Vec::new(),
            inverse_neighbours: Vec::new(),
            pressure: Vec::new(),
            row: Vec::new(),
            relaxation: Vec::new(),
            touched: Vec::new(),
            open: [Vec::new(), Vec::new()],
        }
    }

    /// Computes the pressure from the positions of all particles.
    #[inline(always)]
    pub(super) fn solve(
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
        self.resize(domain, walls);
        self.fill(position, material);
        self.acts = self.mark_excess();
        if self.acts {
            for _ in 0..self.rule.sweeps {
                self.sweep(0);
                self.sweep(1);
            }
            self.extend_beyond_walls();
        }
    }

    /// Shifts the liquid particles of a block.
    #[inline(always)]
    pub(super) fn apply(
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
                let shifted = walls.clamp_axis(axis, x[axis] + shift[axis]);
                v[axis] += (shifted - x[axis]) / walls.dt;
                x[axis] = shifted;
            }
        }
    }

    /// The shift of a liquid particle (domain lengths).
    #[inline(always)]
    fn shift(&self, position: [f32; 2]) -> [f32; 2] {
        let [x, y] = self.grid_coordinates(position);
        let ((a, x), (b, y)) = (base(x), base(y));
        let (across, up) = ([weights(x), weight_gradients(x)], [weights(y), weight_gradients(y)]);
        let mut slope = [0.0; 2];
        for (j, (weight, steepness)) in up[0].into_iter().zip(up[1]).enumerate() {
            let row = &self.pressure[(b + j) * self.extent[0] + a..][..3];
            let sum = |by: &[f32; 3]| by[0] * row[0] + by[1] * row[1] + by[2] * row[2];
            slope[0] += weight * sum(&across[1]);
            slope[1] += steepness * sum(&across[0]);
        }
        let longest = self.rule.longest_shift;
        [-slope[0], -slope[1]].map(|way| way.clamp(-longest, longest) * self.width)
    }

    /// A position clamped to the domain (cells from node 0).
    #[inline(always)]
    fn grid_coordinates(&self, position: [f32; 2]) -> [f32; 2] {
        let mut place = [0.0; 2];
        for axis in 0..2 {
            let cells = (position[axis] - self.corner[axis]) / self.width;
            // NaN becomes the lower corner.
            let most = (self.extent[axis] - 2 * MARGIN) as f32;
            place[axis] = cells.max(0.0).min(most) + MARGIN as f32;
        }
        place
    }

    /// Resizes the lists to the domain, and clears the rows that the last frame used.
    fn resize(&mut self, domain: &Domain, walls: &Ballistic) {
        let across = self.extent[0];
        for (j, touched) in self.touched.iter_mut().enumerate().filter(|(_, row)| **row != NONE) {
            let nodes = j * across..(j + 1) * across;
            self.fill[nodes.clone()].fill([0.0; 2]);
            for list in [&mut self.excess, &mut self.inverse_neighbours, &mut self.pressure] {
                list[nodes.clone()].fill(0.0);
            }
            *touched = NONE;
        }
        let before = self.extent;
        self.corner = domain.lower;
        for axis in 0..2 {
            let cells = ((domain.upper[axis] - domain.lower[axis]) / self.width).ceil();
            self.extent[axis] = cells as usize + 2 * MARGIN;
            let node = |place: f32| (place - domain.lower[axis]) / self.width + MARGIN as f32;
            let (lower, upper) = (node(walls.lower[axis]), node(walls.upper[axis]));
            self.inside[axis] = lower.ceil() as usize..upper.floor() as usize + 1;
            let beyond = BEYOND / self.rule.cell_width;
            let open = |node: usize| {
                let node = node as f32;
                spline_until(upper + beyond - node) - spline_until(lower - beyond - node)
            };
            self.open[axis].clear();
            self.open[axis].extend((0..self.extent[axis]).map(open));
        }
        if self.extent != before {
            let nodes = self.extent[0] * self.extent[1];
            self.fill.clear();
            self.fill.resize(nodes, [0.0; 2]);
            for list in [&mut self.excess, &mut self.inverse_neighbours, &mut self.pressure] {
                list.clear();
                list.resize(nodes, 0.0);
            }
            self.row.resize(self.extent[0], 0.0);
            self.relaxation.clear();
            let factor = self.rule.relaxation;
            let alternating = |i: usize| if i.is_multiple_of(2) { factor } else { 0.0 };
            self.relaxation.extend((0..=self.extent[0]).map(alternating));
            self.touched.clear();
            self.touched.resize(self.extent[1], NONE);
        }
    }

    /// Sums the particles on the nodes, in the order of the particles.
    #[inline(always)]
    fn fill(&mut self, position: &[[f32; 2]], material: &[Material]) {
        let one = 1.0 / (self.rule.cell_width * self.rule.cell_width);
        for (&position, &material) in position.iter().zip(material) {
            let [x, y] = self.grid_coordinates(position);
            let ((a, x), (b, y)) = (base(x), base(y));
            let (across, up) = (weights(x), weights(y));
            let wet = if material == Material::Liquid { 1.0 } else { 0.0 };
            for (j, up) in up.into_iter().enumerate() {
                let touched = &mut self.touched[b + j];
                *touched = touched.start.min(a)..touched.end.max(a + 3);
                let nodes = &mut self.fill[(b + j) * self.extent[0] + a..][..3];
                for ([fill, liquid], across) in nodes.iter_mut().zip(across) {
                    let mass = one * up * across;
                    *fill += mass;
                    *liquid += mass * wet;
                }
            }
        }
    }

    /// The columns of a row where the pressure may be above zero.
    #[inline(always)]
    fn columns(&self, row: usize) -> Range<usize> {
        let Range { start, end } = self.touched[row];
        let end = end.min(self.inside[0].end);
        start.max(self.inside[0].start).min(end)..end
    }

    /// Computes the excess and the number of neighbours of each node. Returns whether there is any excess.
    #[inline(always)]
    fn mark_excess(&mut self) -> bool {
        let AreaRule { fill_limit, surface_fill, rate, .. } = self.rule;
        let [columns, rows] = self.inside.clone();
        let mut any = false;
        for j in rows.clone() {
            let row = j * self.extent[0];
            let above = u8::from(j > rows.start) + u8::from(j + 1 < rows.end);
            for i in self.columns(j) {
                // Compensates for the part of the stencil beyond walls.
                let [found, liquid] = self.fill[row + i];
                let fill = found / (self.open[0][i] * self.open[1][j]);
                let beside = u8::from(i > columns.start) + u8::from(i + 1 < columns.end);
                let neighbours = above + beside;
                if fill < surface_fill || neighbours == 0 {
                    continue;
                }
                self.inverse_neighbours[row + i] = 1.0 / f32::from(neighbours);
                if fill > fill_limit {
                    // Only liquid moves: snow is compressible, and solids keep their shape.
                    self.excess[row + i] = rate * (fill - fill_limit) * liquid / found;
                    any |= self.excess[row + i] > 0.0;
                }
            }
        }
        any
    }

    /// Copies the pressure at walls to the nodes beyond.
    #[inline(always)]
    fn extend_beyond_walls(&mut self) {
        let [columns, rows] = self.inside.clone();
        let across = self.extent[0];
        for j in rows.clone().filter(|&j| self.touched[j] != NONE) {
            let row = &mut self.pressure[j * across..][..across];
            let (first, last) = (row[columns.start], row[columns.end - 1]);
            row[..columns.start].fill(first);
            row[columns.end..].fill(last);
        }
        for (wall, beyond) in
            [(rows.start, 0..rows.start), (rows.end - 1, rows.end..self.extent[1])]
        {
            for j in beyond.filter(|&j| self.touched[j] != NONE) {
                if self.touched[wall] != NONE {
                    self.pressure.copy_within(wall * across..(wall + 1) * across, j * across);
                }
            }
        }
    }

    /// A sweep of successive over-relaxation over the nodes of one colour of the checkerboard.
    #[inline(always)]
    fn sweep(&mut self, colour: usize) {
        let across = self.extent[0];
        for j in self.inside[1].clone() {
            let Range { start, end } = self.columns(j);
            if start == end {
                continue;
            }
            let count = end - start;
            let list = |row: usize, from: usize| &self.pressure[row * across + from..][..count];
            let (here, left, right) = (list(j, start), list(j, start - 1), list(j, start + 1));
            let (below, above) = (list(j - 1, start), list(j + 1, start));
            let (excess, inverse) = (
                &self.excess[j * across + start..][..count],
                &self.inverse_neighbours[j * across + start..][..count],
            );
            let factors = &self.relaxation[(start + j + colour) % 2..][..count];
            let new = &mut self.row[..count];
            for i in 0..count {
                let sum = left[i] + right[i] + below[i] + above[i] + excess[i];
                let relaxed = here[i] + factors[i] * (sum * inverse[i] - here[i]);
                new[i] = if relaxed > 0.0 { relaxed } else { 0.0 };
            }
            self.pressure[j * across + start..][..count].copy_from_slice(&self.row[..count]);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ops::rules::Rules;
    use eddy_frames::{Frame, Stamp};

    const SPACING: f32 = 1.0 / 128.0;
    const WALLS: Ballistic =
        Ballistic { gravity: [0.0, -9.8], dt: 0.016, lower: [0.03; 2], upper: [0.97; 2] };

    /// A block of 40 x 20 particles whose corner is at `corner`, with a particle spacing of `apart`.
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

    /// The rule that removes all of the excess.
    fn rule() -> AreaRule {
        AreaRule { rate: 1.0, ..Rules::STANDARD.area.unwrap() }
    }

    fn solved(frame: &Frame) -> Pressure {
        let mut pressure = Pressure::new(rule(), SPACING);
        pressure.solve(&frame.position, &frame.material, &frame.domain, &WALLS);
        pressure
    }

    /// Applies the rule to a frame `times` times.
    fn moved(mut frame: Frame, times: usize) -> Frame {
        for _ in 0..times {
            let pressure = solved(&frame);
            let Frame { position, velocity, material, .. } = &mut frame;
            pressure.apply(position, velocity, material, &WALLS);
        }
        frame
    }

    /// The largest fill of a node.
    fn fullest(frame: &Frame) -> f32 {
        let mut pressure = Pressure::new(rule(), SPACING);
        pressure.resize(&frame.domain, &WALLS);
        pressure.fill(&frame.position, &frame.material);
        pressure.fill.into_iter().map(|[fill, _]| fill).fold(0.0, f32::max)
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
        assert!(!solved(&frame).acts);
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
    fn shifts_are_proportional_to_the_rate() {
        // Shifts shorter than the longest.
        let frame = block([0.3, 0.3], 0.88 * SPACING, Material::Liquid);
        let shifts = |rate: f32| {
            let mut pressure = Pressure::new(AreaRule { rate, ..rule() }, SPACING);
            pressure.solve(&frame.position, &frame.material, &frame.domain, &WALLS);
            frame.position.iter().map(|place| pressure.shift(*place)).collect::<Vec<_>>()
        };
        let (whole, part) = (shifts(1.0), shifts(0.1));
        let largest = whole.iter().flatten().fold(0.0, |most: f32, way| most.max(way.abs()));
        assert!(largest > 0.1 * SPACING, "{largest}");
        for (whole, part) in whole.iter().flatten().zip(part.iter().flatten()) {
            assert!((0.1 * whole - part).abs() < 1e-4 * largest, "{whole}, {part}");
        }
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
    fn a_pool_is_not_pushed_into_a_wall_wherever_it_lies_between_nodes() {
        for step in 0..16 {
            let right = 0.9 + 0.25 * SPACING * step as f32;
            let walls = Ballistic { upper: [right, 0.97], ..WALLS };
            let frame =
                block([right - 39.0 * 0.85 * SPACING, 0.03], 0.85 * SPACING, Material::Liquid);
            let mut pressure = Pressure::new(rule(), SPACING);
            pressure.solve(&frame.position, &frame.material, &frame.domain, &walls);
            let at_wall: Vec<_> = (5..15).map(|row| frame.position[40 * row + 38]).collect();
            let farthest = at_wall.iter().map(|x| pressure.shift(*x)[0]).fold(-1.0, f32::max);
            assert!(farthest < 0.05 * SPACING, "{step}: {farthest}");
        }
    }

    #[test]
    fn the_derivative_of_the_splines_integral_is_the_spline() {
        assert_eq!([-1.5, 0.0, 1.5].map(spline_until), [0.0, 0.5, 1.0]);
        for x in [-1.4f32, -0.9, -0.5, -0.2, 0.3, 0.5, 1.2] {
            let slope = (spline_until(x + 1e-2) - spline_until(x - 1e-2)) / 2e-2;
            let spline = if x.abs() < 0.5 { 0.75 - x * x } else { 0.5 * (1.5 - x.abs()).powi(2) };
            assert!((slope - spline).abs() < 1e-2, "{x}: {slope}, {spline}");
        }
    }

    #[test]
    fn other_materials_do_not_move() {
        for material in [Material::Jelly, Material::Snow, Material::Rope] {
            let frame = block([0.3, 0.3], 0.8 * SPACING, material);
            assert!(!solved(&frame).acts);
        }
    }

    #[test]
    fn nan_and_positions_outside_the_domain_cause_no_large_shift() {
        let mut frame = block([0.3, 0.3], 0.8 * SPACING, Material::Liquid);
        frame.position[0] = [f32::NAN; 2];
        frame.position[1] = [f32::INFINITY, f32::NEG_INFINITY];
        frame.position[2] = [-7.0, 7.0];
        let pressure = solved(&frame);
        assert!(pressure.acts);
        for &place in &frame.position {
            let shift = pressure.shift(place);
            assert!(
                shift.iter().all(|x| x.abs() <= rule().longest_shift * rule().cell_width * SPACING),
                "{shift:?}"
            );
        }
    }
}
