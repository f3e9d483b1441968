//! A described network as a list of operations, in the order in which they are computed.
//!
//! The definition in burn and the passes of training on processors (`eddy-learning`) compute it one operation after the other. The
//! streaming [`engine`](crate::engine) and the kernels for GPUs (`eddy-cuda`) run it in stages of several operations.
//!
//! An operation reads and writes lists of rows. Each list is written once; whether two of them share memory is up to who runs them.

use std::{collections::BTreeMap, ops::Range};

use super::{
    Activation, Architecture, Description, Pooling, Weights,
    grid::{GridLayer, grid_layers},
    layout::{NODE_FEATURES, frame_features, names, particle_features},
};
use crate::kernels::matrix::transposed;

/// A network: what it computes in a frame, in order.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// What operations read and write. The first ones are given: [`POSITION`], [`VELOCITY`] and [`EXPECTED`].
    pub lists: Vec<List>,
    /// What is computed.
    pub operations: Vec<Operation>,
    /// The linear layers that operations have, from input to output.
    pub layers: Vec<LinearLayer>,
    /// The operations of the recurrent core.
    pub core: Range<usize>,
}

/// The list of positions (domain lengths).
pub const POSITION: usize = 0;
/// The list of velocities (domain lengths per second).
pub const VELOCITY: usize = 1;
/// The list of velocities that were expected of this frame one frame ago (domain lengths per second); of particle models.
pub const EXPECTED: usize = 2;

/// Rows of numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct List {
    /// What they belong to.
    pub rows: Rows,
    /// Numbers in a row.
    pub width: usize,
}

/// A linear layer; [`layout`](super::layout) lists those of all networks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LinearLayer {
    /// Name of the matrix, `[output, input]`.
    pub weight: String,
    /// Name of the bias, `[output]`.
    pub bias: String,
    /// Columns of the matrix.
    pub input: usize,
    /// Rows of the matrix.
    pub output: usize,
    /// Number of outputs that share an element of the bias.
    pub sharing: usize,
}

/// What the rows of a list belong to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rows {
    /// A frame each.
    Frames,
    /// A particle each.
    Particles,
    /// A node of this level of the grid each.
    Nodes(usize),
}

/// A step of the computation.
#[derive(Clone, Debug, PartialEq)]
pub struct Operation {
    /// What it computes.
    pub kind: Kind,
    /// Indices of the lists that it reads.
    pub reads: Vec<usize>,
    /// Index of the list that it writes.
    pub writes: usize,
}

/// What an operation computes. Layers are indices in [`Plan::layers`].
#[derive(Clone, Debug, PartialEq)]
pub enum Kind {
    /// The velocities that the ballistic step expects of the coming frame, from positions and velocities.
    Expect,
    /// The particle model's features, from positions, velocities, and the velocities expected of this frame.
    ParticleFeatures,
    /// The frame model's features, from positions and velocities.
    FrameFeatures,
    /// A linear layer, perhaps with an activation function, on the rows of one list or of two side by side.
    Linear {
        /// Index of its layer.
        layer: usize,
        /// The function of the sums, if there is one.
        activation: Option<Activation>,
    },
    /// A linear layer with an activation function on the particles, and the mean over those of a frame.
    MeanOfLinear {
        /// Index of its layer.
        layer: usize,
        /// The function of the sums.
        activation: Activation,
    },
    /// The largest numbers over the particles of a frame.
    Max,
    /// Means over the particles around each node, the node's mass and its proximity to walls, from the particles' numbers and
    /// positions (P2G).
    ToNodes,
    /// A convolution on nodes, and where it reads two lists, the second one added before its activation.
    Convolution {
        /// Index of its layer.
        layer: usize,
        /// What it gathers.
        grid: GridLayer,
    },
    /// The numbers of the nodes around each particle, weighted, from those and the positions (G2P).
    ToParticles,
    /// The cell of a layer of the core, from the sums of its gates.
    Cell {
        /// The layer of the core, from 0.
        number: usize,
        /// Index of the layer that reads the last output, if the core has one.
        recurrent: Option<usize>,
    },
    /// Positions and velocities of the next frame side by side, from those of this one and the decoder's output.
    Advance,
}

/// Operations of the particle model that stay within a block of particles or nodes: what runs on a block from a wait for all others to
/// the next one.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Stage {
    /// Particles: features and encoder.
    Encode,
    /// Nodes: [`Kind::ToNodes`].
    ToNodes,
    /// Nodes: a [`Kind::Convolution`], in their order.
    Convolution(usize),
    /// Particles: from [`Kind::ToParticles`] through the core to the next frame.
    Decode,
}

