//! What the particle model's kernels are compiled for, and where its tensors are in the memory of a device: one matrix a layer,
//! `[in, gates, out]`, those of the grid `[gates, out, in]`, with widths rounded up to 4, its bias behind it.
//!
//! | layer | rows | columns |
//! |---|---|---|
//! | `encoder.0`, `encoder.1` | F, E | E, C0 |
//! | `grid.*` | rows of the gathered nodes one behind the other | channels; of `up` for each child |
//! | `context` | F, C0 | H |
//! | core: from the input, then, of GRU and LSTM, from the last output | H | gates side by side |
//! | `mixer` | H | H |
//! | `decoder` | H | 4 |

use std::collections::BTreeMap;

use eddy_inference::{
    checkpoint::{
        Activation, Core, Description, Form, Rules, Weights,
        grid::{GridLayer, MAX_LISTS, grid_layers, grid_lists},
        layout::{self, particle_features},
        plan::{Plan, Stage},
    },
    kernels::nodes::{MAX_LEVELS, origin},
    ops::rules::Network,
};

use super::node_layers::stencil_number;
use crate::{
    device::count,
    error::{CudaError, Result},
    kernels::{
        AXES, MATERIALS, PARTICLE_SOURCE, Program,
        particle::{node_layers::StreamLayer, nodes::ROWS},
        round_up,
    },
};

/// Shared memory that leaves room for other blocks on the same processor, and the most a block can have on all GPUs from compute
/// capability 8.0 on (bytes).
pub(super) const SHARED: [usize; 2] = [72 << 10, 98 << 10];

/// What the kernels are compiled for: the widths and choices of a particle model.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Constants {
    /// F.
    pub features: usize,
    /// Materials that the network has inputs for.
    pub material_inputs: usize,
    /// E.
    pub encoder: usize,
    /// H.
    pub hidden: usize,
    /// Layers of the core.
    pub layers: usize,
    /// Channels of the grid's levels.
    pub channels: Vec<usize>,
    /// The layers on the grid.
    pub(super) grid: Vec<GridLayer>,
    /// What is launched in a frame, in order. Each is a fused form of the plan's operations: a tile stays in shared memory.
    pub(super) stages: Vec<Stage>,
    /// Level and padded width of the lists of features at nodes.
    pub(super) lists: Vec<(usize, usize)>,
    /// The recurrent core.
    pub core: Core,
    /// Of the MLP core.
    pub activation: Activation,
    /// The kernels of the rules.
    rules: String,
    /// Form of the minimal recurrences.
    pub form: Form,
    /// Whether minLSTM's gates are divided by their sum.
    pub normalized: bool,
    /// Particles of a block.
    pub tile: usize,
}

/// Nodes of a stencil behind each other, and bytes of `struct Stencil` of the kernels.
pub(super) const STENCIL_ROWS: usize = 3usize.pow(AXES as u32 - 1);
pub(super) const STENCIL_BYTES: usize = 4 * (3 * AXES + STENCIL_ROWS);

/// W rounded up to 4.
pub(super) fn four(width: usize) -> usize {
    round_up(width, 4)
}

/// Length of a row in shared memory: an odd multiple of 4, so that neighbouring rows are in different banks.
pub(super) fn odd(width: usize) -> usize {
    if (width / 4).is_multiple_of(2) { width + 4 } else { width }
}

/// The largest number of rows for which a block's shared memory is small, else the smallest if it fits at all.
pub(super) fn fitting(rows: &[usize], bytes: impl Fn(usize) -> usize) -> Option<usize> {
    let small = rows.iter().copied().find(|&rows| bytes(rows) <= SHARED[0]);
    small.or(rows.last().copied().filter(|&rows| bytes(rows) <= SHARED[1]))
}

impl Constants {
    /// Of a described particle model.
    ///
    /// # Errors
    /// [`CudaError::Unsupported`] for the frame model and for layers that are too wide.
    pub fn of(description: &Description) -> Result<Self> {
        let unsupported = |setting: String, expected| CudaError::Unsupported { setting, expected };
        let Some(grid) = &description.grid else {
            return Err(unsupported("architecture frame".to_owned(), "architecture particle"));
        };
        let sizes = &description.sizes;
        let mut constants = Self {
            features: particle_features(description),
            material_inputs: description.material_inputs,
            encoder: sizes.encoder,
            hidden: sizes.hidden,
            layers: sizes.layers,
            channels: grid.channels.clone(),
            grid: grid_layers(grid),
            stages: Plan::new(description).stages(),
            lists: grid_lists(grid)
                .into_iter()
                .map(|(level, width)| (level, four(width)))
                .collect(),
            core: description.core,
            activation: description.frame.activation,
            rules: description.rules.device_text(&Network::of(description)),
            form: description.form,
            normalized: description.normalize_gates,
            tile: ROWS,
        };
        let bytes = |tile| {
            let sized = Self { tile, ..constants.clone() };
            sized.encode_bytes().max(sized.decode_bytes())
        };
        let Some(tile) = fitting(&[64, 32, 16, 8, ROWS], bytes) else {
            return Err(constants.too_wide("at most about 950 for each on a GPU"));
        };
        constants.tile = tile;
        Ok(constants)
    }

