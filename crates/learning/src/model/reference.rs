//! A checkpoint that predicts frame by frame with its network in burn, followed by its rules.
//!
//! The streaming engine of `eddy-inference` is compared with it in tests and in `eddy-lab bench inference`.

use std::sync::Arc;

use burn::tensor::{Tensor, TensorData};

use super::{
    DeviceKind,
    described::Model,
    dropout::Dropout,
    network::Network,
    state::{ParticleState, RecurrentState, StaticInputs, pairs},
};
use eddy_frames::Frame;
use eddy_inference::{
    checkpoint::{Checkpoint, CheckpointError, Description},
    engine::{self, Corrector},
    kernels::lattice::{Expected, Lattices},
};

/// A checkpoint's network in burn.
pub struct Reference {
    network: Network,
    corrector: Corrector,
    device: DeviceKind,
    description: Description,
}

/// The hidden state of one stream.
#[derive(Clone)]
pub struct HiddenState {
    recurrent: RecurrentState,
    fixed: Arc<StaticInputs>,
    lattices: Lattices,
    expected_nodes: Expected,
}

impl Reference {
    /// Loads the checkpoint's network on a device.
    ///
    /// # Errors
    /// [`CheckpointError`] if the weights do not match the description.
    pub fn load(checkpoint: &Checkpoint, device: DeviceKind) -> Result<Self, CheckpointError> {
        checkpoint.check("checkpoint".as_ref())?;
        let model = Model::new(&checkpoint.description);
        let weights = Arc::new(model.plan.in_order(&checkpoint.tensors));
        let network = Network::new(&model, &weights, &device.device());
        let corrector = Corrector::new(&checkpoint.description);
        Ok(Self { network, corrector, device, description: checkpoint.description.clone() })
    }

    /// The hidden state of a stream that begins with `frame`, before any frame is observed: `frame` itself is to be passed to
    /// [`Reference::step`] first. Its shape is taken as the rest shape of solids. `stiffness` is that of the stream (density x
    /// velocity^2), for a network that is conditioned on it.
    ///
    /// # Panics
    /// Without a stiffness that the network is conditioned on, or with one that it does not use.
    pub fn start(&self, frame: &Frame, stiffness: Option<f32>) -> HiddenState {
        assert_eq!(
            stiffness.is_some(),
            self.description.stiffness,
            "a stiffness for a network that is conditioned on it"
        );
        let Frame { material, position, .. } = frame;
        let grid = self.description.grid.as_ref();
        let each = stiffness.as_ref().map(std::slice::from_ref);
        let fixed = StaticInputs::new(material, position, 1, each, grid);
        let rows = (&fixed.rest, 0..position.len());
        let lattices = engine::lattices(&self.description, rows, position, material, stiffness);
        let expected_nodes = lattices.expected();
        HiddenState { recurrent: RecurrentState::default(), fixed, lattices, expected_nodes }
    }

    /// Observes a frame, true or predicted, of the particles that `hidden` was started for, and predicts the next one: its
    /// sequence is one higher, its stamp `dt` later.
    pub fn step(&self, hidden: &mut HiddenState, frame: &Frame) -> Frame {
        let device = self.device.device();
        let rows = |values: &[[f32; 2]]| {
            let data = TensorData::new(values.as_flattened().to_vec(), [values.len(), 2]);
            Tensor::<2>::from_data(data, &device)
        };
        let state =
            ParticleState { position: rows(&frame.position), velocity: rows(&frame.velocity) };
        let recurrent = std::mem::take(&mut hidden.recurrent);
        let (next, recurrent) =
            self.network.step(&state, &hidden.fixed, recurrent, &mut Dropout::none());
        hidden.recurrent = recurrent;
        let mut next = Frame {
            stream: frame.stream,
            sequence: frame.sequence + 1,
            stamp: frame.stamp.advance(self.description.dt, 1),
            dt: frame.dt,
            domain: frame.domain,
            position: pairs(next.position),
            velocity: pairs(next.velocity),
            material: frame.material.clone(),
        };
        let HiddenState { fixed, lattices, expected_nodes, .. } = hidden;
        self.corrector.correct((&fixed.rest, lattices, expected_nodes), frame, &mut next);
        next
    }
}
