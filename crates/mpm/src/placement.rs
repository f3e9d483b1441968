//! Placement of bodies inside the walls and without overlaps.

use super::{
    body::Body,
    error::MpmError,
    grid::{GridShape, WALL_CELLS},
    particle::Particle,
};

/// Free cells between two random bodies, and between a body and a wall.
const GAP_CELLS: usize = 1;

/// Maximum distance of a point in a body from the nearest particle (spacings): half the diagonal of a lattice cell.
const REACH: f32 = 0.71;

/// Corners of the region between the walls of a grid, lower first (domain lengths).
pub(super) fn interior(grid: GridShape) -> [[f32; 2]; 2] {
    let wall = WALL_CELLS as f32 * grid.dx;
    [[wall; 2], grid.size().map(|side| side - wall)]
}

/// Whether a position lies in a box. False for NaN.
pub(super) fn inside([lower, upper]: [[f32; 2]; 2], position: [f32; 2]) -> bool {
    (0..2).all(|axis| position[axis] >= lower[axis] && position[axis] <= upper[axis])
}

/// Checks that all particles are between the walls and that bodies do not overlap. `owners` has the index of each
/// particle's body, ascending.
///
/// # Errors
/// [`MpmError::Outside`], [`MpmError::Overlap`].
pub(super) fn check(
    bodies: &[Body],
    particles: &[Particle],
    owners: &[usize],
    grid: GridShape,
    spacing: f32,
) -> Result<(), MpmError> {
    let room = interior(grid);
    if let Some(outside) = particles.iter().position(|p| !inside(room, p.position)) {
        let (body, position) = (owners[outside], particles[outside].position);
        return Err(MpmError::Outside { body, position, room });
    }
    if owners.first() == owners.last() {
        return Ok(());
    }
    let reach = REACH * spacing;
    let cell = |position: [f32; 2]| position.map(|x| (x / reach) as u32);
    let mut sorted: Vec<([u32; 2], usize)> =
        particles.iter().enumerate().map(|(index, p)| (cell(p.position), index)).collect();
    sorted.sort_unstable();
    for (&Particle { position, .. }, &owner) in particles.iter().zip(owners) {
        let [i, j] = cell(position);
        // Particles are inside the walls, so no cell index is 0.
        for column in i - 1..=i + 1 {
            let from = sorted.partition_point(|(cell, _)| *cell < [column, j - 1]);
            let near = sorted[from..].iter().take_while(|(cell, _)| *cell <= [column, j + 1]);
            for other in near.map(|&(_, other)| other).filter(|&other| owners[other] > owner) {
                let other_position = particles[other].position;
                // Particles of bodies that only touch may be close along the seam, and a body need not fill its
                // outline: check both bodies.
                let close = distance(position, other_position) < reach;
                if close
                    && (bodies[owners[other]].contains(position)
                        || bodies[owner].contains(other_position))
                {
                    return Err(MpmError::Overlap { bodies: [owner, owners[other]], position });
                }
            }
        }
    }
    Ok(())
}

fn distance(a: [f32; 2], b: [f32; 2]) -> f32 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The occupied cells of the grid.
#[derive(Clone, Debug)]
pub(super) struct Placement {
    taken: Vec<bool>,
    grid: GridShape,
}

impl Placement {
    /// An empty domain.
    pub(super) fn new(grid: GridShape) -> Self {
        let [columns, rows] = grid.cells.map(|cells| cells as usize);
        Self { taken: vec![false; columns * rows], grid }
    }

    /// Occupies the cells of a body with these positions (domain lengths) if all are free and inside the walls. Otherwise
    /// changes nothing and returns false.
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
            // A body is further from the edge than the width of the gap, so this stays in its row.
            for i in 0..=2 * GAP_CELLS {
                let start = cell + i * rows - GAP_CELLS * (rows + 1);
                self.taken[start..=start + 2 * GAP_CELLS].fill(true);
            }
        }
        true
    }

    /// Index of a position's cell; `None` if too close to a wall.
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
    use super::{super::shape::Shape, *};
    use eddy_frames::Material;

    #[test]
    fn cells_are_occupied_once_and_only_inside_the_walls() {
        let mut placement = Placement::new(GridShape::unit(64));
        assert!(placement.take(&[[0.5, 0.5]]));
        assert!(!placement.take(&[[0.5, 0.5]]));
        assert!(!placement.take(&[[0.3, 0.3], [0.5 + 1.0 / 64.0, 0.5]]));
        assert!(placement.take(&[[0.3, 0.3]]), "a rejected body occupies nothing");
        assert!(!placement.take(&[[0.5, 0.06]]));
        assert!(!placement.take(&[[0.94, 0.5]]));
    }

    /// Checks rectangles given by sides (spacings), position and angle (degrees).
    fn checked(rectangles: &[([f32; 2], [f32; 2], f32)]) -> Result<(), MpmError> {
        let (grid, spacing) = (GridShape::unit(64), 1.0 / 128.0);
        let body = |&(sides, position, angle_degrees): &([f32; 2], [f32; 2], f32)| Body {
            material: Material::Snow,
            shape: Shape::Rectangle { size: sides.map(|side| side * spacing) },
            position,
            angle_degrees,
            velocity: [0.0; 2],
            particles: None,
        };
        let bodies: Vec<Body> = rectangles.iter().map(body).collect();
        let (mut particles, mut owners) = (Vec::new(), Vec::new());
        for (index, body) in bodies.iter().enumerate() {
            for position in body.positions(spacing) {
                particles.push(Particle::at_rest(position, body.material));
                owners.push(index);
            }
        }
        check(&bodies, &particles, &owners, grid, spacing)
    }

    #[test]
    fn bodies_may_touch_but_not_overlap() {
        let square = [10.0, 10.0];
        let beside = |spacings: f32, degrees| {
            checked(&[
                (square, [0.5, 0.5], degrees),
                (square, [0.5 + spacings / 128.0, 0.5], degrees),
            ])
        };
        assert_eq!(beside(10.0, 0.0), Ok(()));
        for (spacings, degrees) in [(9.0, 0.0), (5.5, 0.0), (5.0, 45.0), (0.0, 30.0)] {
            let found = beside(spacings, degrees);
            assert!(matches!(found, Err(MpmError::Overlap { bodies: [0, 1], .. })), "{found:?}");
        }
        // Half a spacing off on both axes no particle is near to one of the other body.
        let found = checked(&[(square, [0.5, 0.5], 0.0), (square, [0.50390625, 0.50390625], 0.0)]);
        assert!(found.is_err());
    }

    #[test]
    fn particles_in_walls_are_found() {
        let small = [1.0, 1.0];
        assert_eq!(checked(&[(small, [0.5, 0.047], 0.0)]), Ok(()));
        let found = checked(&[(small, [0.5, 0.5], 0.0), (small, [0.5, 0.046], 0.0)]);
        assert!(matches!(found, Err(MpmError::Outside { body: 1, .. })), "{found:?}");
        assert!(checked(&[(small, [f32::NAN, 0.5], 0.0)]).is_err());
    }
}