    /// That the lists of particles are wider than these.
    pub(super) fn too_wide(&self, expected: &'static str) -> CudaError {
        let Self { encoder, hidden, channels, .. } = self;
        let setting = format!(
            "network.encoder {encoder}, network.hidden {hidden}, surroundings.channels {channels:?}"
        );
        CudaError::Unsupported { setting, expected }
    }

    /// Shared memory of a block of the encoder (bytes).
    pub(super) fn encode_bytes(&self) -> usize {
        let widths = [self.features, self.encoder, self.channels[0]];
        4 * self.tile * widths.map(|width| odd(four(width))).iter().sum::<usize>()
    }

    /// Shared memory of a block of the decoder (bytes).
    pub(super) fn decode_bytes(&self) -> usize {
        let hidden = self.hidden_columns();
        let wide = odd(self.context_rows().max(hidden));
        let lists = 1 + usize::from(self.core.remembers());
        4 * self.tile * (wide + lists * odd(hidden)) + self.tile * STENCIL_BYTES
    }

    /// H rounded up.
    pub(super) fn hidden_columns(&self) -> usize {
        four(self.hidden)
    }

    /// F rounded up: the numbers of a particle's features.
    pub(super) fn feature_columns(&self) -> usize {
        four(self.features)
    }

    /// C0 rounded up: the encoder's outputs.
    pub(super) fn encoded_columns(&self) -> usize {
        four(self.channels[0])
    }

    /// Rows of the matrix of `context`.
    pub(super) fn context_rows(&self) -> usize {
        self.feature_columns() + self.encoded_columns()
    }

    /// Lists of numbers, `[n, H4]` each, that the core remembers between frames.
    pub(super) fn states(&self) -> usize {
        if self.core.remembers() { self.core.states() * self.layers } else { 0 }
    }

    /// Levels of the grid.
    pub(super) fn levels(&self) -> usize {
        self.channels.len()
    }
}

impl Program for Constants {
    fn source(&self) -> String {
        [&PARTICLE_SOURCE.concat(), &*self.rules, include_str!("elastic.cu")].concat()
    }

    fn definitions(&self) -> Vec<(&'static str, usize)> {
        let position = |found: Option<usize>| found.unwrap_or_default();
        let own = [
            ("DIM", AXES),
            ("MATERIALS", MATERIALS),
            ("MATERIAL_INPUTS", self.material_inputs),
            ("F", self.features),
            ("E", self.encoder),
            ("C0", self.channels[0]),
            ("LEVELS", self.levels()),
            ("MAX_LEVELS", MAX_LEVELS),
            ("MAX_LISTS", MAX_LISTS),
            ("ORIGIN", origin(self.levels())),
            ("H", self.hidden),
            ("LAYERS", self.layers),
            (
                "ACTIVATION",
                position(Activation::ALL.iter().position(|&kind| kind == self.activation)),
            ),
            ("LOG_FORM", usize::from(self.form == Form::Log)),
            ("NORMALIZED", usize::from(self.normalized)),
            ("TILE", self.tile),
            ("STENCIL_BYTES", STENCIL_BYTES),
        ];
        let rules = Rules::definitions();
        own.into_iter().chain(self.core.definitions()).chain(rules).collect()
    }
}

/// Where the matrices are.
#[derive(Clone, Debug)]
pub struct Layout {
    /// First numbers of `encoder.0`, `encoder.1`, and of `context` with all that follow it.
    pub(super) encoder: [usize; 2],
    pub(super) grid: Vec<StreamLayer>,
    pub(super) context: usize,
}

/// A matrix that is written.
struct Matrix<'a> {
    weight: &'a Weights,
    bias: &'a Weights,
    /// Padded rows.
    rows: usize,
    /// The padded row of an input.
    row: &'a dyn Fn(usize) -> usize,
    /// Outputs side by side of so many groups, with a bias each.
    groups: usize,
    /// Whether it is `[gates, out, in]`.
    transposed: bool,
}

impl Matrix<'_> {
    /// Appends it to `all`, and returns its first number there.
    fn append(&self, all: &mut Vec<f32>) -> usize {
        let Self { weight, bias, rows, row, groups, transposed } = *self;
        let [outputs, inputs] = [weight.shape[0] / groups, weight.shape[1]];
        let columns = four(outputs);
        let [row_step, column_step] = if transposed { [1, rows] } else { [groups * columns, 1] };
        let begin = all.len();
        all.resize(begin + (rows + 1) * groups * columns, 0.0);
        for (output, values) in weight.values.chunks_exact(inputs).enumerate() {
            let column = output / outputs * columns + output % outputs;
            for (input, value) in values.iter().enumerate() {
                all[begin + row(input) * row_step + column * column_step] = *value;
            }
            // The children of a node share the bias.
            let own = bias.values[output % bias.values.len()];
            all[begin + rows * groups * columns + column] = own;
        }
        begin
    }
}

