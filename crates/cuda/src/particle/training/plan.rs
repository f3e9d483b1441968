//! The memory of a training's steps.

use std::sync::Arc;

use eddy_inference::{
    checkpoint::{Description, grid::Stencil},
    engine::{Ballistic, scales},
    kernels::nodes::{MAX_LEVELS, map_extent},
};

use super::{
    layout::TrainingConstants,
    store::{Links, Store},
};
use crate::{
    device::{Buffer, Device, List, Pointer, Queue, count},
    error::Result,
    kernels::{
        AXES,
        particle::training::plan::{MAX_FIELDS, Plan},
    },
    particle::stream::cells_across,
    streams::Body,
    training::{Settings, Tables},
};

/// Particles of a block of the kernels that advance them.
pub(super) const PARTICLE_THREADS: usize = 256;

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

/// The memory of a training's steps.
pub(super) struct Memory {
    pub(super) plan: Plan,
    /// The same where the kernels read it.
    pub(super) device_plan: List<Plan>,
    /// Most nodes of a window, by level.
    pub(super) nodes: [usize; MAX_LEVELS],
    /// Gradients that go from a frame to the one before, zero after the last frame and where they are cut.
    pub(super) carried: Carried,
    _lists: Vec<Buffer>,
}

/// Gradients that go from a frame to the one before: by the core's outputs and cells, the expected velocities, the particles.
pub(super) struct Carried {
    output: List<f32>,
    cell: List<f32>,
    expected: List<f32>,
    state: List<Body>,
}

impl Carried {
    /// Sets them to zero.
    pub(super) fn clear(&self, device: &dyn Device) -> Result<()> {
        let lists: [&Buffer; 4] = [&self.output, &self.cell, &self.expected, &self.state];
        lists.into_iter().try_for_each(|list| device.clear(Queue::Main, list))
    }
}

/// Allocates lists.
struct Lists<'a> {
    device: &'a dyn Device,
    kept: Vec<Buffer>,
}

impl Lists<'_> {
    fn next<T: bytemuck::Pod>(&mut self, items: usize) -> Result<Pointer<T>> {
        let list = List::new(self.device, items)?;
        let at = list.pointer();
        self.kept.push(list.into());
        Ok(at)
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
        let (mut fields, mut slopes) = ([Pointer::NULL; MAX_FIELDS], [Pointer::NULL; MAX_FIELDS]);
        for (number, (level, width)) in constants.fields().into_iter().enumerate() {
            for list in [&mut fields, &mut slopes] {
                list[number] = lists.next(sheets * nodes[level] * width)?;
            }
        }
        let [mut maps, mut node_lists, mut around, mut children] = [[Pointer::NULL; MAX_LEVELS]; 4];
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
        let carried_units = network.layers * carried_rows * units;
        let carried = Carried {
            output: List::new(&**device, carried_units)?,
            cell: List::new(&**device, if has_cells { carried_units } else { 0 })?,
            expected: List::new(&**device, carried_rows * AXES)?,
            state: List::new(&**device, carried_rows)?,
        };
        let (link_first, links) = store.links.as_ref().map(Links::own).unwrap_or_default();
        let (incoming_first, incoming) =
            store.links.as_ref().map(Links::incoming).unwrap_or_default();
        let states = network.layers * (rows + carried_rows) * units;
        let plan = Plan {
            store: store.bodies.pointer(),
            counts: store.counts.pointer(),
            material: store.material.pointer(),
            stiffness: store.stiffness.pointer(),
            link_first,
            links,
            incoming_first,
            incoming,
            windows: tables.windows.pointer(),
            progress: tables.progress.pointer(),
            error_weights: tables.error_weights.pointer(),
            states: lists.next(rows)?,
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
            by_state: carried.state.pointer(),
            by_output: carried.output.pointer(),
            by_cell: carried.cell.pointer(),
            by_expected: carried.expected.pointer(),
            by_shape: lists.next(carried_rows * AXES * (AXES + 1))?,
            squares: lists.next(sheets * most.div_ceil(PARTICLE_THREADS))?,
            scales: lists.next(2 * batch)?,
            batch: count(batch),
            warm_up: count(warm_up),
            unroll: count(unroll),
            most: count(most),
            weights_step: count(tables.weights_step()),
            across: across.map(count),
            entries: entries.map(count),
            nodes: nodes.map(count),
            lower: description.domain.lower,
            extent,
            width,
            wall_lower: ballistic.lower,
            wall_upper: ballistic.upper,
            fall: ballistic.gravity.map(|gravity| gravity * ballistic.dt),
            dt: ballistic.dt,
            unit: scales::velocity_unit(&description.normalization),
            slowest,
            fastest,
            sides: description.domain.lower[0] + description.domain.upper[0],
            even: if warm_up > 1 { unroll as f32 / (warm_up - 1) as f32 } else { 0.0 },
        };
        let device_plan = List::of(&**device, &[plan])?;
        Ok(Self { plan, device_plan, nodes, carried, _lists: lists.kept })
    }
}