/// Parts of the frame model, in the order in which they are computed; gradients go back in the reverse order.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FrameStage {
    /// Features, first layer of the encoder, mean over the particles, second layer.
    Means,
    /// Features, both layers of the encoder, largest numbers over the particles.
    Maxima,
    /// A layer of the core, from 0.
    Core(usize),
    /// The layer between core and decoder.
    Mix,
    /// The decoder and the step to the next frame.
    Decode,
}

impl Kind {
    /// The linear layer that it has.
    pub fn layer(&self) -> Option<usize> {
        match *self {
            Self::Linear { layer, .. } | Self::MeanOfLinear { layer, .. } => Some(layer),
            Self::Convolution { layer, .. } => Some(layer),
            Self::Cell { recurrent, .. } => recurrent,
            _ => None,
        }
    }
}

impl Plan {
    /// The described network.
    pub fn new(description: &Description) -> Self {
        let inputs = [List { rows: Rows::Particles, width: 2 }; 3];
        let mut plan =
            Self { lists: inputs.into(), operations: Vec::new(), layers: Vec::new(), core: 0..0 };
        let hidden = description.sizes.hidden;
        let (signal, rows, activation, outputs) = match description.architecture {
            Architecture::Frame => {
                let outputs = 2 * description.sizes.particles.unwrap_or(0);
                let signal = plan.encode_frame(description);
                (signal, Rows::Frames, description.frame.activation, outputs)
            }
            Architecture::Particle => {
                let signal = plan.encode_particles(description);
                (signal, Rows::Particles, Activation::Relu, 4)
            }
        };
        let core = plan.operations.len();
        let signal = plan.add_core(description, signal, rows);
        plan.core = core..plan.operations.len();
        // Table 1 does not say whether its "MLP(1250 -> 1250)" has an activation; without one it would be redundant.
        let mixed =
            plan.linear(names("mixer"), &[signal], List { rows, width: hidden }, Some(activation));
        let output = plan.linear(names("decoder"), &[mixed], List { rows, width: outputs }, None);
        let next = List { rows: Rows::Particles, width: 4 };
        plan.add(Kind::Advance, &[POSITION, VELOCITY, output], next);
        plan
    }

    /// The list of the positions and velocities of the next frame.
    pub fn next(&self) -> usize {
        self.lists.len() - 1
    }

    /// The list of the velocities that are expected of the next frame, in a particle model.
    pub fn expected_next(&self) -> Option<usize> {
        self.operations.iter().find(|one| one.kind == Kind::Expect).map(|one| one.writes)
    }

    /// The stages of a particle model.
    pub fn stages(&self) -> Vec<Stage> {
        let mut convolutions = 0..;
        let begins = |operation: &Operation| match operation.kind {
            Kind::Expect => Some(Stage::Encode),
            Kind::ToNodes => Some(Stage::ToNodes),
            Kind::Convolution { .. } => convolutions.next().map(Stage::Convolution),
            Kind::ToParticles => Some(Stage::Decode),
            // They go on with the rows of the stage.
            Kind::ParticleFeatures | Kind::Linear { .. } | Kind::Cell { .. } | Kind::Advance => {
                None
            }
            Kind::FrameFeatures | Kind::MeanOfLinear { .. } | Kind::Max => {
                unreachable!("an operation of the frame model")
            }
        };
        self.operations.iter().filter_map(begins).collect()
    }

    /// The stages of a frame model.
    pub fn frame_stages(&self) -> Vec<FrameStage> {
        let begins = |(index, operation): (usize, &Operation)| match operation.kind {
            // With the features before it and the layer behind it.
            Kind::MeanOfLinear { .. } => Some(FrameStage::Means),
            // With the linear layers before them.
            Kind::Max => Some(FrameStage::Maxima),
            Kind::Cell { number, .. } => Some(FrameStage::Core(number)),
            Kind::Linear { .. } if index == self.core.end => Some(FrameStage::Mix),
            Kind::Advance => Some(FrameStage::Decode),
            Kind::Linear { .. } | Kind::FrameFeatures => None,
            Kind::Expect
            | Kind::ParticleFeatures
            | Kind::ToNodes
            | Kind::Convolution { .. }
            | Kind::ToParticles => unreachable!("an operation of the particle model"),
        };
        self.operations.iter().enumerate().filter_map(begins).collect()
    }

    /// The lists that the core reads: two with both poolings.
    pub fn core_inputs(&self) -> &[usize] {
        &self.operations[self.core.start].reads
    }

    /// The list that the core writes last.
    pub fn core_output(&self) -> usize {
        self.operations[self.core.end - 1].writes
    }

