//! What is remembered of a stream, and where its lists are in the scratch memory of a step.

#![expect(unsafe_code, reason = "a struct that the device reads")]

use std::sync::{
    Arc,
    atomic::{AtomicBool, Ordering},
};

use eddy_frames::Domain;
use eddy_inference::engine::{Ballistic, StreamStart};

use super::layout::{Constants, FIELD_LEVELS};
use crate::{
    device::{Address, Buffer, Device},
    error::Result,
    kernels::round_up,
};

/// Levels of the grid.
pub(super) const LEVELS: usize = 3;
/// Index of node 0 in the maps of level 0, `ORIGIN` of the kernels.
const ORIGIN: usize = 8;
/// Numbers that parts of a memory begin at multiples of.
const LINE: usize = 32;
/// Numbers of a body: x, y, vx, vy.
const BODY: usize = 4;

/// `struct Stream` of the kernels.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub(super) struct Row {
    hidden: u64,
    expected: u64,
    first: u64,
    links: u64,
    material: u64,
    observed: u64,
    predicted: u64,
    counts: u64,
    marks: [u64; LEVELS],
    starts: u64,
    maps: [u64; LEVELS],
    lists: [u64; LEVELS],
    totals: u64,
    bodies: u64,
    cells: u64,
    arrivals: u64,
    unsorted: u64,
    order: u64,
    places: u64,
    features: u64,
    encoded: u64,
    fields: [u64; FIELD_LEVELS.len()],
    next: u64,
    particles: u32,
    begun: u32,
    extent: [u32; 2],
    lower: [f32; 2],
    cells_across: [f32; 2],
    width: f32,
    walls: [[f32; 2]; 2],
    fall: [f32; 2],
    dt: f32,
    unit: f32,
    speeds: [[f32; 2]; 2],
    unused: u32,
}

// SAFETY: integers and numbers without padding between them: 35 of 8 bytes, then 22 of 4.
unsafe impl bytemuck::Zeroable for Row {}
// SAFETY: as above.
unsafe impl bytemuck::Pod for Row {}

/// What does not change in a network's streams.
#[derive(Clone, Copy, Debug)]
pub(super) struct Scales {
    /// Width of a cell (domain lengths).
    pub(super) width: f32,
    /// Unit of velocities (domain lengths per second).
    pub(super) unit: f32,
    /// Smallest and largest velocities that are predicted (domain lengths per second).
    pub(super) speeds: [[f32; 2]; 2],
}

/// Numbers of particles and of the map's cells of a stream: what its memory depends on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Size {
    pub(super) particles: usize,
    /// Columns and rows of the map of level 0.
    pub(super) extent: [usize; 2],
}

impl Size {
    /// Of a stream in a domain, with cells of this width (domain lengths).
    pub(super) fn new(particles: usize, domain: &Domain, width: f32) -> Self {
        let cells = cells_across(domain, width);
        // As `kernels/nodes/window.rs` of eddy-inference: the last node has a neighbour at each level.
        let extent = cells.map(|cells| ((cells.ceil() as usize + 1 + ORIGIN) / 4 + 2) * 4);
        Self { particles, extent }
    }

    fn entries(&self, level: usize) -> usize {
        (self.extent[0] >> level) * (self.extent[1] >> level)
    }

    /// The most nodes of a level: each particle touches nine, and four of the coarser ones.
    pub(super) fn nodes(&self, level: usize) -> usize {
        let touched = if level == 0 { 9 } else { 4 };
        self.particles.saturating_mul(touched).min(self.entries(level))
    }

    /// Numbers that are zero between two steps.
    pub(super) fn zeros(&self) -> usize {
        let mut row = bytemuck::Zeroable::zeroed();
        Self::place_zeros(self, Address::NULL, &mut row)
    }

    fn place_zeros(&self, from: Address, row: &mut Row) -> usize {
        let mut places = Places { from, length: 0 };
        row.counts = places.next(self.entries(0));
        row.marks = std::array::from_fn(|level| places.next(self.entries(level)));
        places.length
    }

    /// Numbers of scratch memory.
    pub(super) fn scratch(&self, constants: &Constants) -> usize {
        let mut row = bytemuck::Zeroable::zeroed();
        self.place_scratch(constants, Address::NULL, &mut row)
    }

    fn place_scratch(&self, constants: &Constants, from: Address, row: &mut Row) -> usize {
        let mut places = Places { from, length: 0 };
        let n = self.particles;
        row.starts = places.next(self.entries(0) + 1);
        row.maps = std::array::from_fn(|level| places.next(self.entries(level)));
        row.lists = std::array::from_fn(|level| places.next(self.nodes(level)));
        row.totals = places.next(LEVELS);
        row.bodies = places.next(BODY * n);
        for list in [&mut row.cells, &mut row.arrivals, &mut row.unsorted, &mut row.order] {
            *list = places.next(n);
        }
        row.places = places.next(2 * n);
        row.features = places.next(constants.feature_columns() * n);
        row.encoded = places.next(constants.encoded_columns() * n);
        let widths = constants.field_widths();
        row.fields = std::array::from_fn(|field| {
            places.next(widths[field] * self.nodes(FIELD_LEVELS[field]))
        });
        row.next = places.next(BODY * n);
        places.length
    }
}

