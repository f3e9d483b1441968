//! A checkpoint that predicts frames, one after the other: its network with the operations that trained it, then its
//! rules.
//!
//! What streams is the layer `engine`; this is what it is held against, in tests and in
//! `eddy bench inference`.

use burn::tensor::{Tensor, TensorData};

use super::{
    Bodies, DeviceKind, Matter,
    network::{Dropout, Hidden, Network},
    pairs,
};
use eddy_frames::Frame;
use eddy_inference::{
    checkpoint::{Checkpoint, CheckpointError, Description, GridOptions},
    engine::Corrector,
};

/// A network in burn, ready to predict.
pub struct Reference {
    network: Network,
    /// The checkpoint's rules.
    corrector: Corrector,
    device: DeviceKind,
    grid: Option<GridOptions>,
    /// Time between two frames (s).
    dt: f32,
}

/// The hidden state of one stream: what the network remembers of the frames it observed.
#[derive(Clone)]
pub struct HiddenState {
    hidden: Hidden,
    matter: Matter,
}

impl Reference {
    /// Puts the checkpoint's network on a device.
    ///
    /// # Errors
    /// [`CheckpointError`] when the weights do not fit the description.
    pub fn load(checkpoint: &Checkpoint, device: DeviceKind) -> Result<Self, CheckpointError> {
        checkpoint.check("checkpoint".as_ref())?;
        let network = Network::new(&checkpoint.description, &checkpoint.tensors, &device.device());
        let corrector = Corrector::new(&checkpoint.description);
        let Description { grid, dt, .. } = checkpoint.description;
        Ok(Self { network, corrector, device, grid, dt })
    }

    /// An empty memory for the particles of `frame`, as many as the network is for; solids are taken to
    /// rest as they are there. It has not observed
    /// `frame`; that is [`Reference::step`]'s part.
    pub fn start(&self, frame: &Frame) -> HiddenState {
        let grid = self.grid.as_ref();
        let device = self.device.device();
        let matter = Matter::new(&frame.material, &frame.position, 1, grid, &device);
        HiddenState { hidden: Hidden::default(), matter }
    }

    /// Observes a frame, true or predicted, of the particles the memory was started for, and
    /// predicts the next one: its sequence one higher, its stamp `dt` later.
    pub fn step(&self, memory: &mut HiddenState, frame: &Frame) -> Frame {
        let device = self.device.device();
        let rows = |values: &[[f32; 2]]| {
            let data = TensorData::new(values.as_flattened().to_vec(), [values.len(), 2]);
            Tensor::<2>::from_data(data, &device)
        };
        let bodies = Bodies { position: rows(&frame.position), velocity: rows(&frame.velocity) };
        let hidden = std::mem::take(&mut memory.hidden);
        let (next, hidden) =
            self.network.step(&bodies, &memory.matter, hidden, &mut Dropout::none());
        memory.hidden = hidden;
        let mut next = Frame {
            stream: frame.stream,
            sequence: frame.sequence + 1,
            stamp: frame.stamp.advance(self.dt, 1),
            dt: frame.dt,
            domain: frame.domain,
            position: pairs(next.position),
            velocity: pairs(next.velocity),
            material: frame.material.clone(),
        };
        self.corrector.correct(&memory.matter.rest, frame, &mut next);
        next
    }
}
