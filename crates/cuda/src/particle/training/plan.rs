//! The memory of a training's steps, and the struct through which the kernels know it.

#![expect(unsafe_code, reason = "a struct that the device reads")]

use std::sync::Arc;

use eddy_inference::{
    checkpoint::{Description, grid::Stencil},
    engine::{Ballistic, scales},
    kernels::nodes::{MAX_LEVELS, map_extent},
};

use super::{
    layout::{MAX_FIELDS, TrainingConstants},
    store::Store,
};
use crate::{
    device::{Address, Buffer, Device},
    error::Result,
    kernels::AXES,
    particle::stream::cells_across,
    training::{Settings, Tables},
};

/// Numbers of a body.
const BODY: usize = 2 * AXES;
/// Particles of a block of the kernels that advance them.
pub(super) const PARTICLE_THREADS: usize = 256;

/// `struct Plan` of the kernels.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct Plan {
    store: u64,
    counts: u64,
    material: u64,
    stiffness: u64,
    link_first: u64,
    links: u64,
    incoming_first: u64,
    incoming: u64,
    windows: u64,
    progress: u64,
    error_weights: u64,
    states: u64,
    starts: u64,
    order: u64,
    weights: u64,
    maps: [u64; MAX_LEVELS],
    lists: [u64; MAX_LEVELS],
    around: [u64; MAX_LEVELS],
    children: [u64; MAX_LEVELS],
    totals: u64,
    pub(super) inputs: u64,
    pub(super) hidden: u64,
    pub(super) encoded: u64,
    pub(super) context: u64,
    pub(super) gates: u64,
    pub(super) outputs: u64,
    cells: u64,
    pub(super) mixed: u64,
    pub(super) output: u64,
    pub(super) fields: [u64; MAX_FIELDS],
    pub(super) by_hidden: u64,
    pub(super) by_encoded: u64,
    pub(super) by_context: u64,
    pub(super) by_mixed: u64,
    pub(super) slopes: [u64; MAX_FIELDS],
    cell_counts: u64,
    cell_of: u64,
    arrivals: u64,
    unsorted: u64,
    by_inputs: u64,
    by_state: u64,
    by_output: u64,
    by_cell: u64,
    by_expected: u64,
    by_shape: u64,
    pub(super) squares: u64,
    pub(super) scales: u64,
    batch: u32,
    warm_up: u32,
    unroll: u32,
    most: u32,
    weights_step: u32,
    across: [u32; AXES],
    entries: [u32; MAX_LEVELS],
    nodes: [u32; MAX_LEVELS],
    lower: [f32; AXES],
    extent: [f32; AXES],
    width: f32,
    walls: [[f32; AXES]; 2],
    fall: [f32; AXES],
    dt: f32,
    unit: f32,
    speeds: [[f32; AXES]; 2],
    sides: f32,
    even: f32,
}

impl Plan {
    /// Particles of the largest window.
    pub(super) fn most(&self) -> usize {
        self.most as usize
    }

    /// Frames that the network sees.
    pub(super) fn frames(&self) -> usize {
        (self.warm_up + self.unroll) as usize - 1
    }
}

const _: () = assert!(
    size_of::<Plan>() == 8 * (41 + 4 * MAX_LEVELS + 2 * MAX_FIELDS) + 4 * (26 + 2 * MAX_LEVELS)
);
// SAFETY: integers and numbers without padding between them, as the size shows.
unsafe impl bytemuck::Zeroable for Plan {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for Plan {}

/// The memory of a training's steps.
pub(super) struct Memory {
    pub(super) plan: Plan,
    /// `plan` where the kernels read it.
    pub(super) device_plan: Buffer,
    /// Most nodes of a window, by level.
    pub(super) nodes: [usize; MAX_LEVELS],
    /// Gradients that go from a frame to the one before, zero after the last frame and where they are cut.
    pub(super) carried: Vec<Buffer>,
    _lists: Vec<Buffer>,
}

/// Allocates lists.
struct Lists<'a> {
    device: &'a dyn Device,
    kept: Vec<Buffer>,
}

impl Lists<'_> {
    /// A list of numbers of 4 bytes.
    fn next(&mut self, numbers: usize) -> Result<u64> {
        let buffer = self.device.allocate(4 * numbers)?;
        let at = buffer.address();
        self.kept.push(buffer);
        Ok(at.0)
    }
}

/// The most nodes of a level: each particle touches nine, and four of the coarser ones; and there is one at each corner of the
/// domain's cells, and beyond.
fn most_nodes(particles: usize, extent: [f32; AXES]) -> [usize; MAX_LEVELS] {
    std::array::from_fn(|level| {
        let along = |cells: f32| ((cells.ceil() as usize + 1) >> level) + 2;
        let touched = if level == 0 { 9 } else { 4 };
        extent.map(along).iter().product::<usize>().min(particles.saturating_mul(touched))
    })
}