/// The size of a domain (cells).
fn cells_across(domain: &Domain, width: f32) -> [f32; 2] {
    [0, 1].map(|axis| (domain.upper[axis] - domain.lower[axis]) / width)
}

/// Parts of a memory one behind the other.
struct Places {
    from: Address,
    length: usize,
}

impl Places {
    fn next(&mut self, numbers: usize) -> u64 {
        let at = self.from.plus(self.length);
        self.length += round_up(numbers, LINE);
        at.0
    }
}

/// What does not change in a stream: materials and rest shape.
struct Fixed {
    buffer: Buffer,
    /// Where the links of each particle begin, and the links; nowhere if no particle has a rest shape.
    first: u64,
    links: u64,
}

/// What is remembered of a stream.
pub(super) struct Memory {
    device: Arc<dyn Device>,
    fixed: Arc<Fixed>,
    /// The core's outputs and cells, and the velocities that the ballistic step expects.
    buffer: Buffer,
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
        let buffer = device.allocate(4 * (states + 2 * particles).max(1))?;
        let fixed = Arc::new(Fixed::new(&*device, stream)?);
        Ok(Self { device, fixed, buffer, particles, begun: AtomicBool::new(false) })
    }

    pub(super) fn particles(&self) -> usize {
        self.particles
    }

    /// That the coming frame is not the first.
    pub(super) fn begin(&self) {
        self.begun.store(true, Ordering::Relaxed);
    }

    pub(super) fn clear(&self) -> Result<()> {
        self.begun.store(false, Ordering::Relaxed);
        self.device.clear(crate::device::Queue::Main, &self.buffer)
    }

    /// Outputs and cells, expected velocities, and whether a frame was observed.
    pub(super) fn numbers(&self) -> Result<Vec<f32>> {
        let mut numbers = vec![0f32; self.buffer.bytes() / 4];
        self.device.read(&self.buffer, 0, bytemuck::cast_slice_mut(&mut numbers))?;
        numbers.push(f32::from(u8::from(self.begun.load(Ordering::Relaxed))));
        Ok(numbers)
    }

    pub(super) fn copy_from(&self, other: &Self) -> Result<()> {
        self.begun.store(other.begun.load(Ordering::Relaxed), Ordering::Relaxed);
        self.device.copy(&self.buffer, &other.buffer)
    }

    /// Whether this state can become a copy of the other one in place.
    pub(super) fn resembles(&self, other: &Self) -> bool {
        Arc::ptr_eq(&self.fixed, &other.fixed)
    }

    pub(super) fn duplicate(&self) -> Result<Self> {
        let copy = Self {
            device: Arc::clone(&self.device),
            fixed: Arc::clone(&self.fixed),
            buffer: self.device.allocate(self.buffer.bytes())?,
            particles: self.particles,
            begun: AtomicBool::new(false),
        };
        copy.copy_from(self)?;
        Ok(copy)
    }

    /// The stream in a step: its frame's domain and ballistic step; where its frame and its prediction are in the memory of the
    /// host, and its parts of the scratch memory, which are then moved on.
    pub(super) fn row(
        &self,
        constants: &Constants,
        scales: &Scales,
        domain: &Domain,
        ballistic: &Ballistic,
        host: [Address; 2],
        [zeros, scratch]: [&mut Address; 2],
    ) -> Row {
        let size = Size::new(self.particles, domain, scales.width);
        let mut row: Row = bytemuck::Zeroable::zeroed();
        *zeros = zeros.plus(size.place_zeros(*zeros, &mut row));
        *scratch = scratch.plus(size.place_scratch(constants, *scratch, &mut row));
        let states = constants.states() * self.particles * constants.hidden_columns();
        let Scales { width, unit, speeds } = *scales;
        let Ballistic { gravity, dt, lower, upper } = *ballistic;
        Row {
            hidden: self.buffer.address().0,
            expected: self.buffer.address().plus(states).0,
            first: self.fixed.first,
            links: self.fixed.links,
            material: self.fixed.buffer.address().0,
            observed: host[0].0,
            predicted: host[1].0,
            particles: self.particles as u32,
            begun: u32::from(self.begun.load(Ordering::Relaxed)),
            extent: size.extent.map(|cells| cells as u32),
            lower: domain.lower,
            cells_across: cells_across(domain, width),
            width,
            walls: [lower, upper],
            fall: gravity.map(|g| g * dt),
            dt,
            unit,
            speeds,
            ..row
        }
    }
}

impl Fixed {
    fn new(device: &dyn Device, stream: &StreamStart<'_>) -> Result<Self> {
        let StreamStart { material, rest, .. } = stream;
        let mut numbers: Vec<u32> = vec![0; round_up(material.len().div_ceil(4), LINE)];
        bytemuck::cast_slice_mut(&mut numbers)[..material.len()].copy_from_slice(material);
        let mut places = [0; 2];
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
                let [x, y] = link.coefficient.map(f32::to_bits);
                numbers.extend([link.particle, x, y, link.share.to_bits()]);
            }
        }
        let buffer = device.allocate(4 * numbers.len().max(1))?;
        device.write(&buffer, 0, bytemuck::cast_slice(&numbers))?;
        let at = |place: usize| match place {
            0 => 0,
            place => buffer.address().plus(place).0,
        };
        Ok(Self { first: at(places[0]), links: at(places[1]), buffer })
    }
}
