//! A checkpoint's network, ready to predict.

use std::{
    collections::BTreeMap,
    num::NonZeroUsize,
    sync::{Arc, Mutex, PoisonError, Weak},
    thread,
};

use pulp::Arch;

use super::{
    Accelerator, HiddenState, ModelError, Stated, Stepper, StreamSetup, StreamStart, Warning,
    frame_model::FrameModel, hidden_state, particle_model::ParticleModel,
    scales::stiffness_feature, stepper::Network, warning,
};
use crate::{
    checkpoint::{Architecture, Checkpoint, Description},
    error_model::{ERROR_MODEL_FILE, ErrorModel},
};
use eddy_frames::{Frame, FrameView, Stamp};

/// More threads than this would idle: no layer has many more panels.
const MAX_THREADS: usize = 256;

/// A trained network, packed for prediction. It does not change; a [`Stepper`] runs it.
///
/// The same frames give the same bits, whatever other streams there are, with any number of threads, in any process,
/// and on all processors that have AVX2 with FMA or AVX-512; a device has bits of its own. Other instruction sets round some products differently in
/// the last place.
///
/// Clones share the network.
#[derive(Clone)]
pub struct Surrogate {
    description: Description,
    digest: String,
    error_model: Option<Arc<ErrorModel>>,
    network: Arc<Network>,
    /// Weights for several stiffnesses, of which those of a stream are made.
    by_stiffness: Option<Arc<ByStiffness>>,
    threads: usize,
}

/// A checkpoint with weights for several stiffnesses, and the networks that streams have of it.
struct ByStiffness {
    checkpoint: Checkpoint,
    pack: Box<Pack>,
    networks: Mutex<Networks>,
}

/// Networks of streams, by the bits of their stiffness; the one that was used last is kept without a stream too.
#[derive(Default)]
struct Networks {
    in_use: BTreeMap<u32, Weak<Network>>,
    last: Option<Arc<Network>>,
}

/// Makes the network of a checkpoint with one set of weights.
type Pack = dyn Fn(&Checkpoint) -> Result<Network, ModelError> + Send + Sync;

impl ByStiffness {
    /// The network for streams of a stiffness, packed unless another stream has it or had it last.
    fn network(&self, stiffness: f32) -> Result<Arc<Network>, ModelError> {
        let mut networks = self.networks.lock().unwrap_or_else(PoisonError::into_inner);
        let known = networks.in_use.get(&stiffness.to_bits()).and_then(Weak::upgrade);
        let network = match known {
            Some(network) => network,
            None => Arc::new((self.pack)(&self.checkpoint.at_stiffness(stiffness))?),
        };
        networks.last = Some(Arc::clone(&network));
        networks.in_use.retain(|_, network| network.strong_count() > 0);
        networks.in_use.insert(stiffness.to_bits(), Arc::downgrade(&network));
        Ok(network)
    }
}

impl Surrogate {
    /// Packs the checkpoint's network. Each of its steppers runs on `threads` threads (at most 256), by default on as many
    /// as there are cores.
    ///
    /// # Errors
    /// [`ModelError::Checkpoint`] if the weights do not match the description.
    pub fn load(
        checkpoint: &Checkpoint,
        threads: Option<NonZeroUsize>,
    ) -> Result<Self, ModelError> {
        Self::load_for(checkpoint, threads, Arch::new())
    }

    /// As [`Surrogate::load`], for a given instruction set of this processor.
    ///
    /// # Errors
    /// As [`Surrogate::load`].
    pub fn load_for(
        checkpoint: &Checkpoint,
        threads: Option<NonZeroUsize>,
        arch: Arch,
    ) -> Result<Self, ModelError> {
        let cores = || thread::available_parallelism().map_or(1, NonZeroUsize::get);
        let threads = threads.map_or_else(cores, NonZeroUsize::get).min(MAX_THREADS);
        let pack = move |Checkpoint { description, tensors, .. }: &Checkpoint| {
            Ok(match description.architecture {
                Architecture::Frame => Network::Frame(FrameModel::pack(arch, description, tensors)),
                Architecture::Particle => {
                    Network::Particle(ParticleModel::pack(arch, description, tensors))
                }
            })
        };
        Self::new(checkpoint, Box::new(pack), threads)
    }

    /// The checkpoint's network on a device that has its weights.
    ///
    /// # Errors
    /// [`ModelError::Checkpoint`] if the weights do not match the description; [`ModelError::Device`] if there are several sets of them
    /// ([`Surrogate::on_devices`]).
    pub fn on_device(
        checkpoint: &Checkpoint,
        device: Arc<dyn Accelerator>,
    ) -> Result<Self, ModelError> {
        if !checkpoint.description.stiffness_knots.is_empty() {
            let reason =
                "the device has one set of weights, the checkpoint some for several stiffnesses";
            return Err(ModelError::Device(reason.to_owned()));
        }
        Self::on_devices(checkpoint, move |_| Ok(Arc::clone(&device)))
    }

    /// The checkpoint's network on a device, which `open` gives the weights of a checkpoint: once, or, if it has weights for several
    /// stiffnesses, for each stiffness of a stream.
    ///
    /// # Errors
    /// [`ModelError::Checkpoint`] if the weights do not match the description; those of `open`.
    pub fn on_devices(
        checkpoint: &Checkpoint,
        open: impl Fn(&Checkpoint) -> Result<Arc<dyn Accelerator>, ModelError> + Send + Sync + 'static,
    ) -> Result<Self, ModelError> {
        Self::new(checkpoint, Box::new(move |checkpoint| open(checkpoint).map(Network::Device)), 1)
    }

