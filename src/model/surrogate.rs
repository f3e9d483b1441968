//! A checkpoint that predicts frames, one after the other.

use burn::tensor::{Tensor, TensorData};

use super::{
    Bodies, DeviceKind,
    features::one_hot,
    network::{Dropout, Hidden, Network},
};
use crate::{
    checkpoint::{Checkpoint, CheckpointError, Description},
    frame::Frame,
};

/// How much the frame interval of a stream may differ from the checkpoint's, relative to it.
const INTERVAL_TOLERANCE: f32 = 1e-3;

/// How far a stream's domain corners may be from the checkpoint's (domain lengths).
const DOMAIN_TOLERANCE: f32 = 1e-6;

/// Why a network cannot be used, or not on these particles.
#[derive(Debug, thiserror::Error)]
pub enum ModelError {
    /// The weights do not fit the description.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The frame model was trained on another number of particles.
    #[error("particles: found {found}, expected {expected} as in the checkpoint")]
    Particles {
        /// Particles in the frame.
        found: usize,
        /// Particles of the network.
        expected: usize,
    },
    /// The frame has a material that the data set did not have.
    #[error("material[{particle}]: found {found}, expected one of {expected} as in the checkpoint")]
    Material {
        /// First particle concerned.
        particle: usize,
        /// Its material.
        found: &'static str,
        /// The checkpoint's materials.
        expected: String,
    },
    /// The frames are further apart, or closer, than in training.
    #[error("dt: found {found} s, expected {expected} s as in the checkpoint")]
    Interval {
        /// The frame's interval (s).
        found: f32,
        /// The checkpoint's (s).
        expected: f32,
    },
    /// The particles are in another box than in training.
    #[error("lower, upper: found {found}, expected {expected} as in the checkpoint")]
    Domain {
        /// The frame's corners.
        found: String,
        /// The checkpoint's.
        expected: String,
    },
}

/// A trained network, ready to predict. The same frames give the same bits in any process on a
/// machine.
pub struct Surrogate {
    description: Description,
    digest: String,
    network: Network,
    device: DeviceKind,
}

/// The hidden state of one stream: what the network remembers of the frames it observed.
#[derive(Clone)]
pub struct Memory {
    hidden: Hidden,
    /// One-hot materials, `[N, 4]`.
    material: Tensor<2>,
}

impl Surrogate {
    /// Puts the checkpoint's network on a device.
    ///
    /// # Errors
    /// [`ModelError::Checkpoint`] when the weights do not fit the description.
    pub fn load(checkpoint: &Checkpoint, device: DeviceKind) -> Result<Self, ModelError> {
        checkpoint.check("checkpoint".as_ref())?;
        let network = Network::new(&checkpoint.description, &checkpoint.tensors, &device.device());
        let digest = checkpoint.digest();
        Ok(Self { description: checkpoint.description.clone(), digest, network, device })
    }

    /// What the network is.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// Digest of its checkpoint, [`Checkpoint::digest`].
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// Whether the network can predict such a frame.
    ///
    /// # Errors
    /// [`ModelError`] when it cannot: another number of particles (frame model only), a material,
    /// interval or domain it was not trained on.
    pub fn fits(&self, frame: &Frame) -> Result<(), ModelError> {
        let Description { sizes, materials, dt, domain, .. } = &self.description;
        if let Some(expected) = sizes.particles
            && expected != frame.len()
        {
            return Err(ModelError::Particles { found: frame.len(), expected });
        }
        if let Some(particle) = frame.material.iter().position(|m| !materials.contains(m)) {
            let expected: Vec<_> = materials.iter().map(|m| m.name()).collect();
            return Err(ModelError::Material {
                particle,
                found: frame.material[particle].name(),
                expected: expected.join(", "),
            });
        }
        if (frame.dt - dt).abs() > INTERVAL_TOLERANCE * dt {
            return Err(ModelError::Interval { found: frame.dt, expected: *dt });
        }
        let apart = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).abs().max((a[1] - b[1]).abs());
        let distance =
            apart(frame.domain.lower, domain.lower).max(apart(frame.domain.upper, domain.upper));
        if distance > DOMAIN_TOLERANCE {
            return Err(ModelError::Domain {
                found: format!("{:?}, {:?}", frame.domain.lower, frame.domain.upper),
                expected: format!("{:?}, {:?}", domain.lower, domain.upper),
            });
        }
        Ok(())
    }

    /// An empty memory for the particles of `frame`. It has not observed `frame`; that is
    /// [`Surrogate::step`]'s part.
    ///
    /// # Errors
    /// As [`Surrogate::fits`].
    pub fn start(&self, frame: &Frame) -> Result<Memory, ModelError> {
        self.fits(frame)?;
        let material = one_hot(frame.material.iter().copied(), &self.device.device());
        Ok(Memory { hidden: Hidden::default(), material })
    }

    /// Observes a frame, true or predicted, of the particles the memory was started for, and
    /// predicts the next one: its sequence one higher, its stamp `dt` later. The prediction may hold
    /// numbers that are not finite; [`Frame::check`] tells.
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
            stamp: frame.stamp.advance(self.description.dt, 1),
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

impl Memory {
    /// How many particles it is for.
    pub fn particles(&self) -> usize {
        self.material.dims()[0]
    }
}