impl Layout {
    /// The places, and all matrices one behind the other, from the tensors of a checkpoint.
    #[expect(
        clippy::too_many_lines,
        reason = "the matrices one after another, in the order of the kernels"
    )]
    pub fn new(constants: &Constants, tensors: &BTreeMap<String, Weights>) -> (Self, Vec<f32>) {
        let mut all = Vec::new();
        let named = |[weight, bias]: [String; 2]| (&tensors[&weight], &tensors[&bias]);
        let add = |all: &mut Vec<f32>,
                   (weight, bias): (&Weights, &Weights),
                   rows: usize,
                   row: &dyn Fn(usize) -> usize,
                   groups: usize| {
            Matrix { weight, bias, rows, row, groups, transposed: false }.append(all)
        };
        let plain = |input: usize| input;
        let Constants { encoder, hidden, .. } = *constants;
        let features = constants.feature_columns();
        let encoder = [
            add(&mut all, named(layout::names("encoder.0")), features, &plain, 1),
            add(&mut all, named(layout::names("encoder.1")), four(encoder), &plain, 1),
        ];
        let layers = &constants.grid;
        let grid = layers
            .iter()
            .map(|layer| {
                let GridLayer { name, stencil, channels: [group, _], lists: [from, to], .. } =
                    layer;
                // Nothing is added where there is no skip connection; the kernels ask for the stencil.
                let skip = layer.skip.map_or(0, |layer| layers[layer].lists[1]);
                let [inner, outputs] = [from, to].map(|list| constants.lists[*list].1);
                let row = |input: usize| input / group * inner + input % group;
                let (weight, bias) = named(layout::names(name));
                let (rows, groups) = (stencil.places() * inner, stencil.children());
                let matrix = Matrix { weight, bias, rows, row: &row, groups, transposed: true };
                let first = matrix.append(&mut all);
                StreamLayer {
                    stencil: stencil_number(*stencil),
                    level: count(layer.node_level()),
                    from: count(*from),
                    to: count(*to),
                    skip: count(skip),
                    width: count(inner),
                    outputs: count(outputs),
                    rectified: layer.rectified.into(),
                    weights: count(first),
                }
            })
            .collect();
        // The gathered numbers begin behind the padded features.
        let own = constants.features;
        let row = |input: usize| if input < own { input } else { input - own + features };
        let context =
            add(&mut all, named(layout::names("context")), constants.context_rows(), &row, 1);
        let rows = four(hidden);
        for layer in 0..constants.layers {
            let core = constants.core;
            let tensors = |part: &str| named(core.tensors(layer, part));
            // Gates with tensors of their own lie side by side.
            let joined = |pick: fn((&Weights, &Weights)) -> Weights| {
                let mut parts = core.input_parts().iter().map(|(part, _)| pick(tensors(part)));
                let first = parts.next().expect("a core reads its input");
                parts.fold(first, |mut all, part| {
                    all.shape[0] += part.shape[0];
                    all.values.extend(part.values);
                    all
                })
            };
            let weight = joined(|(weight, _)| weight.clone());
            let bias = joined(|(_, bias)| bias.clone());
            add(&mut all, (&weight, &bias), rows, &plain, core.gates());
            if let Some(part) = core.recurrent_part() {
                add(&mut all, tensors(part), rows, &plain, core.gates());
            }
        }
        add(&mut all, named(layout::names("mixer")), rows, &plain, 1);
        add(&mut all, named(layout::names("decoder")), rows, &plain, 1);
        (Self { encoder, grid, context }, all)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_inference::checkpoint::{Architecture, Sizes};

    #[test]
    fn kernels_of_rules_have_the_same_parameters() {
        let sizes = Sizes { encoder: 8, hidden: 8, layers: 1, particles: None };
        let description = Description::untrained(Architecture::Particle, Core::MinGru, sizes);
        let text = Constants::of(&description).unwrap().rules + include_str!("elastic.cu");
        let parameters: Vec<_> = text
            .split("extern \"C\" __global__ void ")
            .skip(1)
            .map(|declared| {
                let (head, _) = declared.split_once(") {").unwrap();
                let (_, parameters) = head.rsplit_once('(').unwrap();
                parameters
            })
            .collect();
        assert!(parameters.len() > 10, "{parameters:?}");
        assert!(parameters.windows(2).all(|pair| pair[0] == pair[1]), "{parameters:?}");
    }
}