    fn new(checkpoint: &Checkpoint, pack: Box<Pack>, threads: usize) -> Result<Self, ModelError> {
        checkpoint.check("checkpoint".as_ref())?;
        let knots = &checkpoint.description.stiffness_knots;
        let (network, by_stiffness) = match knots.first() {
            None => (pack(checkpoint)?, None),
            Some(&first) => {
                // Streams have networks of their own; this one says how large they are.
                let sample = pack(&checkpoint.at_stiffness(first))?;
                let (checkpoint, networks) = (checkpoint.clone(), Mutex::default());
                (sample, Some(Arc::new(ByStiffness { checkpoint, pack, networks })))
            }
        };
        let digest = checkpoint.digest();
        let error_model = checkpoint.error_model.clone().filter(|model| {
            let is_its_own = model.checkpoint == digest;
            if !is_its_own {
                tracing::warn!(
                    "{ERROR_MODEL_FILE}: calibrated for checkpoint {:.12}, not {digest:.12}: errors are not estimated; \
                     `eddy calibrate` makes a new one",
                    model.checkpoint
                );
            }
            is_its_own
        });
        Ok(Self {
            description: checkpoint.description.clone(),
            digest,
            error_model: error_model.map(Arc::new),
            network: Arc::new(network),
            by_stiffness,
            threads,
        })
    }

    /// A stepper of this network, with threads of its own.
    pub fn stepper(&self) -> Stepper {
        let interval = Stamp(0).advance(self.description.dt, 1).0;
        Stepper::new(&self.network, interval, self.threads)
    }

    /// Number of streams from which on stepping more at once gains nothing: 1 on the processor.
    pub fn streams_at_once(&self) -> usize {
        match &*self.network {
            Network::Device(device) => device.streams(),
            _ => 1,
        }
    }

    /// The checkpoint's description.
    pub fn description(&self) -> &Description {
        &self.description
    }

    /// The checkpoint's digest, [`Checkpoint::digest`].
    pub fn digest(&self) -> &str {
        &self.digest
    }

    /// Calibrated estimates of its error, if the checkpoint has them.
    pub fn error_model(&self) -> Option<&ErrorModel> {
        self.error_model.as_deref()
    }

    /// As [`fits`](super::fits()), for this network.
    ///
    /// # Errors
    /// As [`fits`](super::fits()).
    pub fn fits<'a>(&self, frame: impl Into<FrameView<'a>>) -> Result<(), ModelError> {
        super::fits(&self.description, frame)
    }

    /// Checks the stiffness of a stream (density x velocity^2), or that none is given.
    ///
    /// # Errors
    /// [`ModelError::Stiffness`] if the network is conditioned on the stiffness and it is not a positive number, or missing while the
    /// checkpoint assumes none, or if it is given and the network does not use it.
    pub fn check_stiffness(&self, stiffness: Option<f32>) -> Result<(), ModelError> {
        let expected = match (self.description.stiffness, stiffness) {
            (false, None) => return Ok(()),
            (true, Some(given)) if given.is_finite() && given > 0.0 => return Ok(()),
            (true, None) if self.description.assumed_stiffness.is_some() => return Ok(()),
            (false, Some(_)) => "nothing: the checkpoint does not use it",
            (true, _) => {
                "Young's modulus of the stream, a positive number: the checkpoint is conditioned on it"
            }
        };
        let found = stiffness.map_or("nothing".to_owned(), |stiffness| stiffness.to_string());
        Err(ModelError::Stiffness { found, expected })
    }

    /// Warnings about a stream that begins with a frame that [`Surrogate::fits`]: the network can predict it, but was not
    /// trained for it.
    pub fn warnings(&self, frame: &Frame, stated: Stated) -> Vec<Warning> {
        warning::warnings(&self.description, &StreamSetup::of(frame, stated))
    }

    /// The hidden state of a stream that begins with `frame`, before any frame is observed: `frame` itself is to be passed
    /// to [`Stepper::step_into`] first. The particle model takes the shape of jelly and rope in `frame` as their rest shape.
    ///
    /// # Errors
    /// As [`Surrogate::fits`]; [`ModelError::Stiffness`] if the network is conditioned on the stiffness of a stream
    /// ([`Surrogate::start_with_stiffness`]).
    pub fn start(&self, frame: &Frame) -> Result<HiddenState, ModelError> {
        self.start_with_stiffness(frame, None)
    }

    /// As [`Surrogate::start`], with the stream's stiffness: Young's modulus of its materials (density x velocity^2), for a network
    /// that is conditioned on it; otherwise the one that the checkpoint assumes ([`Description::assumed_stiffness`]).
    ///
    /// # Errors
    /// As [`Surrogate::fits`] and [`Surrogate::check_stiffness`].
    pub fn start_with_stiffness(
        &self,
        frame: &Frame,
        stiffness: Option<f32>,
    ) -> Result<HiddenState, ModelError> {
        self.fits(frame)?;
        self.check_stiffness(stiffness)?;
        let stiffness = stiffness.or(self.description.assumed_stiffness);
        let own = self.by_stiffness.as_ref().zip(stiffness);
        let own = own.map(|(weights, stiffness)| weights.network(stiffness)).transpose()?;
        let network = own.as_ref().unwrap_or(&self.network);
        let mut hidden = match &**network {
            Network::Device(device) => {
                let material: Vec<_> = frame.material.iter().map(|&kind| kind as u8).collect();
                let (rest, lattices) = hidden_state::rest(&self.description, frame, stiffness);
                let state = device.start(&StreamStart {
                    material: &material,
                    domain: frame.domain,
                    rest: &rest,
                    lattices: &lattices,
                    stiffness: stiffness.map(stiffness_feature),
                })?;
                HiddenState::on_device(frame.len(), state)
            }
            _ => HiddenState::new(&self.description, frame, stiffness),
        };
        hidden.network = own;
        Ok(hidden)
    }
}