    /// The frame model (the paper's Table 1) up to its core, which reads these lists.
    ///
    /// The table pools after the encoder's second layer. A mean commutes with a linear map, so that pooling first gives the same
    /// numbers for a fortieth of the work (a test compares the two orders). A maximum does not commute and keeps the table's order.
    fn encode_frame(&mut self, description: &Description) -> Vec<usize> {
        let Description { frame, sizes, .. } = description;
        let (activation, pooling) = (frame.activation, frame.pooling);
        let width = frame_features(description);
        let read = &[POSITION, VELOCITY];
        let features = self.add(Kind::FrameFeatures, read, List { rows: Rows::Particles, width });
        let first = self.layer(names("encoder.0"), width, sizes.encoder, 1);
        let second = self.layer(names("encoder.1"), sizes.encoder, sizes.hidden, 1);
        let [encoder, hidden] = [sizes.encoder, sizes.hidden];
        let after = Kind::Linear { layer: second, activation: None };
        let mut pooled = Vec::new();
        if pooling != Pooling::Max {
            let kind = Kind::MeanOfLinear { layer: first, activation };
            let mean = self.add(kind, &[features], List { rows: Rows::Frames, width: encoder });
            pooled.push(self.add(
                after.clone(),
                &[mean],
                List { rows: Rows::Frames, width: hidden },
            ));
        }
        if pooling != Pooling::Mean {
            let kind = Kind::Linear { layer: first, activation: Some(activation) };
            let points =
                self.add(kind, &[features], List { rows: Rows::Particles, width: encoder });
            let points = self.add(after, &[points], List { rows: Rows::Particles, width: hidden });
            pooled.push(self.add(Kind::Max, &[points], List { rows: Rows::Frames, width: hidden }));
        }
        pooled
    }

    /// The particle model up to its core, which reads this list.
    fn encode_particles(&mut self, description: &Description) -> Vec<usize> {
        let Description { sizes, grid, .. } = description;
        let grid = grid.as_ref().expect("checked descriptions of particle models have one");
        let rows = Rows::Particles;
        let width = particle_features(description);
        let expected = self.add(Kind::Expect, &[POSITION, VELOCITY], List { rows, width: 2 });
        let read = &[POSITION, VELOCITY, EXPECTED, expected];
        let features = self.add(Kind::ParticleFeatures, read, List { rows, width });
        let relu = Some(Activation::Relu);
        let list = |width| List { rows, width };
        let encoded = self.linear(names("encoder.0"), &[features], list(sizes.encoder), relu);
        let encoded = self.linear(names("encoder.1"), &[encoded], list(grid.channels[0]), None);
        let width = grid.channels[0] + NODE_FEATURES;
        let mut field =
            self.add(Kind::ToNodes, &[encoded, POSITION], List { rows: Rows::Nodes(0), width });
        let mut fields = Vec::new();
        for grid in grid_layers(grid) {
            let GridLayer { stencil, level, channels: [input, output], skip, .. } = grid;
            let sharing = stencil.children();
            let inputs = stencil.places() * input;
            let layer = self.layer(names(&grid.name), inputs, sharing * output, sharing);
            let read: Vec<usize> =
                [field].into_iter().chain(skip.map(|skip| fields[skip])).collect();
            let list = List { rows: Rows::Nodes(level), width: output };
            field = self.add(Kind::Convolution { layer, grid }, &read, list);
            fields.push(field);
        }
        let gathered = self.add(Kind::ToParticles, &[field, POSITION], list(grid.channels[0]));
        vec![self.linear(names("context"), &[features, gathered], list(sizes.hidden), relu)]
    }

    /// The layers of the core, which read these lists and write this one.
    fn add_core(&mut self, description: &Description, mut read: Vec<usize>, rows: Rows) -> usize {
        let Description { core, sizes, .. } = description;
        let hidden = sizes.hidden;
        for number in 0..sizes.layers {
            let parts = core.input_parts().iter();
            let sums: Vec<usize> = parts
                .map(|&(part, gates)| {
                    let list = List { rows, width: gates * hidden };
                    self.linear(core.tensors(number, part), &read, list, None)
                })
                .collect();
            let recurrent = core.recurrent_part().map(|part| {
                self.layer(core.tensors(number, part), hidden, core.gates() * hidden, 1)
            });
            let list = List { rows, width: hidden };
            read = vec![self.add(Kind::Cell { number, recurrent }, &sums, list)];
        }
        read[0]
    }