impl Memory {
    #[expect(clippy::too_many_lines, reason = "the buffers of a step, one after another")]
    pub(super) fn new(
        device: &Arc<dyn Device>,
        store: &Store,
        tables: &Tables,
        description: &Description,
        constants: &TrainingConstants,
        settings: &Settings,
    ) -> Result<Self> {
        let Settings { batch, warm_up, unroll, .. } = *settings;
        let network = &constants.network;
        let most = store.most();
        let frames = warm_up + unroll - 1;
        let (sheets, rows) = (frames * batch, frames * batch * most);
        let width = description.grid.as_ref().map_or(1.0, |grid| grid.cell_width);
        let extent = cells_across(&description.domain, width);
        let across = map_extent(extent, network.levels());
        let entries: [usize; MAX_LEVELS] =
            std::array::from_fn(|level| across.iter().map(|cells| cells >> level).product());
        let nodes = most_nodes(most, extent);
        let units = network.hidden_columns();
        let ballistic = Ballistic::new(description);
        let (slowest, fastest) = scales::velocity_limits(&description.normalization);
        let has_cells = network.core.states() > 1;

        let mut lists = Lists { device: &**device, kept: Vec::new() };
        let (mut fields, mut slopes) = ([0; MAX_FIELDS], [0; MAX_FIELDS]);
        for (number, (level, width)) in constants.fields().into_iter().enumerate() {
            for list in [&mut fields, &mut slopes] {
                list[number] = lists.next(sheets * nodes[level] * width)?;
            }
        }
        let [mut maps, mut node_lists, mut around, mut children] = [[0; MAX_LEVELS]; 4];
        for level in 0..network.levels() {
            let all = sheets * nodes[level];
            maps[level] = lists.next(sheets * entries[level])?;
            node_lists[level] = lists.next(all)?;
            around[level] = lists.next(all * Stencil::Neighbours.places())?;
            children[level] =
                lists.next(if level == 0 { 0 } else { all * Stencil::Children.places() })?;
        }
        let together = warm_up * batch;
        let carried_rows = batch * most;
        let carried = [
            network.layers * carried_rows * units,
            if has_cells { network.layers * carried_rows * units } else { 0 },
            carried_rows * AXES,
            carried_rows * BODY,
        ];
        let carried: Vec<Buffer> =
            carried.into_iter().map(|count| device.allocate(4 * count)).collect::<Result<_>>()?;
        let at = |buffer: &Buffer| buffer.address().0;
        let links = store.links.as_ref();
        let link = |pick: fn(&super::store::Links) -> &Buffer| {
            links.map_or(Address::NULL.0, |links| at(pick(links)))
        };
        let states = network.layers * (rows + carried_rows) * units;
        let plan = Plan {
            store: at(&store.bodies),
            counts: at(&store.counts),
            material: at(&store.material),
            stiffness: at(&store.stiffness),
            link_first: link(|links| &links.own[0]),
            links: link(|links| &links.own[1]),
            incoming_first: link(|links| &links.incoming[0]),
            incoming: link(|links| &links.incoming[1]),
            windows: at(&tables.windows),
            progress: at(&tables.progress),
            error_weights: at(&tables.error_weights),
            states: lists.next(rows * BODY)?,
            starts: lists.next(sheets * (entries[0] + 1))?,
            order: lists.next(rows)?,
            weights: lists.next(rows * 3 * AXES)?,
            maps,
            lists: node_lists,
            around,
            children,
            totals: lists.next(sheets * network.levels())?,
            inputs: lists.next(rows * network.context_rows())?,
            hidden: lists.next(rows * constants.encoder_columns())?,
            encoded: lists.next(rows * network.encoded_columns())?,
            context: lists.next(rows * units)?,
            gates: lists.next(network.layers * rows * constants.slots())?,
            outputs: lists.next(states)?,
            cells: lists.next(if has_cells { states } else { 0 })?,
            mixed: lists.next(rows * units)?,
            output: lists.next(rows * constants.output_columns())?,
            fields,
            by_hidden: lists.next(rows * constants.encoder_columns())?,
            by_encoded: lists.next(rows * network.encoded_columns())?,
            by_context: lists.next(rows * units)?,
            by_mixed: lists.next(rows * units)?,
            slopes,
            cell_counts: lists.next(together * entries[0])?,
            cell_of: lists.next(together * most)?,
            arrivals: lists.next(together * most)?,
            unsorted: lists.next(together * most)?,
            by_inputs: lists.next(together * most * network.context_rows())?,
            by_state: at(&carried[3]),
            by_output: at(&carried[0]),
            by_cell: at(&carried[1]),
            by_expected: at(&carried[2]),
            by_shape: lists.next(carried_rows * AXES * (AXES + 1))?,
            squares: lists.next(sheets * most.div_ceil(PARTICLE_THREADS))?,
            scales: lists.next(2 * batch)?,
            batch: batch as u32,
            warm_up: warm_up as u32,
            unroll: unroll as u32,
            most: most as u32,
            weights_step: tables.weights_step() as u32,
            across: across.map(|cells| cells as u32),
            entries: entries.map(|entries| entries as u32),
            nodes: nodes.map(|nodes| nodes as u32),
            lower: description.domain.lower,
            extent,
            width,
            walls: [ballistic.lower, ballistic.upper],
            fall: ballistic.gravity.map(|gravity| gravity * ballistic.dt),
            dt: ballistic.dt,
            unit: scales::velocity_unit(&description.normalization),
            speeds: [slowest, fastest],
            sides: description.domain.lower[0] + description.domain.upper[0],
            even: if warm_up > 1 { unroll as f32 / (warm_up - 1) as f32 } else { 0.0 },
        };
        let device_plan = device.allocate(size_of::<Plan>())?;
        device.write(&device_plan, 0, bytemuck::bytes_of(&plan))?;
        Ok(Self { plan, device_plan, nodes, carried, _lists: lists.kept })
    }
}
