//! What is remembered of a stream, and where its lists are in the scratch memory of a step.

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

use eddy_frames::Domain;
use eddy_inference::{
    checkpoint::Rules,
    engine::{Ballistic, StreamStart},
    kernels::{
        nodes::map_extent,
        rest_shape::{self, WeightedNeighbour},
    },
    ops::rules::{AREA_MARGIN, bodies},
};

use super::{
    lattice::{DeviceLattices, LatticeSize},
    layout::Constants,
};
use crate::{
    device::{Device, List, Pointer, Queue, count},
    error::Result,
    kernels::{
        particle::nodes::{CHUNK, Link, Neighbour, Stream},
        round_up,
    },
    streams::{Body, StreamMemory},
};

/// Numbers that parts of a memory begin at multiples of.
const LINE: usize = 32;

/// What does not change in a network's streams.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scales {
    /// Levels of the grid.
    pub(super) levels: usize,
    /// Width of a cell (domain lengths).
    pub(super) width: f32,
    /// Unit of velocities (domain lengths per second).
    pub(super) unit: f32,
    /// Smallest and largest velocities that are predicted (domain lengths per second).
    pub(super) speeds: [[f32; 2]; 2],
    /// The rules that are on.
    pub(super) rules: Rules,
    /// Distance between particles at rest (domain lengths).
    pub(super) spacing: f32,
}

impl Scales {
    /// Width of a cell of the area rule's grid (domain lengths), if the rule is on.
    pub(super) fn area_width(&self) -> Option<f32> {
        self.rules.area.map(|rule| rule.cell_width * self.spacing)
    }
}

/// Numbers of particles and of the map's cells of a stream: what its memory depends on.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Size {
    pub(super) particles: usize,
    /// Levels of the grid.
    levels: usize,
    /// Columns and rows of the map of level 0.
    pub(super) extent: [usize; 2],
    /// Columns and rows of nodes of the area rule's grid; none where the rule is off.
    pub(super) area: [usize; 2],
    /// The rules that are on.
    rules: Rules,
    /// None where the rule `elastic` is off.
    pub(super) lattices: LatticeSize,
}

impl Size {
    /// Of a stream in a domain.
    pub(super) fn new(
        particles: usize,
        lattices: LatticeSize,
        domain: &Domain,
        scales: &Scales,
    ) -> Self {
        let cells = cells_across(domain, scales.width);
        let extent = map_extent(cells, scales.levels);
        let area = scales.area_width().map_or([0; 2], |width| {
            cells_across(domain, width).map(|cells| cells.ceil() as usize + 2 * AREA_MARGIN)
        });
        Self { particles, levels: scales.levels, extent, area, rules: scales.rules, lattices }
    }

    /// Parts of the map of level 0 that the running sums are made of.
    pub(super) fn chunks(&self) -> usize {
        self.entries(0).div_ceil(CHUNK)
    }

    /// Nodes of the area rule's grid.
    pub(super) fn area_nodes(&self) -> usize {
        self.area[0] * self.area[1]
    }

    /// Cells of the map of level 0.
    pub(super) fn cells(&self) -> usize {
        self.entries(0)
    }

    fn entries(&self, level: usize) -> usize {
        (self.extent[0] >> level) * (self.extent[1] >> level)
    }

    /// The most nodes of a level, if there is one: each particle touches nine, and four of the coarser ones.
    pub(super) fn nodes(&self, level: usize) -> usize {
        if level >= self.levels {
            return 0;
        }
        let touched = if level == 0 { 9 } else { 4 };
        self.particles.saturating_mul(touched).min(self.entries(level))
    }

    /// Numbers that are zero between two steps.
    pub(super) fn zeros(&self) -> usize {
        let mut row = bytemuck::Zeroable::zeroed();
        self.place_zeros(Pointer::NULL, &mut row)
    }

    fn place_zeros(&self, from: Pointer<u32>, row: &mut Stream) -> usize {
        let mut places = Places { from, length: 0 };
        row.counts = places.next(self.entries(0));
        for (level, marks) in row.marks[..self.levels].iter_mut().enumerate() {
            *marks = places.next(self.entries(level));
        }
        row.fill = places.next(2 * self.area_nodes());
        places.length
    }

    /// Numbers of scratch memory.
    pub(super) fn scratch(&self, constants: &Constants) -> usize {
        let mut row = bytemuck::Zeroable::zeroed();
        self.place_scratch(constants, Pointer::NULL, &mut row)
    }

