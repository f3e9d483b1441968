//! What a network remembers of a stream.

use std::sync::Arc;

use super::{DeviceState, order::spatial_order, scales::stiffness_feature, stepper::Network};
use crate::{
    checkpoint::{Description, GridOptions},
    kernels::{
        lattice::{Expected, Lattices},
        rest_shape::RestShape,
    },
};
use eddy_frames::Frame;

/// Rows of hidden states are padded to a multiple of this length, so that most begin at a cache line.
const LINE: usize = 16;

/// Length of a row of hidden states in the particle model.
pub(super) fn stride(hidden: usize) -> usize {
    hidden.next_multiple_of(LINE)
}

/// The rest shapes and lattices of a stream of this stiffness (density x velocity^2) that begins with `frame`, in the order of its particles;
/// empty if the described network does not use them.
pub(super) fn rest(
    description: &Description,
    frame: &Frame,
    stiffness: Option<f32>,
) -> (RestShape, Lattices) {
    let Some(&GridOptions { spacing, .. }) = description.grid.as_ref() else {
        return Default::default();
    };
    let Frame { position, material, .. } = frame;
    let rest = RestShape::new(position, material, 1, spacing);
    let lattices =
        super::lattices(description, (&rest, 0..position.len()), position, material, stiffness);
    (rest, lattices)
}

/// The hidden state of one stream.
///
/// `clone_from` copies into a state of the same network and number of particles without allocating, as a look-ahead does
/// every frame.
#[derive(Debug)]
pub struct HiddenState {
    particles: usize,
    /// The network with the weights for the stream's stiffness, if those of the surrogate depend on it.
    pub(super) network: Option<Arc<Network>>,
    pub(super) memory: Memory,
}

/// What each kind of network remembers.
#[derive(Debug)]
pub(super) enum Memory {
    Frame(FrameMemory),
    Particle(Box<ParticleMemory>),
    Device(Box<dyn DeviceState>),
}

/// What the frame model remembers: one state for all particles.
#[derive(Debug, PartialEq)]
pub(super) struct FrameMemory {
    /// The material number of each particle, `[N]`.
    pub(super) material: Arc<[u8]>,
    /// Last outputs of the core, `[layer, H]`. Zero before the first frame.
    pub(super) hidden: Vec<f32>,
    /// Cells of an LSTM, of the same shape; empty for other cores.
    pub(super) cell: Vec<f32>,
}

/// What the particle model remembers: a state for each particle.
#[derive(Debug, PartialEq)]
pub(super) struct ParticleMemory {
    pub(super) stream: Arc<StreamParticles>,
    /// What the lattices expect of the coming frame.
    pub(super) expected_nodes: Expected,
    /// Last outputs of the core, `[layer, N, H]`; rows are [`stride`] long. Zero before the first frame.
    pub(super) hidden: Vec<f32>,
    /// Cells of an LSTM, of the same shape; empty for other cores.
    pub(super) cell: Vec<f32>,
    /// The velocities that the ballistic step expects in the coming frame, `[N, 2]`.
    pub(super) expected_velocity: Vec<[f32; 2]>,
    /// Whether a frame was observed.
    pub(super) begun: bool,
}

/// What the particle model takes from the first frame of a stream, which never changes.
#[derive(Debug)]
pub(super) struct StreamParticles {
    /// The particle in each row, sorted by place.
    pub(super) order: Vec<u32>,
    /// The material number of each row's particle, `[N]`.
    pub(super) material: Vec<u8>,
    /// The rest shape of jelly and rope.
    pub(super) rest: RestShape,
    /// The lattices of its jelly, if the rule `elastic` is on; else empty.
    pub(super) lattices: Lattices,
    /// The feature of the stream's stiffness, if the network is conditioned on it.
    pub(super) stiffness: Option<f32>,
}

impl HiddenState {
    /// The state for the particles of `frame` before the first observed frame, in a stream of this stiffness (density x velocity^2), if the
    /// network is conditioned on it.
    pub(super) fn new(description: &Description, frame: &Frame, stiffness: Option<f32>) -> Self {
        let memory = match &description.grid {
            None => Memory::Frame(FrameMemory::new(description, frame)),
            Some(grid) => {
                Memory::Particle(Box::new(ParticleMemory::new(description, grid, frame, stiffness)))
            }
        };
        Self { particles: frame.len(), network: None, memory }
    }

    /// The state of a stream of so many particles on a device.
    pub(super) fn on_device(particles: usize, device: Box<dyn DeviceState>) -> Self {
        Self { particles, network: None, memory: Memory::Device(device) }
    }

    /// Number of particles.
    pub fn particles(&self) -> usize {
        self.particles
    }

    /// Forgets the observed frames, but keeps the rest shape of solids: for a stream that was interrupted.
    pub fn forget(&mut self) {
        match &mut self.memory {
            Memory::Frame(FrameMemory { material: _, hidden, cell }) => {
                hidden.fill(0.0);
                cell.fill(0.0);
            }
            Memory::Particle(memory) => {
                memory.hidden.fill(0.0);
                memory.cell.fill(0.0);
                memory.expected_velocity.fill([0.0; 2]);
                memory.expected_nodes.forget();
                memory.begun = false;
            }
            Memory::Device(device) => device.forget(),
        }
    }
}

