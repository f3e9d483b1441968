//! The gradients by the weights, once those by all sums are there, and the optimizer.

use super::{
    Training, WARP,
    layout::{Layout, TrainingConstants},
};
use crate::{
    device::{Device, List, Pointer, Queue, Shape, count},
    error::Result,
    kernels::particle::{
        node_layers::ITSELF,
        training::{
            plan::Plan,
            weights::{
                OUTER_THREADS as THREADS, OUTER_TILES, Outer, TrainFinite, TrainOuter, TrainSum,
            },
        },
    },
    particle::node_layers::stencil_number,
    training::Settings,
};
use eddy_inference::checkpoint::grid::Stencil;

/// Blocks of a matrix, at least about so many where there are frames enough.
const BLOCKS: usize = 128;
/// Rows and columns of a tile; the most tiles of a block along both, and in all.
const TILE: [usize; 2] = [16, 8];
const HIGH: usize = 10;
const WIDE: usize = 16;
const TILES: usize = THREADS / WARP * OUTER_TILES;
/// Rows of nodes and of particles that a block has at a time: enough to hide the time that memory takes.
const NODE_ROWS: usize = 16;
const PARTICLE_ROWS: usize = 32;

/// Length of a row in shared memory, `outer_stride` of the kernels.
fn stride(width: usize) -> usize {
    (width + 23) / 32 * 32 + 8
}

/// Where the rows are that a matrix is multiplied by, and the gradients by its products.
#[derive(Clone, Copy)]
struct Rows {
    at: [Pointer<f32>; 2],
    /// Numbers of a row that take part.
    widths: [usize; 2],
    /// Numbers from a row to the next one.
    strides: [usize; 2],
    /// The nodes that make up a row, and their level.
    nodes: Option<(NodeRows, usize)>,
    /// Numbers left out before the split gate's columns of the gradients.
    gap: usize,
}

/// The nodes that make up a row.
#[derive(Clone, Copy)]
enum NodeRows {
    /// Those that a layer reads, whose bias is for the node.
    Layer(Stencil),
    /// Each for itself: children, which share a bias.
    Bias,
}

impl NodeRows {
    fn places(self) -> usize {
        match self {
            Self::Layer(stencil) => stencil.places(),
            Self::Bias => 1,
        }
    }

    /// Rows of the gradients for each row.
    fn targets(self) -> usize {
        match self {
            Self::Layer(stencil) => stencil.children(),
            Self::Bias => 1,
        }
    }

    fn number(self) -> i32 {
        match self {
            Self::Layer(stencil) => stencil_number(stencil),
            Self::Bias => count(ITSELF),
        }
    }
}

impl Rows {
    /// Rows of particles.
    fn of_particles(x: (Pointer<f32>, usize), by: (Pointer<f32>, usize)) -> Self {
        let widths = [x.1, by.1];
        Self { at: [x.0, by.0], widths, strides: widths, nodes: None, gap: 0 }
    }

    /// Adds the parts of a matrix that begins at `first` to the table of all: the shared memory of a block (bytes).
    fn parts(self, first: usize, table: &mut Vec<Outer>) -> usize {
        let (stencil, level) =
            self.nodes.map_or((0, -1), |(nodes, level)| (nodes.number(), level as i32));
        let (places, targets, rows) = match self.nodes {
            Some((nodes, _)) => (nodes.places(), nodes.targets(), NODE_ROWS),
            None => (1, 1, PARTICLE_ROWS),
        };
        let [inner, columns] = [places * self.widths[0], targets * self.widths[1]];
        // Behind a matrix is its bias, but for that of children.
        let height = if targets == 1 { inner + 1 } else { inner };
        let wide = columns.div_ceil(TILE[1]).min(WIDE);
        let [high_step, wide_step] = [(TILES / wide).min(HIGH) * TILE[0], wide * TILE[1]];
        for left in (0..height).step_by(high_step) {
            for right in (0..columns).step_by(wide_step) {
                table.push(Outer {
                    x: self.at[0],
                    by: self.at[1],
                    first: count(first),
                    stencil,
                    level,
                    width: count(self.widths[0]),
                    x_stride: count(self.strides[0]),
                    outputs: count(self.widths[1]),
                    stride: count(self.strides[1]),
                    gap: count(self.gap),
                    rows: count(rows),
                    left: count(left),
                    left_end: count((left + high_step).min(height)),
                    right: count(right),
                    right_end: count((right + wide_step).min(columns)),
                    unused: 0,
                });
            }
        }
        let row = stride(height.next_multiple_of(TILE[0]).min(high_step)) + stride(wide_step);
        // While some rows are multiplied, the next ones are on their way.
        4 * (2 * rows * row).max(4 * THREADS)
    }
}

