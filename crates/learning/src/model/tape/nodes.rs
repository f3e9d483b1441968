//! Operations on nodes.

use super::{Backward, Kept, Operate, exactly};
use crate::model::grid_context::GridContext;
use eddy_inference::{
    checkpoint::{
        Activation,
        grid::{GridLayer, Stencil},
    },
    kernels::{
        activation::{activate, gradient_before},
        gathered::{Convolution, Table, TransposedConvolution},
        nodes::Nodes,
        transfer::{by_position, to_nodes, to_particles},
    },
    ops::node_inputs::NodeInputs,
};

/// The inputs of the nodes; keeps their mass.
pub(super) struct ToNodes<'a>(pub(super) &'a GridContext);

impl Operate for ToNodes<'_> {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let [encoded, _] = exactly(read);
        let NodeInputs { inputs, mass } = NodeInputs::new(&self.0.nodes, &self.0.walls, encoded);
        (inputs, Kept::Numbers(mass))
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, written: inputs, kept, gradient, wanted } = of;
        let [encoded, _] = exactly(read);
        let inputs = [inputs, kept.numbers()];
        let by = NodeInputs::backward(&self.0.nodes, encoded, inputs, gradient, exactly(wanted));
        vec![by.encoded, by.position]
    }
}

/// The numbers of the nodes around the particles.
pub(super) struct ToParticles<'a>(pub(super) &'a Nodes);

impl Operate for ToParticles<'_> {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let [field, _] = exactly(read);
        (to_particles(self.0, field, self.width(field)), Kept::NOTHING)
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, gradient, wanted, .. } = of;
        let [field, _] = exactly(read);
        let ([by_field, by_place], width) = (exactly(wanted), self.width(field));
        vec![
            if by_field { to_nodes(self.0, gradient, width) } else { Vec::new() },
            if by_place { by_position(self.0, field, gradient, width) } else { Vec::new() },
        ]
    }
}

impl ToParticles<'_> {
    fn width(&self, field: &[f32]) -> usize {
        field.len() / self.0.level(0).len()
    }
}

/// A convolution on nodes; reads a second list where another one is added.
pub(super) struct Convolve<'a> {
    pub(super) nodes: &'a Nodes,
    pub(super) layer: &'a GridLayer,
}

/// A layer on nodes with its tables.
enum Tables<'a> {
    Gathered(Convolution<'a>),
    FromParents(TransposedConvolution<'a>),
}

impl Convolve<'_> {
    fn activation(&self) -> Option<Activation> {
        self.layer.rectified.then_some(Activation::Relu)
    }

    fn tables<'t>(&'t self, weight: &'t [f32], bias: &'t [f32]) -> Tables<'t> {
        let GridLayer { level, rectified: rectify, .. } = *self.layer;
        let own = self.nodes.level(level);
        let table = match self.layer.stencil {
            Stencil::Neighbours => Table::Neighbours(&own.neighbours),
            Stencil::Children => Table::Children {
                children: &own.children,
                parent: &self.nodes.level(level - 1).parent,
            },
            Stencil::Parent => {
                let (children, parent) = (&self.nodes.level(level + 1).children, &own.parent);
                let layer = TransposedConvolution { children, parent, weight, bias };
                return Tables::FromParents(layer);
            }
        };
        Tables::Gathered(Convolution { table, weight, bias, rectify })
    }
}

impl Operate for Convolve<'_> {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let [rows, skip @ .., weight, bias] = read else { unreachable!("layers read rows") };
        let output = match self.tables(weight, bias) {
            Tables::Gathered(layer) => {
                assert!(skip.is_empty(), "only layers that read parents have a skip connection");
                layer.forward(rows)
            }
            Tables::FromParents(layer) => {
                let mut output = layer.forward(rows);
                for skip in skip {
                    output.iter_mut().zip(*skip).for_each(|(sum, skip)| *sum += skip);
                }
                if let Some(activation) = self.activation() {
                    activate(activation, &mut output);
                }
                output
            }
        };
        (output, Kept::NOTHING)
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, written: output, gradient, .. } = of;
        let [rows, skip @ .., weight, bias] = read else { unreachable!("layers read rows") };
        match self.tables(weight, bias) {
            Tables::Gathered(layer) => {
                let by = layer.backward(rows, output, gradient, true, true);
                vec![by.input, by.weight, by.bias]
            }
            Tables::FromParents(layer) => {
                let gradient = gradient_before(self.activation(), output, gradient);
                let by = layer.backward(rows, &gradient, true, true);
                let by_skip = skip.iter().map(|_| gradient.to_vec());
                [by.input].into_iter().chain(by_skip).chain([by.weight, by.bias]).collect()
            }
        }
    }
}
