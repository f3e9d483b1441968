//! A checkpoint that predicts frames, one after the other.

use std::{
    num::NonZeroUsize,
    sync::{Mutex, MutexGuard, PoisonError},
    thread,
};

use pulp::Arch;

use super::{
    Memory, ModelError, Remark,
    frame_model::FrameModel,
    particle_model::ParticleModel,
    remark,
    workshop::{Network, Stepper, Workshop},
};
use crate::checkpoint::{Architecture, Checkpoint, Description, Surroundings};
use eddy_frames::{Domain, Frame, FrameView, Material, Particles, Stamp};

/// How much the frame interval of a stream may differ from the checkpoint's, relative to it.
const INTERVAL_TOLERANCE: f32 = 1e-3;

/// How far a stream's domain corners may be from the checkpoint's (domain lengths).
const DOMAIN_TOLERANCE: f32 = 1e-6;

/// Cells of a domain that are worth their time for each particle; a filled domain has less than one.
const CELLS_A_PARTICLE: usize = 64;

/// Cells of a domain that take no time worth mentioning.
const CELLS: usize = 1 << 20;

/// More threads than this have nothing to do: no layer has many more panels.
const MOST_THREADS: usize = 256;

/// A trained network, ready to predict.
///
/// The same frames give the same bits, whatever other streams there are, with any number of threads,
/// in any process, and on all processors that have AVX2 with FMA or AVX-512. Other instruction sets
/// round products, or some of them, differently in the last place.
pub struct Surrogate {
    description: Description,
    digest: String,
    network: Network,
    /// Time between two frames (ns).
    interval: i64,
    /// Room for frames under way. One step at a time, or one batch, has it.
    workshop: Mutex<Workshop>,
}

impl Surrogate {
    /// Packs the checkpoint's network, to run on `threads` threads (at most 256); on as many as there
    /// are cores if not given.
    ///
    /// # Errors
    /// [`ModelError::Checkpoint`] when the weights do not fit the description.
    pub fn load(
        checkpoint: &Checkpoint,
        threads: Option<NonZeroUsize>,
    ) -> Result<Self, ModelError> {
        Self::load_for(checkpoint, threads, Arch::new())
    }

    /// The same with a set of instructions that this processor has.
    ///
    /// # Errors
    /// As [`Surrogate::load`].
    pub fn load_for(
        checkpoint: &Checkpoint,
        threads: Option<NonZeroUsize>,
        arch: Arch,
    ) -> Result<Self, ModelError> {
        checkpoint.check("checkpoint".as_ref())?;
        let cores = || thread::available_parallelism().map_or(1, NonZeroUsize::get);
        let threads = threads.map_or_else(cores, NonZeroUsize::get).min(MOST_THREADS);
        let Checkpoint { description, tensors } = checkpoint;
        let network = match description.architecture {
            Architecture::Frame => Network::Frame(FrameModel::pack(arch, description, tensors)),
            Architecture::Particle => {
                Network::Particle(ParticleModel::pack(arch, description, tensors))
            }
        };
        let workshop = Workshop::new(&network, description.core, threads);
        Ok(Self {
            description: description.clone(),
            digest: checkpoint.digest(),
            network,
            interval: Stamp(0).advance(description.dt, 1).0,
            workshop: Mutex::new(workshop),
        })
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
    /// [`ModelError`] when it cannot: a material or interval it was not trained on, another number of
    /// particles or another domain (frame model), a domain with no room between its walls or far too large
    /// for its particles (particle model).
    pub fn fits<'a>(&self, frame: impl Into<FrameView<'a>>) -> Result<(), ModelError> {
        let frame = frame.into();
        let particles = frame.particles;
        let Description { sizes, materials, dt, domain, .. } = &self.description;
        if let Some(expected) = sizes.particles
            && expected != particles.len()
        {
            return Err(ModelError::Particles { found: particles.len(), expected });
        }
        let mut kinds = particles.materials().enumerate();
        if let Some((particle, found)) = kinds.find(|(_, kind)| !materials.contains(kind)) {
            let expected: Vec<_> = materials.iter().map(|m| m.name()).collect();
            let (found, expected) = (found.name(), expected.join(", "));
            return Err(ModelError::Material { particle, found, expected });
        }
        if (frame.dt - dt).abs() > INTERVAL_TOLERANCE * dt {
            return Err(ModelError::Interval { found: frame.dt, expected: *dt });
        }
        match self.description.surroundings {
            None => same_domain(&frame.domain, domain),
            Some(Surroundings { cell_width, .. }) => {
                fits_domain(&frame.domain, &self.description, cell_width, particles.len())
            }
        }
    }

    /// What there is to say about a stream that begins with a frame that [`Surrogate::fits`]: where the
    /// network works, but was not made for it.
    pub fn remarks(&self, frame: &Frame) -> Vec<Remark> {
        remark::remarks(&self.description, frame)
    }

    /// An empty memory for the particles of `frame`. It has not observed `frame`; that is
    /// [`Surrogate::step`]'s part. The particle model takes jelly and rope to be at rest in the shape they
    /// have in `frame`.
    ///
    /// # Errors
    /// As [`Surrogate::fits`].
    pub fn start(&self, frame: &Frame) -> Result<Memory, ModelError> {
        self.fits(frame)?;
        Ok(Memory::new(&self.description, frame))
    }