/// A launch for several matrices.
struct OuterLaunch {
    /// For one share of the frames.
    shape: Shape,
    /// The first one's place in the table.
    first: usize,
}

/// The launches for all matrices, and their memory.
pub(super) struct Outers {
    /// Shares of a window's frames that are summed up on their own.
    pub(super) splits: usize,
    /// For every block along y.
    table: List<Outer>,
    /// Of particles and of nodes, which take so many rows at a time.
    all: Vec<OuterLaunch>,
    /// `[B, splits, weights]`.
    parts: List<f32>,
    /// Whether a window's gradient is not finite, `[B]`.
    broken: List<u32>,
}

impl Outers {
    pub(super) fn new(
        device: &dyn Device,
        layout: &Layout,
        constants: &TrainingConstants,
        plan: &Plan,
        settings: &Settings,
    ) -> Result<Self> {
        let Settings { batch, warm_up, unroll, .. } = *settings;
        let splits = BLOCKS.div_ceil(batch).min(warm_up + unroll - 1);
        let pairs = rows(layout, constants, plan, batch * (warm_up + unroll - 1));
        let (of_nodes, of_particles): (Vec<_>, Vec<_>) =
            pairs.into_iter().partition(|(_, rows)| rows.nodes.is_some());
        let (mut table, mut all) = (Vec::new(), Vec::new());
        for group in [of_particles, of_nodes].into_iter().filter(|group| !group.is_empty()) {
            let (begun, mut shared) = (table.len(), 0);
            for (first, rows) in group {
                shared = shared.max(rows.parts(first, &mut table));
            }
            let shape = Shape { shared, ..Shape::new(batch, table.len() - begun, THREADS) };
            all.push(OuterLaunch { shape, first: begun });
        }
        Ok(Self {
            splits,
            table: List::of(device, &table)?,
            all,
            parts: List::new(device, batch * splits * layout.packing.size)?,
            broken: List::new(device, batch)?,
        })
    }
}

impl Outers {
    /// The first share that has frames from `first` on only, of so many frames.
    pub(super) fn shares_from(&self, first: usize, frames: usize) -> usize {
        (first * self.splits).div_ceil(frames)
    }
}

