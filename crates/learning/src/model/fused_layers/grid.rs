//! The layers on the sparse grid, as in [`sparse`](crate::model::sparse).

use std::sync::Arc;

use burn::tensor::Tensor;

use crate::model::{
    fused::{Operation, apply, input},
    grid_context::{GridContext, Table},
};
use eddy_inference::{
    checkpoint::layout::NODE_FEATURES,
    engine::scales::{FULL_MASS, MIN_MASS},
    kernels::{
        gathered::{self, Convolution, TransposedConvolution},
        nodes::Nodes,
        transfer::{by_position, mass, to_nodes, to_particles},
    },
};

/// [`sparse::gathered`](crate::model::sparse::gathered), optionally with ReLU.
pub(crate) fn gathered(
    nodes: &Arc<Nodes>,
    table: Table,
    rectify: bool,
    rows: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<1>,
) -> Tensor<2> {
    let (Table::Neighbours(level) | Table::Children(level)) = table;
    let shape = [nodes.level(level).len(), bias.dims()[0]];
    let inputs = [input(rows), input(weight), input(bias)];
    apply(Gathered { nodes: nodes.clone(), table, rectify }, inputs, shape)
}

#[derive(Clone, Debug)]
struct Gathered {
    nodes: Arc<Nodes>,
    table: Table,
    rectify: bool,
}

impl Gathered {
    fn layer<'a>(&'a self, weight: &'a [f32], bias: &'a [f32]) -> Convolution<'a> {
        let table = match self.table {
            Table::Neighbours(level) => {
                gathered::Table::Neighbours(&self.nodes.level(level).neighbours)
            }
            Table::Children(level) => gathered::Table::Children {
                children: &self.nodes.level(level).children,
                parent: &self.nodes.level(level - 1).parent,
            },
        };
        Convolution { table, weight, bias, rectify: self.rectify }
    }
}

impl Operation<3> for Gathered {
    type Kept = ();

    fn forward(&self, [rows, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        (self.layer(weight, bias).forward(rows), ())
    }

    fn backward(
        &self,
        [rows, weight, bias]: [&[f32]; 3],
        output: &[f32],
        (): (),
        gradient: &[f32],
        [by_rows, by_weight, _]: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let layer = self.layer(weight, bias);
        let by = layer.backward(rows, output, gradient, by_rows, by_weight);
        [by.input, by.weight, by.bias]
    }
}

/// [`sparse::spread`](crate::model::sparse::spread).
pub(crate) fn spread(
    nodes: &Arc<Nodes>,
    level: usize,
    parents: Tensor<2>,
    weight: Tensor<2>,
    bias: Tensor<1>,
) -> Tensor<2> {
    let shape = [nodes.level(level).len(), bias.dims()[0]];
    let nodes = nodes.clone();
    apply(FromParent { nodes, level }, [input(parents), input(weight), input(bias)], shape)
}

#[derive(Clone, Debug)]
struct FromParent {
    nodes: Arc<Nodes>,
    level: usize,
}

impl FromParent {
    fn layer<'a>(&'a self, weight: &'a [f32], bias: &'a [f32]) -> TransposedConvolution<'a> {
        let children = &self.nodes.level(self.level + 1).children;
        let parent = &self.nodes.level(self.level).parent;
        TransposedConvolution { children, parent, weight, bias }
    }
}

impl Operation<3> for FromParent {
    type Kept = ();

    fn forward(&self, [parents, weight, bias]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        (self.layer(weight, bias).forward(parents), ())
    }

    fn backward(
        &self,
        [parents, weight, bias]: [&[f32]; 3],
        _output: &[f32],
        (): (),
        gradient: &[f32],
        [by_parents, by_weight, _]: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let by = self.layer(weight, bias).backward(parents, gradient, by_parents, by_weight);
        [by.input, by.weight, by.bias]
    }
}