    /// Adds a linear layer with weights of its own, and returns the index of the list that it writes.
    fn linear(
        &mut self,
        names: [String; 2],
        reads: &[usize],
        writes: List,
        activation: Option<Activation>,
    ) -> usize {
        let input = reads.iter().map(|&list| self.lists[list].width).sum();
        let layer = self.layer(names, input, writes.width, 1);
        self.add(Kind::Linear { layer, activation }, reads, writes)
    }

    /// Adds weights, and returns their index.
    fn layer(
        &mut self,
        [weight, bias]: [String; 2],
        input: usize,
        output: usize,
        sharing: usize,
    ) -> usize {
        self.layers.push(LinearLayer { weight, bias, input, output, sharing });
        self.layers.len() - 1
    }

    /// Adds an operation, and returns the index of the list that it writes.
    fn add(&mut self, kind: Kind, reads: &[usize], list: List) -> usize {
        let writes = self.lists.len();
        self.lists.push(list);
        self.operations.push(Operation { kind, reads: reads.into(), writes });
        writes
    }

    /// The weights in the order of the layers, a matrix `[in, out]` before each bias.
    ///
    /// # Panics
    /// If there is no tensor of a name.
    pub fn in_order(&self, tensors: &BTreeMap<String, Weights>) -> Vec<Vec<f32>> {
        let layers = self.layers.iter();
        let pairs = layers.flat_map(|layer| {
            let matrix = transposed(&tensors[&layer.weight].values, layer.input);
            [matrix, tensors[&layer.bias].values.clone()]
        });
        pairs.collect()
    }

    /// The inverse of [`Plan::in_order`].
    pub fn by_name<W: AsRef<[f32]>>(&self, weights: &[W]) -> BTreeMap<String, Weights> {
        let layers = self.layers.iter().zip(weights.as_chunks::<2>().0);
        let named = layers.flat_map(|(layer, [matrix, bias])| {
            let shape = vec![layer.output, layer.input];
            let matrix = Weights { shape, values: transposed(matrix.as_ref(), layer.output) };
            let bias = bias.as_ref();
            let bias = Weights { shape: vec![bias.len()], values: bias.to_vec() };
            [(layer.weight.clone(), matrix), (layer.bias.clone(), bias)]
        });
        named.collect()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::checkpoint::{Core, GridOptions, Sizes, initial_weights};

    proptest! {
        #[test]
        fn every_list_is_written_once_before_it_is_read(
            core in prop::sample::select(Core::ALL.to_vec()),
            pooling in prop::sample::select(vec![Pooling::Mean, Pooling::Max, Pooling::MeanMax]),
            particles in prop::option::of(1..5usize),
            layers in 1..4usize,
            channels in prop::collection::vec(1..6usize, GridOptions::LEVELS),
        ) {
            let sizes = Sizes { encoder: 3, hidden: 2, layers, particles };
            let architecture = match particles {
                Some(_) => Architecture::Frame,
                None => Architecture::Particle,
            };
            let mut description = Description::untrained(architecture, core, sizes);
            description.frame.pooling = pooling;
            if let Some(grid) = &mut description.grid {
                grid.channels = channels;
            }
            let plan = Plan::new(&description);
            let mut written = EXPECTED + 1;
            for Operation { kind, reads, writes } in &plan.operations {
                prop_assert!(reads.iter().all(|&list| list < written), "{kind:?}");
                prop_assert_eq!(*writes, written);
                written += 1;
                if let Kind::Linear { layer, .. } | Kind::MeanOfLinear { layer, .. } = *kind {
                    let widths = reads.iter().map(|&list| plan.lists[list].width);
                    prop_assert_eq!(widths.sum::<usize>(), plan.layers[layer].input);
                    prop_assert_eq!(plan.lists[*writes].width, plan.layers[layer].output);
                }
            }
            prop_assert_eq!(written, plan.lists.len());
            if let Some(grid) = &description.grid {
                let layers = (0..grid_layers(grid).len()).map(Stage::Convolution);
                let stages = [Stage::Encode, Stage::ToNodes].into_iter().chain(layers);
                let stages: Vec<_> = stages.chain([Stage::Decode]).collect();
                prop_assert_eq!(plan.stages(), stages);
            } else {
                let mut stages = match pooling {
                    Pooling::Mean => vec![FrameStage::Means],
                    Pooling::Max => vec![FrameStage::Maxima],
                    Pooling::MeanMax => vec![FrameStage::Means, FrameStage::Maxima],
                };
                stages.extend((0..layers).map(FrameStage::Core));
                stages.extend([FrameStage::Mix, FrameStage::Decode]);
                prop_assert_eq!(plan.frame_stages(), stages);
            }
            let weights = initial_weights(&description, 1);
            prop_assert_eq!(plan.by_name(&plan.in_order(&weights)), weights);
        }
    }
}
