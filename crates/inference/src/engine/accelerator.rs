//! Devices beside the processor that predict streams: eddy's own code for them lies in crates that use this one.

use std::{any::Any, fmt};

use serde::{Deserialize, Serialize};

use super::ModelError;
use crate::kernels::{lattice::Lattices, rest_shape::RestShape};
use eddy_frames::{Domain, Frame, FrameView};

/// How an NVIDIA GPU computes products.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Precision {
    /// Factors rounded to TF32 (10 bits of mantissa), sums in f32, on tensor cores.
    #[default]
    Tf32,
    /// All in f32.
    Fp32,
}

impl Precision {
    /// The word in files and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Tf32 => "tf32",
            Self::Fp32 => "fp32",
        }
    }
}

/// A device that predicts streams with one network and corrects them by its rules. The hidden states stay on it.
///
/// The same frames give the same bits, whatever other streams are stepped with them.
pub trait Accelerator: Send + Sync {
    /// Number of streams from which on stepping more at once gains nothing.
    fn streams(&self) -> usize;

    /// The state of a stream before its first frame.
    ///
    /// # Errors
    /// [`ModelError::Device`].
    fn start(&self, stream: &StreamStart<'_>) -> Result<Box<dyn DeviceState>, ModelError>;

    /// Observes a frame of each stream and writes positions and velocities of the predicted next frame.
    ///
    /// # Errors
    /// [`ModelError::Device`]: the device has failed, now or before; then nothing is predicted any more.
    fn step(&self, steps: &mut [DeviceStep<'_>]) -> Result<(), ModelError>;
}

/// What a stream starts with ([`Accelerator::start`]).
pub struct StreamStart<'a> {
    /// The materials of its particles, by number, `[N]`.
    pub material: &'a [u8],
    /// The domain of its first frame.
    pub domain: Domain,
    /// Particle model: the rest shape of jelly and rope, in the order of the particles. Empty in the frame model.
    pub rest: &'a RestShape,
    /// Particle model: the lattices of jelly, in the order of the particles, if the rule `elastic` is on; else empty.
    pub lattices: &'a Lattices,
    /// Particle model: the feature of the stream's stiffness, if the network is conditioned on it.
    pub stiffness: Option<f32>,
}

/// One stream of [`Accelerator::step`].
pub struct DeviceStep<'a> {
    /// The stream's state.
    pub state: &'a mut dyn DeviceState,
    /// The observed frame.
    pub frame: FrameView<'a>,
    /// The predicted one, with as many particles.
    pub next: &'a mut Frame,
}

/// The hidden state of a stream on a device. A failure of the device shows at the next [`Accelerator::step`].
pub trait DeviceState: Any + Send + Sync {
    /// A copy.
    fn duplicate(&self) -> Box<dyn DeviceState>;

    /// Becomes a copy of a state of the same network and particles.
    fn copy_from(&mut self, other: &dyn DeviceState);

    /// Forgets the observed frames.
    fn forget(&mut self);

    /// The numbers of the state; empty where the device has failed.
    fn numbers(&self) -> Vec<f32>;
}

impl fmt::Debug for dyn DeviceState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_list().entries(self.numbers()).finish()
    }
}

impl PartialEq for dyn DeviceState {
    fn eq(&self, other: &Self) -> bool {
        self.numbers() == other.numbers()
    }
}
