//! Density maps: the distribution of mass, whichever particles carry it.

use eddy_frames::Domain;

/// Width of a map's cells (spacings): a cell holds about sixteen particles.
const CELL_SPACINGS: f32 = 4.0;
/// Maximum number of cells: for larger domains they are wider.
const MAX_CELLS: f32 = (1 << 20) as f32;
/// Maximum number of cells along an axis.
const MAX_SIDE: f32 = (1 << 18) as f32;

/// Lattice of a domain.
#[derive(Clone, Copy, Debug)]
pub(super) struct Lattice {
    lower: [f32; 2],
    /// Cells per domain length.
    scale: f32,
    nodes: [usize; 2],
}

impl Lattice {
    /// The lattice of a domain, for particles with this spacing (domain lengths).
    pub(super) fn new(domain: Domain, spacing: f32) -> Self {
        let sides = [0, 1].map(|axis| domain.upper[axis] - domain.lower[axis]);
        let min_cell =
            (sides[0].max(sides[1]) / MAX_SIDE).max((sides[0] * sides[1] / MAX_CELLS).sqrt());
        let cell = (CELL_SPACINGS * spacing).max(min_cell);
        let nodes = sides.map(|side| ((side / cell).ceil() as usize).max(1) + 1);
        Self { lower: domain.lower, scale: 1.0 / cell, nodes }
    }

    /// Particles at each node: each particle is distributed bilinearly over the four nodes around it; particles outside
    /// the domain count at its edge.
    pub(super) fn map(&self, position: &[[f32; 2]]) -> Vec<f32> {
        let mut map = vec![0.0; self.nodes[0] * self.nodes[1]];
        for position in position {
            let mut at = [0; 2];
            let mut fraction = [0.0; 2];
            for axis in 0..2 {
                let last = (self.nodes[axis] - 1) as f32;
                let place = ((position[axis] - self.lower[axis]) * self.scale).clamp(0.0, last);
                at[axis] = (place as usize).min(self.nodes[axis] - 2);
                fraction[axis] = place - at[axis] as f32;
            }
            for (dx, wx) in [1.0 - fraction[0], fraction[0]].into_iter().enumerate() {
                for (dy, wy) in [1.0 - fraction[1], fraction[1]].into_iter().enumerate() {
                    map[(at[0] + dx) * self.nodes[1] + at[1] + dy] += wx * wy;
                }
            }
        }
        map
    }
}

/// Half the L1 distance of two maps relative to the total mass: the share of misplaced mass, 0 to 1.
pub(super) fn misplaced(predicted: &[f32], truth: &[f32]) -> f64 {
    let all: f64 = truth.iter().map(|&mass| f64::from(mass)).sum();
    let apart: f64 =
        predicted.iter().zip(truth).map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).sum();
    0.5 * apart / all
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mass_of_every_particle_is_conserved_also_at_the_edge_and_outside() {
        let lattice = Lattice::new(Domain::UNIT, 1.0 / 128.0);
        for position in [[0.3, 0.4], [1.0, 1.0], [0.0, 0.999], [-3.0, 7.0]] {
            let mass: f32 = lattice.map(&[position; 3]).iter().sum();
            assert!((mass - 3.0).abs() < 1e-5, "{position:?}: {mass}");
        }
    }

    #[test]
    fn a_zero_spacing_does_not_exceed_the_maximum_number_of_cells() {
        for domain in [[1.0, 1.0], [4096.0, 1.0], [1e6, 1e-6]] {
            let domain = Domain { lower: [0.0; 2], upper: domain };
            let nodes = Lattice::new(domain, 0.0).map(&[[0.5; 2]]).len();
            assert!(nodes < 3 << 20, "{domain:?}: {nodes}");
        }
    }

    #[test]
    fn moved_mass_is_misplaced_and_exchanged_particles_are_not() {
        let lattice = Lattice::new(Domain::UNIT, 1.0 / 128.0);
        let map = |x: [[f32; 2]; 2]| lattice.map(&x);
        let truth = map([[0.2, 0.2], [0.8, 0.8]]);
        assert!(misplaced(&map([[0.8, 0.8], [0.2, 0.2]]), &truth) < 1e-6);
        assert!((misplaced(&map([[0.2, 0.2], [0.5, 0.5]]), &truth) - 0.5).abs() < 1e-6);
    }
}
