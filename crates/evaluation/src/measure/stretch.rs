//! Stretch and distortion of solids: distances between neighbours of the rest shape.

use std::collections::HashMap;

use super::Mean;
use eddy_frames::{Material, distance};

/// Maximum distance of neighbours at rest (spacings): the eight around a particle of a lattice.
const REACH: f32 = 1.5;
/// Maximum number of candidates per particle and cell: where particles are pressed together, all pairs would be the
/// square of their number.
const MAX_CANDIDATES: usize = 64;

/// Two particles that were neighbours in the first frame of a stream.
#[derive(Clone, Copy, Debug)]
struct Pair {
    particles: [u32; 2],
    /// Their distance in that frame (domain lengths).
    rest: f32,
}

/// Pairs of neighbours within one material of a stream.
#[derive(Clone, Debug, Default)]
pub(super) struct NeighbourPairs {
    pairs: Vec<Pair>,
}

impl NeighbourPairs {
    /// The pairs of the material `solid`, given the positions of the first frame.
    pub(super) fn new(
        position: &[[f32; 2]],
        material: &[Material],
        solid: Material,
        spacing: f32,
    ) -> Self {
        let reach = REACH * spacing;
        let at = |k: u32| position[k as usize];
        let cell = |k: u32| at(k).map(|x| (x / reach).floor() as i32);
        let solid = |&k: &u32| material[k as usize] == solid;
        // Ascending in each cell.
        let mut cells: HashMap<[i32; 2], Vec<u32>> = HashMap::new();
        for k in (0..position.len() as u32).filter(solid) {
            cells.entry(cell(k)).or_default().push(k);
        }
        let mut pairs = Vec::new();
        for a in (0..position.len() as u32).filter(solid) {
            let [column, row] = cell(a);
            let around = (-1..=1).flat_map(|x| (-1..=1).map(move |y| [x, y]));
            for [x, y] in around {
                let place = [column.saturating_add(x), row.saturating_add(y)];
                let Some(near) = cells.get(&place) else { continue };
                for &b in near[near.partition_point(|&b| b <= a)..].iter().take(MAX_CANDIDATES) {
                    let rest = distance(at(a), at(b));
                    if rest > 0.0 && rest <= reach {
                        pairs.push(Pair { particles: [a, b], rest });
                    }
                }
            }
        }
        Self { pairs }
    }

    /// Adds the ratio of each pair's distance to its rest distance, and the squared deviation of that ratio from 1.
    pub(super) fn add(&self, position: &[[f32; 2]], stretch: &mut Mean, distortion: &mut Mean) {
        for &Pair { particles: [a, b], rest } in &self.pairs {
            let ratio = f64::from(distance(position[a as usize], position[b as usize]) / rest);
            stretch.add(ratio, 1.0);
            distortion.add((ratio - 1.0) * (ratio - 1.0), 1.0);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SPACING: f32 = 0.0625;

    /// A strip of three rows.
    fn strip(along: f32) -> Vec<[f32; 2]> {
        (0..30).map(|k| [(k % 10) as f32 * SPACING * along, (k / 10) as f32 * SPACING]).collect()
    }

    fn stretched(material: Material, position: &[[f32; 2]]) -> (Mean, Mean) {
        let pairs = NeighbourPairs::new(&strip(1.0), &[material; 30], Material::Rope, SPACING);
        let (mut stretch, mut distortion) = (Mean::default(), Mean::default());
        pairs.add(position, &mut stretch, &mut distortion);
        (stretch, distortion)
    }

    #[test]
    fn a_rope_that_moves_and_turns_is_not_stretched() {
        let turned: Vec<_> = strip(1.0).iter().map(|[x, y]| [2.0 - y, 1.0 + x]).collect();
        let (stretch, distortion) = stretched(Material::Rope, &turned);
        // 27 along, 20 across, 18 + 18 diagonally.
        assert_eq!(stretch.weight, 83.0);
        assert!((stretch.value() - 1.0).abs() < 1e-6 && distortion.value() < 1e-12);
    }

    #[test]
    fn a_rope_twice_as_long_is_stretched_along_but_not_across() {
        let (stretch, distortion) = stretched(Material::Rope, &strip(2.0));
        let diagonal = (5f64 / 2.0).sqrt();
        let expected = (27.0 * 2.0 + 20.0 + 36.0 * diagonal) / 83.0;
        assert!((stretch.value() - expected).abs() < 1e-6);
        let expected = (27.0 + 36.0 * (diagonal - 1.0) * (diagonal - 1.0)) / 83.0;
        assert!((distortion.value() - expected).abs() < 1e-6);
    }

    #[test]
    fn particles_pressed_together_have_a_bounded_number_of_pairs() {
        let pressed: Vec<[f32; 2]> =
            (0..50_000u16).map(|k| [0.5, 0.5 + f32::from(k) * 1e-7]).collect();
        let pairs =
            NeighbourPairs::new(&pressed, &[Material::Rope; 50_000], Material::Rope, SPACING);
        assert!((1..=9 * MAX_CANDIDATES * pressed.len()).contains(&pairs.pairs.len()));
    }

    #[test]
    fn other_materials_do_not_count() {
        assert_eq!(stretched(Material::Jelly, &strip(2.0)).0.weight, 0.0);
    }
}
