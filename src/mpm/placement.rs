//! Which places are free: bodies start inside the walls and not in each other.

use super::{
    error::MpmError,
    grid::{GridShape, WALL_CELLS},
    particle::Particle,
};

/// Cells that stay free between two random bodies, and between a body and a wall.
const GAP_CELLS: usize = 1;

/// Particles of two bodies nearer than this part of their spacing are in each other's bodies.
const NEAREST: f32 = 0.5;

/// The corners of the room between the walls of a grid, lower first (domain lengths).
pub(super) fn room(grid: GridShape) -> [[f32; 2]; 2] {
    let wall = WALL_CELLS as f32 * grid.dx;
    [[wall; 2], grid.size().map(|side| side - wall)]
}

/// Whether a position is in a room. False for NaN.
pub(super) fn inside([lower, upper]: [[f32; 2]; 2], position: [f32; 2]) -> bool {
    (0..2).all(|axis| position[axis] >= lower[axis] && position[axis] <= upper[axis])
}

/// Checks that all particles are between the walls, and that those of different bodies are apart.
/// `owners` says which body each particle is of, ascending.
///
/// # Errors
/// [`MpmError::Outside`], [`MpmError::Overlap`].
pub(super) fn check(
    particles: &[Particle],
    owners: &[usize],
    grid: GridShape,
    spacing: f32,
) -> Result<(), MpmError> {
    let room = room(grid);
    if let Some(outside) = particles.iter().position(|p| !inside(room, p.position)) {
        let (body, position) = (owners[outside], particles[outside].position);
        return Err(MpmError::Outside { body, position, room });
    }
    if owners.first() == owners.last() {
        return Ok(());
    }
    let reach = NEAREST * spacing;
    let cell = |particle: &Particle| particle.position.map(|x| (x / reach) as u32);
    let mut sorted: Vec<([u32; 2], usize)> =
        particles.iter().enumerate().map(|(index, particle)| (cell(particle), index)).collect();
    sorted.sort_unstable();
    for (particle, &owner) in particles.iter().zip(owners) {
        let [i, j] = cell(particle);
        // Particles are inside the walls: no cell is the first one.
        for column in i - 1..=i + 1 {
            let from = sorted.partition_point(|(cell, _)| *cell < [column, j - 1]);
            for &(_, other) in
                sorted[from..].iter().take_while(|(cell, _)| *cell <= [column, j + 1])
            {
                let [x, y] = particles[other].position;
                let distance = (x - particle.position[0]).hypot(y - particle.position[1]);
                if owners[other] > owner && distance < reach {
                    let bodies = [owner, owners[other]];
                    return Err(MpmError::Overlap { bodies, position: [x, y], reach });
                }
            }
        }
    }
    Ok(())
}

/// The cells of the grid that are taken.
#[derive(Clone, Debug)]
pub(super) struct Placement {
    taken: Vec<bool>,
    grid: GridShape,
}

impl Placement {
    /// A free domain.
    pub(super) fn new(grid: GridShape) -> Self {
        let [columns, rows] = grid.cells.map(|cells| cells as usize);
        Self { taken: vec![false; columns * rows], grid }
    }

    /// Takes the cells of a body with these positions (domain lengths) if all are free and inside
    /// the walls. Otherwise takes nothing and says false.
    pub(super) fn take(&mut self, positions: &[[f32; 2]]) -> bool {
        let rows = self.grid.cells[1] as usize;
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
                let start = cell + i * rows - GAP_CELLS * (rows + 1);
                self.taken[start..=start + 2 * GAP_CELLS].fill(true);
            }
        }
        true
    }

    /// The number of a position's cell; `None` too near to a wall.
    fn cell(&self, position: [f32; 2]) -> Option<usize> {
        let border = (WALL_CELLS + GAP_CELLS) as f32;
        let [x, y] = position.map(|x| x / self.grid.dx);
        let [columns, rows] = self.grid.cells;
        let free = |x: f32, cells: u32| x >= border && x < cells as f32 - border;
        (free(x, columns) && free(y, rows)).then(|| x as usize * rows as usize + y as usize)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::frame::Material;

    #[test]
    fn a_place_is_given_once_and_only_inside_the_walls() {
        let mut placement = Placement::new(GridShape::unit(64));
        assert!(placement.take(&[[0.5, 0.5]]));
        assert!(!placement.take(&[[0.5, 0.5]]));
        assert!(!placement.take(&[[0.3, 0.3], [0.5 + 1.0 / 64.0, 0.5]]));
        assert!(placement.take(&[[0.3, 0.3]]), "the place that was refused above is still free");
        assert!(!placement.take(&[[0.5, 0.06]]));
        assert!(!placement.take(&[[0.94, 0.5]]));
    }

    #[test]
    fn particles_in_walls_or_in_other_bodies_are_found() {
        let (grid, spacing) = (GridShape::unit(64), 1.0 / 128.0);
        let check = |positions: &[[f32; 2]]| {
            let particles: Vec<Particle> =
                positions.iter().map(|&x| Particle::at_rest(x, Material::Snow)).collect();
            let owners: Vec<usize> = (0..particles.len()).collect();
            check(&particles, &owners, grid, spacing)
        };
        assert_eq!(check(&[[0.5, 0.5], [0.5 + spacing, 0.5], [0.5, 0.5 - 0.6 * spacing]]), Ok(()));
        let error = check(&[[0.2, 0.2], [0.5, 0.5], [0.5 - 0.3 * spacing, 0.5 + 0.3 * spacing]]);
        assert!(matches!(error, Err(MpmError::Overlap { bodies: [1, 2], .. })), "{error:?}");
        let error = check(&[[0.5, 0.5], [0.5, 0.046]]);
        assert!(matches!(error, Err(MpmError::Outside { body: 1, .. })), "{error:?}");
        assert!(check(&[[f32::NAN, 0.5]]).is_err());
    }
}