/// Lengths of hidden states and cells of a core with rows of so many numbers in each layer.
fn lengths(description: &Description, row: usize) -> [usize; 2] {
    let states = description.sizes.layers * row;
    [states, (description.core.states() - 1) * states]
}

impl FrameMemory {
    fn new(description: &Description, frame: &Frame) -> Self {
        let [hidden, cell] = lengths(description, description.sizes.hidden).map(|n| vec![0.0; n]);
        Self { material: frame.material.iter().map(|&kind| kind as u8).collect(), hidden, cell }
    }
}

impl ParticleMemory {
    fn new(
        description: &Description,
        &GridOptions { cell_width, .. }: &GridOptions,
        frame: &Frame,
        stiffness: Option<f32>,
    ) -> Self {
        // Built before reordering: the choice among equally distant neighbours must not depend on the order.
        let (rest, lattices) = rest(description, frame, stiffness);
        let order = spatial_order(frame, cell_width);
        let (rest, lattices) = (rest.permuted(&order), lattices.permuted(&order));
        let row = frame.len() * stride(description.sizes.hidden);
        let [hidden, cell] = lengths(description, row).map(|n| vec![0.0; n]);
        Self {
            expected_nodes: lattices.expected(),
            stream: Arc::new(StreamParticles {
                material: order.iter().map(|&row| frame.material[row as usize] as u8).collect(),
                order,
                rest,
                lattices,
                stiffness: stiffness.map(stiffness_feature),
            }),
            hidden,
            cell,
            expected_velocity: vec![[0.0; 2]; frame.len()],
            begun: false,
        }
    }
}

impl Clone for HiddenState {
    fn clone(&self) -> Self {
        let Self { particles, network, memory } = self;
        Self { particles: *particles, network: network.clone(), memory: memory.clone() }
    }

    fn clone_from(&mut self, other: &Self) {
        let Self { particles, network, memory } = self;
        *particles = other.particles;
        network.clone_from(&other.network);
        memory.clone_from(&other.memory);
    }
}

impl Clone for Memory {
    fn clone(&self) -> Self {
        match self {
            Self::Frame(memory) => Self::Frame(memory.clone()),
            Self::Particle(memory) => Self::Particle(memory.clone()),
            Self::Device(device) => Self::Device(device.duplicate()),
        }
    }

    fn clone_from(&mut self, other: &Self) {
        match (self, other) {
            (Self::Frame(memory), Self::Frame(other)) => memory.clone_from(other),
            (Self::Particle(memory), Self::Particle(other)) => memory.clone_from(other),
            (Self::Device(device), Self::Device(other)) => device.copy_from(&**other),
            (memory, other) => *memory = other.clone(),
        }
    }
}

impl Clone for FrameMemory {
    fn clone(&self) -> Self {
        let Self { material, hidden, cell } = self;
        Self { material: Arc::clone(material), hidden: hidden.clone(), cell: cell.clone() }
    }

    fn clone_from(&mut self, other: &Self) {
        let Self { material, hidden, cell } = self;
        *material = Arc::clone(&other.material);
        hidden.clone_from(&other.hidden);
        cell.clone_from(&other.cell);
    }
}

impl Clone for ParticleMemory {
    fn clone(&self) -> Self {
        Self {
            stream: Arc::clone(&self.stream),
            expected_nodes: self.expected_nodes.clone(),
            hidden: self.hidden.clone(),
            cell: self.cell.clone(),
            expected_velocity: self.expected_velocity.clone(),
            begun: self.begun,
        }
    }

    fn clone_from(&mut self, other: &Self) {
        let Self { stream, expected_nodes, hidden, cell, expected_velocity, begun } = self;
        *stream = Arc::clone(&other.stream);
        expected_nodes.clone_from(&other.expected_nodes);
        hidden.clone_from(&other.hidden);
        cell.clone_from(&other.cell);
        expected_velocity.clone_from(&other.expected_velocity);
        *begun = other.begun;
    }
}

impl PartialEq for HiddenState {
    fn eq(&self, other: &Self) -> bool {
        // The network is that of the stiffness.
        self.particles == other.particles
            && match (&self.memory, &other.memory) {
                (Memory::Frame(memory), Memory::Frame(other)) => memory == other,
                (Memory::Particle(memory), Memory::Particle(other)) => memory == other,
                (Memory::Device(device), Memory::Device(other)) => **device == **other,
                _ => false,
            }
    }
}

impl PartialEq for StreamParticles {
    fn eq(&self, other: &Self) -> bool {
        // The lattices are determined by the rest shape.
        let Self { order, material, rest, lattices: _, stiffness } = self;
        (order, material, rest, stiffness)
            == (&other.order, &other.material, &other.rest, &other.stiffness)
    }
}
