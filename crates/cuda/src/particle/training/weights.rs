//! The gradients by the weights, once those by all sums are there, and Adam.

use super::{
    Training,
    forward::stencil_number,
    layout::{Layout, MOST_SHARED, TrainingConstants},
    plan::Plan,
};
use crate::{
    device::{Buffer, Device, Queue, Shape},
    error::{CudaError, Result},
    kernels::Kernel,
    particle::layout::{ROWS, odd},
    training::{Matrix, Settings},
};
use eddy_inference::checkpoint::grid::Stencil;

/// Blocks of a matrix, at least about so many where there are frames enough.
const BLOCKS: usize = 128;
/// Threads of a block, `OUTER_THREADS` of the kernels.
const THREADS: usize = 256;
/// Numbers of a thread.
const SQUARE: usize = 16;
/// Rows of particles that a block has at a time: enough to hide the time that memory takes.
const PARTICLE_ROWS: usize = 128;
/// Words of an `Outer` of the kernels.
const WORDS: usize = 16;

/// Where the rows are that a matrix is multiplied by, and the gradients by its products.
#[derive(Clone, Copy)]
struct Rows {
    at: [u64; 2],
    /// Numbers of a row that take part.
    widths: [usize; 2],
    /// Numbers from a row to the next one.
    strides: [usize; 2],
    /// The stencil and the level, of rows of nodes.
    nodes: Option<(Stencil, usize)>,
    /// Numbers left out before the last third of the gradients.
    gap: usize,
}

impl Rows {
    /// Rows of particles.
    fn of_particles(x: (u64, usize), by: (u64, usize)) -> Self {
        let widths = [x.1, by.1];
        Self { at: [x.0, by.0], widths, strides: widths, nodes: None, gap: 0 }
    }

    /// Adds the blocks of a matrix to the table of all, `nodes` rows at a time where they are of nodes: the shared memory of a
    /// block (bytes).
    fn blocks(self, matrix: &Matrix, nodes: usize, table: &mut Vec<[u32; WORDS]>) -> Result<usize> {
        let (stencil, level) = self.nodes.map_or((0, -1), |(stencil, level)| {
            (stencil_number(stencil), i32::try_from(level).unwrap_or_default())
        });
        let (places, targets, rows) = match self.nodes {
            Some((stencil, _)) => (stencil.places(), stencil.children(), nodes),
            None => (1, 1, PARTICLE_ROWS),
        };
        let [inner, columns] = [places * self.widths[0], targets * self.widths[1]];
        let squares = (inner / 4 + 1) * (columns / 4);
        let parts = (THREADS / squares).max(1);
        let bytes = |rows: usize| {
            4 * (rows * (odd(inner) + odd(columns))).max((parts - 1) * squares * SQUARE)
        };
        let Some(rows) =
            [rows, 64, 32, 16, ROWS].into_iter().find(|&r| r <= rows && bytes(r) <= MOST_SHARED)
        else {
            let setting = format!("a layer of {inner} inputs and {columns} outputs");
            let expected = "about 2000 inputs at most to train the particle model on a GPU";
            return Err(CudaError::Unsupported { setting, expected });
        };
        for begun in (0..squares * parts).step_by(THREADS) {
            let mut words = [0; WORDS];
            words[..4].copy_from_slice(bytemuck::cast_slice(&self.at));
            let [[width, outputs], [x_stride, stride]] = [self.widths, self.strides];
            let numbers = [width, x_stride, outputs, stride, self.gap, parts, rows, begun];
            words[4..7].copy_from_slice(&[matrix.first as u32, stencil as u32, level as u32]);
            words[7..15].copy_from_slice(&numbers.map(|number| number as u32));
            table.push(words);
        }
        Ok(bytes(rows))
    }
}

/// A launch for several matrices.
struct OuterLaunch {
    shape: Shape,
    /// The first one's place in the table.
    first: usize,
}

