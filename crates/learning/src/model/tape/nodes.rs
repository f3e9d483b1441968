//! Operations on nodes.

use super::{Backward, Kept, Operate, exactly};
use crate::model::grid_context::GridContext;
use eddy_inference::{
    checkpoint::grid::GridLayer,
    kernels::nodes::Nodes,
    ops::{
        convolution::Convolution,
        node_inputs::NodeInputs,
        transfer::{by_position, to_nodes, to_particles},
    },
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

impl Convolve<'_> {
    /// The rows, what is added, and the layer.
    fn parts<'a>(&'a self, read: &[&'a [f32]]) -> (&'a [f32], Option<&'a [f32]>, Convolution<'a>) {
        let [rows, added @ .., weight, bias] = read else { unreachable!("layers read rows") };
        let Self { nodes, layer } = *self;
        (rows, added.first().copied(), Convolution { nodes, layer, weight, bias })
    }
}

impl Operate for Convolve<'_> {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let (rows, added, layer) = self.parts(read);
        (layer.forward(rows, added), Kept::NOTHING)
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, written: output, gradient, .. } = of;
        let (rows, added, layer) = self.parts(read);
        let (by, by_added) = layer.backward(rows, output, gradient);
        let by_added = added.map(|_| by_added);
        [by.input].into_iter().chain(by_added).chain([by.weight, by.bias]).collect()
    }
}