    fn place_scratch(&self, constants: &Constants, from: Pointer<u32>, row: &mut Stream) -> usize {
        let mut places = Places { from, length: 0 };
        let n = self.particles;
        row.starts = places.next(self.entries(0) + 1);
        for (level, map) in row.maps[..self.levels].iter_mut().enumerate() {
            *map = places.next(self.entries(level));
        }
        for (level, list) in row.lists[..self.levels].iter_mut().enumerate() {
            *list = places.next(self.nodes(level));
        }
        row.totals = places.next(self.levels + 1);
        row.chunks = places.next((1 + self.levels) * self.chunks());
        row.bodies = places.next(n);
        for list in [&mut row.cells, &mut row.arrivals, &mut row.unsorted, &mut row.order] {
            *list = places.next(n);
        }
        row.weights = places.next(6 * n);
        row.features = places.next(constants.feature_columns() * n);
        row.encoded = places.next(constants.encoded_columns() * n);
        for (field, &(level, width)) in row.fields.iter_mut().zip(&constants.lists) {
            *field = places.next(width * self.nodes(level));
        }
        row.next = places.next(n);
        row.excess = places.next(2 * self.area_nodes());
        row.pressure = places.next(self.area_nodes());
        for (list, numbers) in row.scratch.iter_mut().zip(self.rules.device_numbers()) {
            if numbers > 0 {
                *list = places.next(numbers * n);
            }
        }
        if self.rules.need_bodies() {
            let nodes = self.nodes(0);
            row.parents = places.next(nodes);
            row.numbers = places.next(nodes);
            // Each has at least the nodes of one stencil.
            row.body_sums = places.next(nodes.div_ceil(9) * bodies::DEVICE_NUMBERS / 2);
        }
        let LatticeSize { nodes, forces, .. } = self.lattices;
        if nodes > 0 {
            row.residuals = places.next(n);
            row.lattice_nodes = places.next(2 * nodes);
            row.lattice_forces = places.next(forces);
        }
        places.length
    }
}

/// The size of a domain (cells).
pub(super) fn cells_across(domain: &Domain, width: f32) -> [f32; 2] {
    [0, 1].map(|axis| (domain.upper[axis] - domain.lower[axis]) / width)
}

/// Parts of a memory one behind the other.
struct Places {
    from: Pointer<u32>,
    /// In numbers of 4 bytes.
    length: usize,
}

impl Places {
    fn next<T>(&mut self, items: usize) -> Pointer<T> {
        let at = self.from.plus(self.length);
        self.length += round_up((items * size_of::<T>()).div_ceil(4), LINE);
        at.cast()
    }
}

/// What does not change in a stream: materials, rest shape and stiffness.
struct Fixed {
    list: List<u32>,
    /// Where the links of each particle begin, and the links; nowhere if no particle has a rest shape.
    first: Pointer<u32>,
    links: Pointer<Link>,
    neighbours: Pointer<Neighbour>,
    /// The feature of the stiffness; 0 where the network is not conditioned on it.
    stiffness: f32,
    /// None where the rule `elastic` is off, or there is no jelly.
    lattices: Option<DeviceLattices>,
}

/// What is remembered of a stream.
pub struct Memory {
    device: Arc<dyn Device>,
    fixed: Arc<Fixed>,
    /// The core's outputs and cells, the velocities that the ballistic step expects, and what the lattices expect.
    list: List<f32>,
    particles: usize,
    /// Whether a frame was observed.
    begun: AtomicBool,
}

impl Memory {
    pub(super) fn new(
        device: Arc<dyn Device>,
        constants: &Constants,
        stream: &StreamStart<'_>,
    ) -> Result<Self> {
        let particles = stream.material.len();
        let states = constants.states() * particles * constants.hidden_columns();
        let fixed = Arc::new(Fixed::new(&*device, stream)?);
        let LatticeSize { bodies, nodes, .. } = fixed.lattice_size();
        let expected = 2 * nodes + bodies;
        let list = List::new(&*device, states + 2 * particles + expected)?;
        Ok(Self { device, fixed, list, particles, begun: AtomicBool::new(false) })
    }

    pub(super) fn particles(&self) -> usize {
        self.particles
    }

    /// The size of its lattices.
    pub(super) fn lattices(&self) -> LatticeSize {
        self.fixed.lattice_size()
    }

    /// That the coming frame is not the first.
    pub(super) fn begin(&self) {
        self.begun.store(true, Ordering::Relaxed);
    }