/// [`sparse::write`](crate::model::sparse::write): `[R, C]` and positions `[R, 2]` to `[M0, C + 5]`.
pub(crate) fn write(context: &GridContext, encoded: Tensor<2>, position: Tensor<2>) -> Tensor<2> {
    let width = encoded.dims()[1] + NODE_FEATURES;
    let shape = [context.nodes.level(0).len(), width];
    apply(Write(context.clone()), [input(encoded), input(position)], shape)
}

#[derive(Clone, Debug)]
struct Write(GridContext);

impl Operation<2> for Write {
    /// The mass of each node.
    type Kept = Vec<f32>;

    fn forward(&self, [encoded, _]: [&[f32]; 2]) -> (Vec<f32>, Vec<f32>) {
        let GridContext { nodes, walls, .. } = &self.0;
        let width = encoded.len() / nodes.order().len();
        let (sums, mass) = (to_nodes(nodes, encoded, width), mass(nodes));
        let mut written = Vec::with_capacity(mass.len() * (width + NODE_FEATURES));
        for ((sum, &mass), walls) in sums.chunks_exact(width).zip(&mass).zip(walls.iter()) {
            let scale = 1.0 / (mass + MIN_MASS);
            written.extend(sum.iter().map(|sum| sum * scale));
            written.push(mass / FULL_MASS);
            written.extend(walls);
        }
        (written, mass)
    }

    fn backward(
        &self,
        [encoded, _]: [&[f32]; 2],
        written: &[f32],
        mass: Vec<f32>,
        gradient: &[f32],
        [by_encoded, by_place]: [bool; 2],
    ) -> [Vec<f32>; 2] {
        let nodes = &self.0.nodes;
        let width = encoded.len() / nodes.order().len();
        let mut by_sum = Vec::with_capacity(mass.len() * width);
        let mut by_mass = Vec::with_capacity(mass.len());
        let whole = width + NODE_FEATURES;
        let rows = gradient.chunks_exact(whole).zip(written.chunks_exact(whole));
        for ((gradient, written), mass) in rows.zip(&mass) {
            let scale = 1.0 / (mass + MIN_MASS);
            by_sum.extend(gradient[..width].iter().map(|g| g * scale));
            let averages = gradient[..width].iter().zip(written).map(|(g, x)| g * x);
            by_mass.push(gradient[width] / FULL_MASS - scale * averages.sum::<f32>());
        }
        let mut place = Vec::new();
        if by_place {
            place = by_position(nodes, &by_sum, encoded, width);
            let ones = vec![1.0; nodes.order().len()];
            let more = by_position(nodes, &by_mass, &ones, 1);
            place.iter_mut().zip(more).for_each(|(place, more)| *place += more);
        }
        [if by_encoded { to_particles(nodes, &by_sum, width) } else { Vec::new() }, place]
    }
}

/// [`sparse::read`](crate::model::sparse::read): `[M0, C]` and positions `[R, 2]` to `[R, C]`.
pub(crate) fn read(context: &GridContext, rows: Tensor<2>, position: Tensor<2>) -> Tensor<2> {
    let shape = [position.dims()[0], rows.dims()[1]];
    apply(Read(context.nodes.clone()), [input(rows), input(position)], shape)
}

#[derive(Clone, Debug)]
struct Read(Arc<Nodes>);

impl Operation<2> for Read {
    type Kept = ();

    fn forward(&self, [rows, _]: [&[f32]; 2]) -> (Vec<f32>, ()) {
        (to_particles(&self.0, rows, rows.len() / self.0.level(0).len()), ())
    }

    fn backward(
        &self,
        [rows, _]: [&[f32]; 2],
        _output: &[f32],
        (): (),
        gradient: &[f32],
        [by_rows, by_place]: [bool; 2],
    ) -> [Vec<f32>; 2] {
        let width = rows.len() / self.0.level(0).len();
        [
            if by_rows { to_nodes(&self.0, gradient, width) } else { Vec::new() },
            if by_place { by_position(&self.0, rows, gradient, width) } else { Vec::new() },
        ]
    }
}
