//! The sparse grid of the particles of a batch.

use eddy_frames::Domain;
use eddy_inference::{
    checkpoint::GridOptions,
    engine::Ballistic,
    kernels::nodes::{Nodes, Window},
    ops::node_inputs::wall_proximity,
};

/// The nodes around the particles of a batch of windows.
#[derive(Debug)]
pub(crate) struct GridContext {
    pub(crate) nodes: Nodes,
    /// Proximity of each node of the finest level to the four walls, `[M, 4]`.
    pub(crate) walls: Vec<[f32; 4]>,
    /// Lower corner of the domain (domain lengths).
    pub(crate) origin: [f32; 2],
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
        Self { nodes, walls, origin: domain.lower }
    }
}