/// The launches for all matrices, and their memory.
pub(super) struct Outers {
    /// Shares of a window's frames that are summed up on their own.
    splits: usize,
    /// `Outer` of the kernels for every block along y.
    table: Buffer,
    /// Of particles and of nodes, which take so many rows at a time.
    all: Vec<OuterLaunch>,
    /// `[B, splits, weights]`.
    parts: Buffer,
    /// Whether a window's gradient is not finite, `[B]`.
    broken: Buffer,
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
            let (first, mut shared) = (table.len(), 0);
            for (matrix, rows) in group {
                shared = shared.max(rows.blocks(matrix, constants.nodes, &mut table)?);
            }
            let shape = Shape::new(batch * splits, table.len() - first, THREADS);
            all.push(OuterLaunch { shape: Shape { shared, ..shape }, first });
        }
        let bytes: &[u8] = bytemuck::cast_slice(&table);
        let buffer = device.allocate(bytes.len())?;
        device.write(&buffer, 0, bytes)?;
        Ok(Self {
            splits,
            table: buffer,
            all,
            parts: device.allocate(4 * batch * splits * layout.packing.size)?,
            broken: device.allocate(4 * batch)?,
        })
    }
}

/// Every matrix with its rows; a step has so many sheets.
fn rows<'a>(
    layout: &'a Layout,
    constants: &TrainingConstants,
    plan: &Plan,
    sheets: usize,
) -> Vec<(&'a Matrix, Rows)> {
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
        (encoder, features),
        (second, Rows::of_particles(hidden, (plan.by_encoded, network.encoded_columns()))),
    ];
    let fields = constants.fields();
    for (from, (matrix, layer)) in layout.grid.iter().zip(&network.grid).enumerate() {
        let to = from + 1;
        let read = (plan.fields[from], fields[from].1);
        let lists = Rows::of_particles(read, (plan.slopes[to], fields[to].1));
        let nodes = Some((layer.stencil, layer.node_level()));
        all.push((matrix, Rows { nodes, ..lists }));
    }
    let by_context = (plan.by_context, units);
    all.push((&layout.context, Rows::of_particles((plan.inputs, inputs), by_context)));
    let rows = sheets * plan.most();
    // The outputs of a layer of the core, from those before the first frame on, or from those of the first frame on.
    let frame = rows / plan.frames();
    let outputs = |layer: usize, after: usize| {
        let first = layer * (rows + frame) + after * frame;
        (plan.outputs + 4 * (first * units) as u64, units)
    };
    for (layer, (matrix, recurrent)) in layout.core.iter().enumerate() {
        let slots = constants.slots();
        let gates = (plan.gates + 4 * (layer * rows * slots) as u64, matrix.columns);
        let input = match layer {
            0 => (plan.context, units),
            _ => outputs(layer - 1, 1),
        };
        let by_sums = Rows { strides: [units, slots], ..Rows::of_particles(input, gates) };
        all.push((matrix, by_sums));
        if let Some(recurrent) = recurrent {
            // Of GRU, the last gate's part through the state is the slot behind the gates.
            let gap = slots - recurrent.columns;
            let last = outputs(layer, 0);
            let rows = Rows { gap, ..Rows::of_particles(last, gates) };
            all.push((recurrent, Rows { strides: [units, slots], ..rows }));
        }
    }
    let last = outputs(layout.core.len() - 1, 1);
    all.push((&layout.mixer, Rows::of_particles(last, (plan.by_mixed, units))));
    let output = (plan.output, constants.output_columns());
    all.push((&layout.decoder, Rows::of_particles((plan.mixed, units), output)));
    all
}

impl Training {
    /// The gradients by the weights, and their change.
    pub(super) fn learn(&self) -> Result<()> {
        let (batch, size) = (self.settings.batch, self.layout.packing.size);
        let Outers { splits, table, all, parts, broken } = &self.outers;
        let (parts, ends) = (parts.address(), [(*splits).into(), size.into()]);
        for OuterLaunch { shape, first } in all {
            let [splits, size] = ends;
            let outers = table.address().plus(first * WORDS);
            let arguments = [self.plan(), outers.into(), parts.into(), splits, size];
            self.launch(Kernel::TrainOuter, *shape, &arguments)?;
        }
        self.device.clear(Queue::Main, broken)?;
        let [splits_argument, size_argument] = ends;
        self.launch(
            Kernel::TrainFinite,
            Shape::new(size.div_ceil(16 * THREADS), batch * splits, THREADS),
            &[parts.into(), broken.address().into(), splits_argument, size_argument],
        )?;
        self.launch(
            Kernel::TrainSum,
            Shape::new(size.div_ceil(THREADS), 1, THREADS),
            &[
                parts.into(),
                broken.address().into(),
                self.optimizer.gradients.address().into(),
                batch.into(),
                splits_argument,
                size_argument,
            ],
        )?;
        let matrices = self.layout.packing.matrices();
        self.optimizer.measure(Queue::Main, matrices)?;
        self.optimizer.change(Queue::Main, matrices, &self.tables)
    }
}
