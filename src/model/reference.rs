//! A network that predicts frames, one after the other, with the operations that trained it.
//!
//! What streams is the layer `engine`; this is what it is held against, in tests and in
//! `eddy bench inference`.

use burn::tensor::{Tensor, TensorData};

use super::{
    Bodies, DeviceKind,
    features::one_hot,
    network::{Dropout, Hidden, Network},
};
use crate::{
    checkpoint::{Checkpoint, CheckpointError},
    frame::Frame,
};

/// A network in burn, ready to predict.
pub struct Reference {
    network: Network,
    device: DeviceKind,
    /// Time between two frames (s).
    dt: f32,
}

/// The hidden state of one stream: what the network remembers of the frames it observed.
#[derive(Clone)]
pub struct Memory {
    hidden: Hidden,
    /// One-hot materials, `[N, 4]`.
    material: Tensor<2>,
}

impl Reference {
    /// Puts the checkpoint's network on a device.
    ///
    /// # Errors
    /// [`CheckpointError`] when the weights do not fit the description.
    pub fn load(checkpoint: &Checkpoint, device: DeviceKind) -> Result<Self, CheckpointError> {
        checkpoint.check("checkpoint".as_ref())?;
        let network = Network::new(&checkpoint.description, &checkpoint.tensors, &device.device());
        Ok(Self { network, device, dt: checkpoint.description.dt })
    }

    /// An empty memory for the particles of `frame`, as many as the network is for. It has not observed
    /// `frame`; that is [`Reference::step`]'s part.
    pub fn start(&self, frame: &Frame) -> Memory {
        let material = one_hot(frame.material.iter().copied(), &self.device.device());
        Memory { hidden: Hidden::default(), material }
    }

    /// Observes a frame, true or predicted, of the particles the memory was started for, and
    /// predicts the next one: its sequence one higher, its stamp `dt` later.
    pub fn step(&self, memory: &mut Memory, frame: &Frame) -> Frame {
        let device = self.device.device();
        let rows = |values: &[[f32; 2]]| {
            let data = TensorData::new(values.as_flattened().to_vec(), [values.len(), 2]);
            Tensor::<2>::from_data(data, &device)
        };
        let bodies = Bodies { position: rows(&frame.position), velocity: rows(&frame.velocity) };
        let hidden = std::mem::take(&mut memory.hidden);
        let (next, hidden) =
            self.network.step(&bodies, &memory.material, hidden, &mut Dropout::none());
        memory.hidden = hidden;
        Frame {
            stream: frame.stream,
            sequence: frame.sequence + 1,
            stamp: frame.stamp.advance(self.dt, 1),
            dt: frame.dt,
            domain: frame.domain,
            position: pairs(next.position),
            velocity: pairs(next.velocity),
            material: frame.material.clone(),
        }
    }
}

/// `[N, 2]` as a list of pairs.
fn pairs(tensor: Tensor<2>) -> Vec<[f32; 2]> {
    let numbers: Vec<f32> = tensor.into_data().iter::<f32>().collect();
    numbers.as_chunks::<2>().0.to_vec()
}