    /// The stream in a step: its frame's domain and ballistic step; where its frame and its prediction are in the memory of the
    /// host, and its parts of the scratch memory, which are then moved on.
    pub(super) fn row(
        &self,
        constants: &Constants,
        scales: &Scales,
        domain: &Domain,
        ballistic: &Ballistic,
        host: [Pointer<Body>; 2],
        [zeros, scratch]: [&mut Pointer<u32>; 2],
    ) -> Stream {
        let size = Size::new(self.particles, self.lattices(), domain, scales);
        let own = self.fixed.lattices.as_ref();
        let (lattices, body_of) = own.map(DeviceLattices::pointers).unwrap_or_default();
        let mut row: Stream = bytemuck::Zeroable::zeroed();
        *zeros = zeros.plus(size.place_zeros(*zeros, &mut row));
        *scratch = scratch.plus(size.place_scratch(constants, *scratch, &mut row));
        let states = constants.states() * self.particles * constants.hidden_columns();
        let Scales { width, unit, speeds, .. } = *scales;
        let Ballistic { gravity, dt, lower, upper } = *ballistic;
        let area_width = scales.area_width().unwrap_or(1.0);
        let area_walls = [0, 1].map(|axis| {
            [lower, upper]
                .map(|wall| (wall[axis] - domain.lower[axis]) / area_width + AREA_MARGIN as f32)
        });
        let area_inside = [0, 1].map(|axis| {
            let [low, high] = area_walls[axis];
            // Nodes have neighbours on all sides.
            let most = (size.area[axis] as i32 - 1).max(1);
            let first = (low.ceil() as i32).clamp(1, most);
            [first, (high.floor() as i32 + 1).clamp(first, most)]
        });
        let hidden = self.list.pointer();
        let expected = hidden.plus(states);
        let lattice_places = expected.plus(2 * self.particles);
        let [slowest, fastest] = speeds;
        Stream {
            hidden,
            expected,
            lattice_places,
            lattice_errors: lattice_places.plus(2 * size.lattices.nodes),
            first: self.fixed.first,
            links: self.fixed.links,
            neighbours: self.fixed.neighbours,
            material: self.fixed.list.pointer().cast(),
            observed: host[0],
            predicted: host[1],
            particles: count(self.particles),
            begun: u32::from(self.begun.load(Ordering::Relaxed)),
            across: size.extent.map(count),
            lower: domain.lower,
            extent: cells_across(domain, width),
            width,
            wall_lower: lower,
            wall_upper: upper,
            fall: gravity.map(|g| g * dt),
            dt,
            unit,
            slowest,
            fastest,
            area_extent: size.area.map(count),
            area_inside,
            area_walls,
            stiffness: self.fixed.stiffness,
            lattices,
            lattice_count: count(size.lattices.bodies),
            body_of,
            ..row
        }
    }
}

impl StreamMemory for Memory {
    fn clear(&self) -> Result<()> {
        self.begun.store(false, Ordering::Relaxed);
        self.device.clear(Queue::Main, &self.list)
    }

    /// Outputs and cells, what is expected, and whether a frame was observed.
    fn numbers(&self) -> Result<Vec<f32>> {
        let mut numbers = vec![0f32; self.list.bytes() / 4];
        self.device.read(&self.list, 0, bytemuck::cast_slice_mut(&mut numbers))?;
        numbers.push(f32::from(u8::from(self.begun.load(Ordering::Relaxed))));
        Ok(numbers)
    }

    fn copy_from(&self, other: &Self) -> Result<()> {
        self.begun.store(other.begun.load(Ordering::Relaxed), Ordering::Relaxed);
        self.device.copy(&self.list, &other.list)
    }

    fn resembles(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.fixed, &other.fixed)
    }

    fn duplicate(&self) -> Result<Self> {
        let copy = Self {
            device: Arc::clone(&self.device),
            fixed: Arc::clone(&self.fixed),
            list: List::new(&*self.device, self.list.bytes() / 4)?,
            particles: self.particles,
            begun: AtomicBool::new(false),
        };
        copy.copy_from(self)?;
        Ok(copy)
    }
}

impl From<&rest_shape::Link> for Link {
    fn from(&rest_shape::Link { particle, coefficient, share }: &rest_shape::Link) -> Self {
        Self { particle, coefficient, share }
    }
}

impl Fixed {
    fn new(device: &dyn Device, stream: &StreamStart<'_>) -> Result<Self> {
        let StreamStart { material, rest, lattices, stiffness, .. } = *stream;
        let mut numbers: Vec<u32> = vec![0; round_up(material.len().div_ceil(4), LINE)];
        bytemuck::cast_slice_mut(&mut numbers)[..material.len()].copy_from_slice(material);
        let mut places = [0; 3];
        if !rest.is_shapeless() {
            places[0] = numbers.len();
            let mut count = 0;
            numbers.push(0);
            for particle in 0..material.len() {
                count += rest.links(particle).len() as u32;
                numbers.push(count);
            }
            numbers.resize(round_up(numbers.len(), LINE), 0);
            places[1] = numbers.len();
            for link in (0..material.len()).flat_map(|particle| rest.links(particle)) {
                numbers.extend_from_slice(bytemuck::cast_slice(&[Link::from(link)]));
            }
            numbers.resize(round_up(numbers.len(), LINE), 0);
            places[2] = numbers.len();
            for particle in 0..material.len() {
                let pairs = rest.neighbours(particle).iter().zip(rest.offsets(particle));
                for (&WeightedNeighbour { particle, share }, &offset) in pairs {
                    let neighbour = Neighbour { particle, share, offset };
                    numbers.extend_from_slice(bytemuck::cast_slice(&[neighbour]));
                }
            }
        }
        let list = List::of(device, &numbers)?;
        let at = |place: usize| match place {
            0 => Pointer::NULL,
            place => list.pointer().plus(place),
        };
        let [first, links, neighbours] = places.map(at);
        Ok(Self {
            first,
            links: links.cast(),
            neighbours: neighbours.cast(),
            stiffness: stiffness.unwrap_or_default(),
            lattices: DeviceLattices::new(device, lattices)?,
            list,
        })
    }

    fn lattice_size(&self) -> LatticeSize {
        self.lattices.as_ref().map(|lattices| lattices.size).unwrap_or_default()
    }
}