/// Where every matrix begins, with its rows; a step has so many sheets.
fn rows(
    layout: &Layout,
    constants: &TrainingConstants,
    plan: &Plan,
    sheets: usize,
) -> Vec<(usize, Rows)> {
    let network = &constants.network;
    let (units, inputs) = (network.hidden_columns(), network.context_rows());
    let encoder_units = constants.encoder_columns();
    let [encoder, second] = &layout.encoder;
    let features = Rows {
        strides: [inputs, encoder_units],
        ..Rows::of_particles(
            (plan.inputs, network.feature_columns()),
            (plan.by_hidden, encoder_units),
        )
    };
    let hidden = (plan.hidden, encoder_units);
    let mut all = vec![
        (encoder.first, features),
        (second.first, Rows::of_particles(hidden, (plan.by_encoded, network.encoded_columns()))),
    ];
    let fields = constants.fields();
    for (from, (matrix, layer)) in layout.grid.iter().zip(&network.grid).enumerate() {
        let to = from + 1;
        let read = (plan.fields[from], fields[from].1);
        let written = (plan.slopes[to], fields[to].1);
        let nodes = Some((NodeRows::Layer(layer.stencil), layer.node_level()));
        all.push((matrix.first, Rows { nodes, ..Rows::of_particles(read, written) }));
        if layer.stencil.children() > 1 {
            // They share a bias: it is where the first one's would be.
            let nodes = Some((NodeRows::Bias, layer.level));
            let bias = matrix.first + matrix.bias * matrix.columns;
            all.push((bias, Rows { nodes, ..Rows::of_particles((read.0, 0), written) }));
        }
    }
    let by_context = (plan.by_context, units);
    all.push((layout.context.first, Rows::of_particles((plan.inputs, inputs), by_context)));
    let rows = sheets * plan.most();
    // The outputs of a layer of the core, from those before the first frame on, or from those of the first frame on.
    let frame = rows / plan.frames();
    let outputs = |layer: usize, after: usize| {
        let first = layer * (rows + frame) + after * frame;
        (plan.outputs.plus(first * units), units)
    };
    for (layer, (matrix, recurrent)) in layout.core.iter().enumerate() {
        let slots = constants.slots();
        let gates = (plan.gates.plus(layer * rows * slots), matrix.columns);
        let input = match layer {
            0 => (plan.context, units),
            _ => outputs(layer - 1, 1),
        };
        let by_sums = Rows { strides: [units, slots], ..Rows::of_particles(input, gates) };
        all.push((matrix.first, by_sums));
        if let Some(recurrent) = recurrent {
            // The part of the last gate through the state is the slot behind the gates, if it is a sum of its own.
            let gap = slots - recurrent.columns;
            let last = outputs(layer, 0);
            let rows = Rows { gap, ..Rows::of_particles(last, gates) };
            all.push((recurrent.first, Rows { strides: [units, slots], ..rows }));
        }
    }
    let last = outputs(layout.core.len() - 1, 1);
    all.push((layout.mixer.first, Rows::of_particles(last, (plan.by_mixed, units))));
    let output = (plan.output, constants.output_columns());
    all.push((layout.decoder.first, Rows::of_particles((plan.mixed, units), output)));
    all
}

impl Training {
    /// The gradients by the weights of so many shares of the frames, beside the main queue.
    pub(super) fn add_gradients(&self, first: usize, shares: usize) -> Result<()> {
        let Outers { splits, table, all, parts, .. } = &self.outers;
        for OuterLaunch { shape, first: outer } in all {
            let [blocks, outers, _] = shape.grid;
            self.launch_in(
                Queue::Side,
                Shape { grid: [blocks * shares, outers, 1], ..*shape },
                TrainOuter {
                    plan: self.plan(),
                    outers: table.pointer().plus(*outer),
                    parts: parts.pointer(),
                    splits: count(*splits),
                    first: count(first),
                    size: count(self.layout.packing.size),
                },
            )?;
        }
        Ok(())
    }

    /// The gradients of all shares, and the change of the weights.
    pub(super) fn learn(&self) -> Result<()> {
        let (batch, size) = (self.settings.batch, self.layout.packing.size);
        let Outers { splits, parts, broken, .. } = &self.outers;
        self.device.clear(Queue::Main, broken)?;
        let by_window = Shape::new(size.div_ceil(16 * THREADS), batch * splits, THREADS);
        let by_weight = Shape::new(size.div_ceil(THREADS), 1, THREADS);
        let (parts, broken) = (parts.pointer(), broken.pointer());
        let [windows, splits, size] = [batch, *splits, size].map(count);
        let gradients = self.optimizer.gradients.pointer();
        self.launch(by_window, TrainFinite { parts, broken, splits, size })?;
        self.launch(by_weight, TrainSum { parts, broken, gradients, windows, splits, size })?;
        let matrices = self.layout.packing.matrices();
        self.optimizer.measure(Queue::Main, matrices)?;
        self.optimizer.change(Queue::Main, matrices, &self.tables)?;
        self.optimizer.change_hidden(&self.tables)
    }
}