    /// Observes a frame, true or predicted, of the particles the memory was started for, and
    /// predicts the next one into `next`: its sequence one higher, its stamp `dt` later. The
    /// prediction may hold numbers that are not finite; [`Frame::check`] tells.
    ///
    /// Once a frame of so many particles in such a domain was predicted into `next`, nothing is allocated.
    ///
    /// # Panics
    /// When `frame` has another number of particles than the memory was started for. In a domain that
    /// [`Surrogate::fits`] refuses, the memory that is asked for may be more than there is.
    pub fn step_into<'a>(
        &self,
        memory: &mut Memory,
        frame: impl Into<FrameView<'a>>,
        next: &mut Frame,
    ) {
        self.workshop().together(self).step_into(memory, frame, next);
    }

    /// Does `work` for each item, with what steps streams: all threads together for one item, each thread
    /// on an item of its own for several. What is predicted is the same, bit for bit. Each thread keeps room for the
    /// largest frame that it has stepped.
    ///
    /// `work` steps with what it is given: a call of another method of this surrogate that steps, this one included,
    /// would wait for ever.
    ///
    /// # Panics
    /// Where `work` does, on any thread.
    pub fn each<T: Send + Sync>(
        &self,
        items: &mut [T],
        work: impl Fn(&mut Stepper<'_>, &mut T) + Sync,
    ) {
        self.workshop().each(self, items, work);
    }

    /// How many items [`Surrogate::each`] works on at once.
    pub fn threads(&self) -> usize {
        self.workshop().threads()
    }

    /// A step that panicked left room behind that the next one fills anew.
    fn workshop(&self) -> MutexGuard<'_, Workshop> {
        self.workshop.lock().unwrap_or_else(PoisonError::into_inner)
    }

    pub(super) fn network(&self) -> &Network {
        &self.network
    }

    /// What a prediction from `frame` has but for positions and velocities, for which there is room then.
    pub(super) fn begin(&self, particles: usize, frame: &FrameView<'_>, next: &mut Frame) {
        assert_eq!(frame.particles.len(), particles, "the memory is for {particles} particles");
        let Frame { stream, sequence, stamp, dt, domain, position, velocity, material } = next;
        (*stream, *sequence) = (frame.stream, frame.sequence + 1);
        *stamp = Stamp(frame.stamp.0.saturating_add(self.interval));
        (*dt, *domain) = (frame.dt, frame.domain);
        match frame.particles {
            Particles::Lists { material: kinds, .. } => kinds.clone_into(material),
            rows @ Particles::Rows(_) => {
                // The caller has checked them. A program that writes on nevertheless must not change how
                // many there are.
                let kind = |particle| rows.material(particle).unwrap_or(Material::Liquid);
                material.clear();
                material.extend((0..particles).map(kind));
            }
        }
        position.resize(particles, [0.0; 2]);
        velocity.resize(particles, [0.0; 2]);
    }

    /// As [`Surrogate::step_into`], with a new frame for the prediction.
    pub fn step(&self, memory: &mut Memory, frame: &Frame) -> Frame {
        let mut next = Frame {
            stream: frame.stream,
            sequence: frame.sequence,
            stamp: frame.stamp,
            dt: frame.dt,
            domain: frame.domain,
            position: Vec::new(),
            velocity: Vec::new(),
            material: Vec::new(),
        };
        self.step_into(memory, frame, &mut next);
        next
    }
}

/// Whether the frame model's domain is the one it was trained in.
fn same_domain(found: &Domain, expected: &Domain) -> Result<(), ModelError> {
    let apart = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).abs().max((a[1] - b[1]).abs());
    let distance = apart(found.lower, expected.lower).max(apart(found.upper, expected.upper));
    // What is not a number does not fit either.
    if distance <= DOMAIN_TOLERANCE {
        return Ok(());
    }
    Err(ModelError::Domain { found: corners(found), expected: corners(expected) })
}

/// Whether the particle model can work in a domain: one of any size that its particles fill at least here
/// and there.
fn fits_domain(
    found: &Domain,
    description: &Description,
    cell_width: f32,
    particles: usize,
) -> Result<(), ModelError> {
    let Description { domain, normalization, .. } = description;
    let thickness: [f32; 2] = std::array::from_fn(|axis| {
        let lower = normalization.minimum[axis] - domain.lower[axis];
        lower + domain.upper[axis] - normalization.maximum[axis]
    });
    let extent: [f32; 2] = std::array::from_fn(|axis| found.upper[axis] - found.lower[axis]);
    if !(0..2).all(|axis| extent[axis] > thickness[axis].max(0.0)) {
        return Err(ModelError::Narrow { found: corners(found), expected: thickness });
    }
    let cells = (extent[0] / cell_width) * (extent[1] / cell_width);
    let most = particles.saturating_mul(CELLS_A_PARTICLE).max(CELLS);
    if cells <= most as f32 {
        return Ok(());
    }
    Err(ModelError::Wide { found: corners(found), cells, most })
}

fn corners(domain: &Domain) -> String {
    format!("{:?}, {:?}", domain.lower, domain.upper)
}
