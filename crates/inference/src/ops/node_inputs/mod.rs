//! The inputs of the nodes of the finest level: the mean of what the particles around a node have, its mass, and its proximity to the
//! walls.
//!
//! | numbers | input |
//! |---|---|
//! | C | sum over particles of w_p x_p, divided by m + [`MIN_MASS`], where w_p is the weight of the quadratic spline |
//! | 1 | m / [`FULL_MASS`], where m is the sum of w_p |
//! | 4 | exp(-d / w) of the distance d from the left, lower, right and upper effective wall; 1 beyond. w is the width of a cell |
//!
//! This file is for training, with the gradient; `rows` for predictions; `device.cu` for both on GPUs, from the sums of
//! [`transfer`](super::transfer). The definition in burn
//! is `model/sparse.rs` of `eddy-learning`.

pub(crate) mod rows;

use super::{
    ballistic::Ballistic,
    transfer::{by_position, mass, to_nodes, to_particles},
};
use crate::{
    checkpoint::layout::NODE_FEATURES,
    engine::scales::{FULL_MASS, MIN_MASS},
    kernels::nodes::Nodes,
};

/// What the kernels on GPUs share.
pub const DEVICE: &str = include_str!("device.cu");

/// The inputs of all nodes, and what their gradient needs.
#[derive(Clone, Debug)]
pub struct NodeInputs {
    /// `[M0, C + 5]`.
    pub inputs: Vec<f32>,
    /// m of each node, `[M0]`.
    pub mass: Vec<f32>,
}

/// Gradients by what the particles have and by their positions, `[R, C]` and `[R, 2]`; empty if not requested.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// By what they have.
    pub encoded: Vec<f32>,
    /// By their positions.
    pub position: Vec<f32>,
}

/// Proximity of a node at `at` to the four walls.
pub fn wall_proximity(
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

impl NodeInputs {
    /// From what the particles have, `[R, C]`, and the nodes' proximity to walls, `[M0]`.
    pub fn new(nodes: &Nodes, walls: &[[f32; 4]], encoded: &[f32]) -> Self {
        let width = encoded.len() / nodes.order().len();
        let (sums, mass) = (to_nodes(nodes, encoded, width), mass(nodes));
        let mut inputs = Vec::with_capacity(mass.len() * (width + NODE_FEATURES));
        for ((sum, &mass), walls) in sums.chunks_exact(width).zip(&mass).zip(walls) {
            let scale = 1.0 / (mass + MIN_MASS);
            inputs.extend(sum.iter().map(|sum| sum * scale));
            inputs.push(mass / FULL_MASS);
            inputs.extend(walls);
        }
        Self { inputs, mass }
    }

    /// The gradients from `gradient`, that by the `inputs`, `[M0, C + 5]`, which come from `encoded` and have this `mass`.
    pub fn backward(
        nodes: &Nodes,
        encoded: &[f32],
        [inputs, mass]: [&[f32]; 2],
        gradient: &[f32],
        [by_encoded, by_place]: [bool; 2],
    ) -> Gradients {
        let width = encoded.len() / nodes.order().len();
        let mut by_sum = Vec::with_capacity(mass.len() * width);
        let mut by_mass = Vec::with_capacity(mass.len());
        let whole = width + NODE_FEATURES;
        let rows = gradient.chunks_exact(whole).zip(inputs.chunks_exact(whole));
        for ((gradient, inputs), mass) in rows.zip(mass) {
            let scale = 1.0 / (mass + MIN_MASS);
            by_sum.extend(gradient[..width].iter().map(|g| g * scale));
            let averages = gradient[..width].iter().zip(inputs).map(|(g, x)| g * x);
            by_mass.push(gradient[width] / FULL_MASS - scale * averages.sum::<f32>());
        }
        let mut position = Vec::new();
        if by_place {
            position = by_position(nodes, &by_sum, encoded, width);
            let ones = vec![1.0; nodes.order().len()];
            let more = by_position(nodes, &by_mass, &ones, 1);
            position.iter_mut().zip(more).for_each(|(sum, more)| *sum += more);
        }
        let encoded = if by_encoded { to_particles(nodes, &by_sum, width) } else { Vec::new() };
        Gradients { encoded, position }
    }
}
