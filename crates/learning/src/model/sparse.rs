//! The operations on the sparse grid over tensors.

use burn::tensor::{Device, IndexingUpdateOp, Int, Tensor, TensorData};

use super::{grid_context::GridContext, linear::Linear};
use eddy_inference::{
    checkpoint::grid::{GridLayer, Stencil},
    engine::scales::{FULL_MASS, MIN_MASS},
    kernels::nodes::{MISSING, Nodes},
};

/// The sums of a layer on nodes, `[M', C']` to `[M, C]`: from the gathered rows of a node with the matrix `[k C', C]`; from its parent
/// with that of the child out of `[C', 4 C]`.
pub(crate) fn convolution(
    context: &GridContext,
    layer: &GridLayer,
    rows: Tensor<2>,
    Linear { weight, bias }: &Linear,
) -> Tensor<2> {
    let nodes = context.nodes.level(layer.level);
    let ([count, width], [inputs, outputs]) = (rows.dims(), weight.dims());
    let device = rows.device();
    let table = match layer.stencil {
        Stencil::Neighbours => nodes.neighbours.as_flattened(),
        Stencil::Children => nodes.children.as_flattened(),
        Stencil::Parent => {
            let children = rows.matmul(weight.clone()).reshape([count * 4, outputs / 4]); // [M' 4, C]
            let places = indices(nodes.parent.iter().copied(), &device);
            return children.select(0, places) + bias.clone().unsqueeze();
        }
    };
    let rows = Tensor::cat(vec![rows, Tensor::zeros([1, width], &device)], 0);
    let place = |&node: &u32| if node == MISSING { count as u32 } else { node };
    let rows = rows.select(0, indices(table.iter().map(place), &device)); // [M k, C']
    let rows = rows.reshape([table.len() * width / inputs, inputs]);
    rows.matmul(weight.clone()) + bias.clone().unsqueeze()
}

/// `[R, C]` to `[M0, C + 5]`: averages, mass, proximity to walls.
pub(crate) fn write(context: &GridContext, [encoded, position]: [Tensor<2>; 2]) -> Tensor<2> {
    let nodes = &context.nodes;
    let device = encoded.device();
    let ([rows, width], count) = (encoded.dims(), nodes.level(0).len());
    let weights = weights(context, position); // [R 9, 1]
    let stencils = indices(stencils(nodes, rows).into_iter().flatten(), &device);
    let add = |values: Tensor<2>| {
        let [_, width] = values.dims();
        let zeros = Tensor::zeros([count, width], &device);
        zeros.select_assign(0, stencils.clone(), values, IndexingUpdateOp::Add)
    };
    let nine = encoded.unsqueeze_dim::<3>(1).repeat(&[1, 9, 1]).reshape([rows * 9, width]);
    let (sum, mass) = (add(nine * weights.clone()), add(weights)); // [M0, C], [M0, 1]
    let walls = context.walls.as_flattened().to_vec();
    let walls = Tensor::from_data(TensorData::new(walls, [count, 4]), &device);
    Tensor::cat(vec![sum / mass.clone().add_scalar(MIN_MASS), mass.div_scalar(FULL_MASS), walls], 1)
}

/// Interpolation at the particles, `[M0, C]` to `[R, C]`.
pub(crate) fn read(context: &GridContext, [rows, position]: [Tensor<2>; 2]) -> Tensor<2> {
    let device = rows.device();
    let ([_, width], [particles, _]) = (rows.dims(), position.dims());
    let stencils = indices(stencils(&context.nodes, particles).into_iter().flatten(), &device);
    let nine = rows.select(0, stencils) * weights(context, position); // [R 9, C]
    nine.reshape([particles, 9, width]).sum_dim(1).reshape([particles, width])
}

/// Each particle's nine nodes, row by row from the lower left.
fn stencils(nodes: &Nodes, particles: usize) -> Vec<[u32; 9]> {
    let mut stencils = vec![[0; 9]; particles];
    for cell in nodes.cells() {
        for slot in cell.slots() {
            let particle = nodes.order()[slot] as usize;
            stencils[particle] = std::array::from_fn(|k| cell.nodes[k / 3] + (k % 3) as u32);
        }
    }
    stencils
}

/// Each particle's weights of its nine nodes, `[R 9, 1]`, differentiable by the position.
fn weights(context: &GridContext, position: Tensor<2>) -> Tensor<2> {
    let device = position.device();
    let [rows, _] = position.dims();
    let origin = Tensor::<1>::from_floats(context.origin, &device).unsqueeze::<2>();
    let place = (position - origin).div_scalar(context.nodes.width()); // in cells
    let base = place.clone().detach().sub_scalar(0.5).floor();
    let offset = place - base; // [R, 2], 0.5..1.5
    let three = [
        (offset.clone() - 1.5).square().mul_scalar(0.5),
        (offset.clone() - 1.0).square().neg().add_scalar(0.75),
        (offset - 0.5).square().mul_scalar(0.5),
    ];
    let axis = |axis: usize| {
        Tensor::cat(three.iter().map(|w| w.clone().slice([0..rows, axis..axis + 1])).collect(), 1)
    }; // [R, 3]
    let columns = axis(0).unsqueeze_dim::<3>(1).repeat(&[1, 3, 1]); // [R, row, column]
    let rows_of = axis(1).unsqueeze_dim::<3>(2).repeat(&[1, 1, 3]);
    (columns * rows_of).reshape([rows * 9, 1])
}

/// Row indices as a tensor.
pub(crate) fn indices(values: impl Iterator<Item = u32>, device: &Device) -> Tensor<1, Int> {
    let values: Vec<i32> = values.map(|value| value as i32).collect();
    let count = values.len();
    Tensor::from_data(TensorData::new(values, [count]), device)
}
