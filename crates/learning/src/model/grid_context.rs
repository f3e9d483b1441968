//! The sparse grid of the particles of a batch.

use std::sync::Arc;

use eddy_frames::Domain;
use eddy_inference::{
    checkpoint::GridOptions,
    engine::Ballistic,
    kernels::nodes::{Nodes, Window},
};

/// The nodes around the particles of a batch of windows.
#[derive(Clone, Debug)]
pub(crate) struct GridContext {
    pub(crate) nodes: Arc<Nodes>,
    /// Proximity of each node of the finest level to the four walls, `[M, 4]`.
    pub(crate) walls: Arc<Vec<[f32; 4]>>,
    /// Lower corner of the domain (domain lengths).
    pub(crate) origin: [f32; 2],
}

/// The nodes whose rows a linear layer on the grid concatenates.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Table {
    /// The 3 x 3 around each node of a level.
    Neighbours(usize),
    /// The 2 x 2 children of each node of a level, in the next finer level.
    Children(usize),
}

impl GridContext {
    /// The nodes that particles at `position` (domain lengths) touch, in `windows` windows with the same number of particles.
    pub(crate) fn new(
        grid: &GridOptions,
        ballistic: &Ballistic,
        domain: Domain,
        position: &[[f32; 2]],
        windows: usize,
    ) -> Self {
        let (cell_width, particles) = (grid.cell_width, position.len() / windows);
        let windows: Vec<_> = (0..windows)
            .map(|window| Window {
                particles: window * particles..(window + 1) * particles,
                lower: domain.lower,
                upper: domain.upper,
            })
            .collect();
        let mut nodes = Nodes::default();
        nodes.rebuild(position, &windows, cell_width, grid.channels.len());
        let at = nodes.level(0).at.iter();
        let walls = at.map(|&at| wall_proximity(at, cell_width, domain.lower, ballistic)).collect();
        Self { nodes: Arc::new(nodes), walls: Arc::new(walls), origin: domain.lower }
    }
}

/// exp(-d / w) of a node's distances d from the left, lower, right and upper effective wall; 1 beyond.
fn wall_proximity(
    at: [i32; 2],
    cell_width: f32,
    origin: [f32; 2],
    ballistic: &Ballistic,
) -> [f32; 4] {
    let [x, y] = [0, 1].map(|axis| origin[axis] + at[axis] as f32 * cell_width);
    let proximity = |distance: f32| (-distance.max(0.0) / cell_width).exp();
    let ([left, lower], [right, upper]) = (ballistic.lower, ballistic.upper);
    [proximity(x - left), proximity(y - lower), proximity(right - x), proximity(upper - y)]
}
