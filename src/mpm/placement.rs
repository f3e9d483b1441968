//! Which places are free: bodies start inside the walls and do not touch.

use super::{grid::WALL_CELLS, preset::Preset};

/// Cells that stay free between two bodies, and between a body and a wall.
const GAP_CELLS: usize = 1;

/// The cells of the grid that are taken.
#[derive(Clone, Debug)]
pub(super) struct Placement {
    taken: Vec<bool>,
    /// Cells on a side.
    cells: usize,
}

impl Placement {
    /// A free domain.
    pub(super) fn new(preset: Preset) -> Self {
        let cells = preset.cells() as usize;
        Self { taken: vec![false; cells * cells], cells }
    }

    /// Takes the cells of a body with these positions (domain lengths) if all are free and inside
    /// the walls. Otherwise takes nothing and says false.
    pub(super) fn take(&mut self, positions: &[[f32; 2]]) -> bool {
        let mut body = Vec::with_capacity(positions.len());
        for position in positions {
            match self.cell(*position) {
                Some(cell) if !self.taken[cell] => body.push(cell),
                _ => return false,
            }
        }
        for cell in body {
            // A body is further from the edge than the gap is wide, so this stays in its row.
            for i in 0..=2 * GAP_CELLS {
                let start = cell + i * self.cells - GAP_CELLS * (self.cells + 1);
                self.taken[start..=start + 2 * GAP_CELLS].fill(true);
            }
        }
        true
    }

    /// The number of a position's cell; `None` too near to a wall.
    fn cell(&self, position: [f32; 2]) -> Option<usize> {
        let border = (WALL_CELLS + GAP_CELLS) as f32;
        let [x, y] = position.map(|x| x * self.cells as f32);
        let inside = |x: f32| x >= border && x < self.cells as f32 - border;
        (inside(x) && inside(y)).then(|| x as usize * self.cells + y as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_place_is_given_once_and_only_inside_the_walls() {
        let mut placement = Placement::new(Preset::MultiMaterial);
        assert!(placement.take(&[[0.5, 0.5]]));
        assert!(!placement.take(&[[0.5, 0.5]]));
        assert!(!placement.take(&[[0.3, 0.3], [0.5 + 1.0 / 64.0, 0.5]]));
        assert!(placement.take(&[[0.3, 0.3]]), "the place that was refused above is still free");
        assert!(!placement.take(&[[0.5, 0.06]]));
        assert!(!placement.take(&[[0.94, 0.5]]));
    }
}
