//! What surrounds a particle: particles write to the nodes around them, convolutions pass on what is
//! written between the nodes of three levels, particles read.
//!
//! The grid is sparse: only nodes that particles touch exist ([`Nodes`]), so that the cost grows with
//! the particles and not with the domain. A convolution is a linear layer over the rows of the nodes
//! around a node; where there is none, zeros stand in.

use std::sync::Arc;

use burn::tensor::{Tensor, activation::relu};

use super::{fused, layers::Linear, sparse, training};
use eddy_frames::Domain;
use eddy_inference::{
    checkpoint::GridOptions,
    engine::Ballistic,
    kernels::nodes::{Nodes, Window},
};

/// The layers on the grid and the one behind it.
#[derive(Clone, Debug)]
pub(crate) struct GridLayers {
    /// In the order of [`layout`](eddy_inference::checkpoint::layout), from `grid.0.a` to `grid.0.c`.
    pub(crate) grid: [Linear; 11],
    /// Features, and what was read from the grid, to the core's input.
    pub(crate) context: Linear,
}

/// The nodes around the particles of some windows.
#[derive(Clone, Debug)]
pub(crate) struct Ground {
    pub(crate) nodes: Arc<Nodes>,
    /// Nearness of the four walls at each node of the finest level, `[M, 4]`.
    pub(crate) walls: Arc<Vec<[f32; 4]>>,
    /// Lower corner of the domain (domain lengths).
    pub(crate) origin: [f32; 2],
}

impl Ground {
    /// The nodes that particles at `position` (domain lengths) touch, in `windows` windows of equally
    /// many.
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
        nodes.rebuild(position, &windows, cell_width);
        let at = nodes.level(0).at.iter();
        let walls = at.map(|&at| wall_nearness(at, cell_width, domain.lower, ballistic)).collect();
        Self { nodes: Arc::new(nodes), walls: Arc::new(walls), origin: domain.lower }
    }
}

/// exp(-d / w) of a node's distances d from the left, lower, right and upper wall in effect; 1 beyond.
pub(crate) fn wall_nearness(
    at: [i32; 2],
    cell_width: f32,
    origin: [f32; 2],
    ballistic: &Ballistic,
) -> [f32; 4] {
    let [x, y] = [0, 1].map(|axis| origin[axis] + at[axis] as f32 * cell_width);
    let near = |distance: f32| (-distance.max(0.0) / cell_width).exp();
    let ([left, lower], [right, upper]) = (ballistic.lower, ballistic.upper);
    [near(x - left), near(y - lower), near(right - x), near(upper - y)]
}

impl GridLayers {
    /// What each particle reads, `[R, C0]`, where all have written `encoded`, `[R, C0]`, from
    /// `position`, `[R, 2]`.
    pub(crate) fn look_around(
        &self,
        ground: &Ground,
        encoded: Tensor<2>,
        position: &Tensor<2>,
    ) -> Tensor<2> {
        let [a0, b0, down1, a1, down2, a2, b2, up1, b1, up0, c0] = &self.grid;
        let level = |level| Level { ground, level };
        let written = write(ground, encoded, position.clone()); // [M0, C0 + 5]
        let fine = level(0).around(b0, level(0).around(a0, written, true), true); // [M0, C0]
        let middle = level(1).around(a1, level(1).down(down1, fine.clone()), true); // [M1, C1]
        let coarse = level(2).around(a2, level(2).down(down2, middle.clone()), true); // [M2, C2]
        let coarse = level(2).around(b2, coarse, true);
        let middle = level(1).around(b1, level(1).up(up1, coarse, middle), true);
        let fine = level(0).around(c0, level(0).up(up0, middle, fine), false);
        read(ground, fine, position.clone())
    }
}

/// A level of the grid, to pass on what is at its nodes.
struct Level<'a> {
    ground: &'a Ground,
    level: usize,
}

impl Level<'_> {
    /// From the 3 x 3 nodes around each node, `[M, C]`, to the node.
    fn around(&self, linear: &Linear, rows: Tensor<2>, rectified: bool) -> Tensor<2> {
        self.gather(linear, rows, sparse::Table::Neighbours(self.level), rectified)
    }

    /// From each node's children, `[M', C']`, to the node, with a ReLU.
    fn down(&self, linear: &Linear, rows: Tensor<2>) -> Tensor<2> {
        self.gather(linear, rows, sparse::Table::Children(self.level), true)
    }

    fn gather(
        &self,
        linear: &Linear,
        rows: Tensor<2>,
        table: sparse::Table,
        rectified: bool,
    ) -> Tensor<2> {
        let Linear { weight, bias } = linear.clone();
        if fused::runs_on(&weight.device()) {
            return training::gathered(&self.ground.nodes, table, rectified, rows, weight, bias);
        }
        let output = sparse::gathered(&self.ground.nodes, table, rows, weight, bias);
        if rectified { relu(output) } else { output }
    }

    /// From each node's parent, `[M', C']`, to the node, added to what it held, `[M, C]`, with a ReLU.
    fn up(&self, linear: &Linear, parents: Tensor<2>, held: Tensor<2>) -> Tensor<2> {
        let Linear { weight, bias } = linear.clone();
        let nodes = &self.ground.nodes;
        let spread = if fused::runs_on(&weight.device()) {
            training::spread(nodes, self.level, parents, weight, bias)
        } else {
            sparse::spread(nodes, self.level, parents, weight, bias)
        };
        relu(held + spread)
    }
}

/// Averages of what particles write to a node, how full it is, and how near the walls are:
/// `[R, C]` to `[M0, C + 5]`.
fn write(ground: &Ground, encoded: Tensor<2>, position: Tensor<2>) -> Tensor<2> {
    if fused::runs_on(&encoded.device()) {
        return training::write(ground, encoded, position);
    }
    sparse::write(ground, encoded, position)
}

/// What the nodes hold, `[M0, C]`, at the particles, `[R, C]`.
fn read(ground: &Ground, rows: Tensor<2>, position: Tensor<2>) -> Tensor<2> {
    if fused::runs_on(&rows.device()) {
        return training::read(ground, rows, position);
    }
    sparse::read(ground, rows, position)
}
