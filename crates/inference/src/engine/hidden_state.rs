//! What a network remembers of a stream.

use std::sync::Arc;

use super::{DeviceState, order::spatial_order, scales::stiffness_feature, stepper::Network};
use crate::{
    checkpoint::{Core, Description, GridOptions},
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
    /// Particle model: the particle in each row, sorted by place in the stream's first frame. Empty in the frame model, which
    /// keeps the order of the input.
    pub(super) order: Arc<Vec<u32>>,
    /// The material number of each row's particle, `[N]`.
    pub(super) material: Vec<u8>,
    /// Particle model: the rest shape of jelly and rope, taken from the stream's first frame. Empty in the frame model.
    pub(super) rest: Arc<RestShape>,
    /// The lattices of its jelly, if the rule `elastic` is on; else empty.
    pub(super) lattices: Arc<Lattices>,
    /// What they expect of the coming frame.
    pub(super) expected_nodes: Expected,
    /// The feature of the stream's stiffness, if the network is conditioned on it.
    pub(super) stiffness: Option<f32>,
    /// The network with the weights for that stiffness, if those of the surrogate depend on it.
    pub(super) network: Option<Arc<Network>>,
    /// Last outputs of the core, `[layer, R, H]`. R is 1 in the frame model and N in the particle model, whose rows are
    /// [`stride`] long. Zero before the first frame.
    pub(super) hidden: Vec<f32>,
    /// Cells of an LSTM, of the same shape; empty for other cores.
    pub(super) cell: Vec<f32>,
    /// Particle model: the velocities that the ballistic step expects in the coming frame, `[N, 2]`. Empty in the frame
    /// model.
    pub(super) expected_velocity: Vec<[f32; 2]>,
    /// Whether a frame was observed.
    pub(super) begun: bool,
    /// The state on the device that predicts; then `hidden` and `cell` are empty.
    pub(super) device: Option<Box<dyn DeviceState>>,
}

impl HiddenState {
    /// The state for the particles of `frame` before the first observed frame, in a stream of this stiffness (density x velocity^2), if the
    /// network is conditioned on it.
    pub(super) fn new(description: &Description, frame: &Frame, stiffness: Option<f32>) -> Self {
        let particles = frame.len();
        let mut material: Vec<_> = frame.material.iter().map(|&kind| kind as u8).collect();
        let mut order = Vec::new();
        // Built before reordering: the choice among equally distant neighbours must not depend on the order.
        let (mut rest, mut lattices) = rest(description, frame, stiffness);
        if let Some(&GridOptions { cell_width, .. }) = description.grid.as_ref() {
            order = spatial_order(frame, cell_width);
            (rest, lattices) = (rest.permuted(&order), lattices.permuted(&order));
            material = order.iter().map(|&row| frame.material[row as usize] as u8).collect();
        }
        let hidden = description.sizes.hidden;
        let (numbers, expected_velocity) = match description.sizes.particles {
            Some(_) => (hidden, 0),
            None => (particles * stride(hidden), particles),
        };
        let states = description.sizes.layers * numbers;
        let cells = if description.core == Core::Lstm { states } else { 0 };
        Self {
            order: Arc::new(order),
            material,
            rest: Arc::new(rest),
            expected_nodes: lattices.expected(),
            lattices: Arc::new(lattices),
            stiffness: stiffness.map(stiffness_feature),
            network: None,
            hidden: vec![0.0; states],
            cell: vec![0.0; cells],
            expected_velocity: vec![[0.0; 2]; expected_velocity],
            begun: false,
            device: None,
        }
    }

    /// The state of a stream on a device.
    pub(super) fn on_device(material: Vec<u8>, device: Box<dyn DeviceState>) -> Self {
        Self {
            order: Arc::default(),
            material,
            rest: Arc::default(),
            lattices: Arc::default(),
            expected_nodes: Expected::default(),
            stiffness: None,
            network: None,
            hidden: Vec::new(),
            cell: Vec::new(),
            expected_velocity: Vec::new(),
            begun: false,
            device: Some(device),
        }
    }

    /// Number of particles.
    pub fn particles(&self) -> usize {
        self.material.len()
    }

    /// Forgets the observed frames, but keeps the rest shape of solids: for a stream that was interrupted.
    pub fn forget(&mut self) {
        self.hidden.fill(0.0);
        self.cell.fill(0.0);
        self.expected_velocity.fill([0.0; 2]);
        self.expected_nodes.forget();
        self.begun = false;
        if let Some(device) = &mut self.device {
            device.forget();
        }
    }
}

impl Clone for HiddenState {
    fn clone(&self) -> Self {
        Self {
            order: Arc::clone(&self.order),
            material: self.material.clone(),
            rest: Arc::clone(&self.rest),
            lattices: Arc::clone(&self.lattices),
            expected_nodes: self.expected_nodes.clone(),
            stiffness: self.stiffness,
            network: self.network.clone(),
            hidden: self.hidden.clone(),
            cell: self.cell.clone(),
            expected_velocity: self.expected_velocity.clone(),
            begun: self.begun,
            device: self.device.as_ref().map(|device| device.duplicate()),
        }
    }

    fn clone_from(&mut self, other: &Self) {
        let Self {
            order,
            material,
            rest,
            lattices,
            expected_nodes,
            stiffness,
            network,
            hidden,
            cell,
            expected_velocity,
            begun,
            device,
        } = self;
        *order = Arc::clone(&other.order);
        material.clone_from(&other.material);
        *rest = Arc::clone(&other.rest);
        *lattices = Arc::clone(&other.lattices);
        expected_nodes.clone_from(&other.expected_nodes);
        *stiffness = other.stiffness;
        network.clone_from(&other.network);
        hidden.clone_from(&other.hidden);
        cell.clone_from(&other.cell);
        expected_velocity.clone_from(&other.expected_velocity);
        *begun = other.begun;
        match (device, &other.device) {
            (Some(device), Some(other)) => device.copy_from(&**other),
            (device, other) => *device = other.as_ref().map(|other| other.duplicate()),
        }
    }
}

impl PartialEq for HiddenState {
    fn eq(&self, other: &Self) -> bool {
        let Self {
            order,
            material,
            rest,
            // Determined by the rest shape.
            lattices: _,
            expected_nodes,
            stiffness,
            // That of the stiffness.
            network: _,
            hidden,
            cell,
            expected_velocity,
            begun,
            device,
        } = self;
        (order, material, rest, stiffness)
            == (&other.order, &other.material, &other.rest, &other.stiffness)
            && (hidden, cell, expected_velocity, expected_nodes)
                == (&other.hidden, &other.cell, &other.expected_velocity, &other.expected_nodes)
            && *begun == other.begun
            && device.as_deref() == other.device.as_deref()
    }
}
