//! A checkpoint that predicts frames, one after the other.

use std::{
    num::NonZeroUsize,
    sync::{Mutex, PoisonError},
    thread,
};

use pulp::Arch;

use super::{
    Memory, ModelError, Remark,
    crew::Crew,
    frame_model::{self, FrameModel},
    particle_model::{self, ParticleModel},
    remark,
};
use crate::{
    checkpoint::{Architecture, Checkpoint, Description, Surroundings},
    frame::{Domain, Frame, Stamp},
};

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

/// Multiplications of a frame for which the other threads are woken: some ten microseconds.
const WORTH_WAKING: usize = 1 << 18;

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
    workshop: Mutex<Workshop>,
}

enum Network {
    Frame(FrameModel),
    Particle(ParticleModel),
}

/// Threads, and room for what they hand on to each other. One step at a time has it.
struct Workshop {
    crew: Crew,
    room: Room,
}

enum Room {
    Frame(Box<frame_model::Room>),
    Particle(Box<particle_model::Room>),
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
        Self::load_for(checkpoint, threads, Arch::new(), true)
    }

    /// The same with a set of instructions that this processor has; `conserve` says whether liquids keep their
    /// area, solids their shape, and bodies their momentum and their rest.
    pub(super) fn load_for(
        checkpoint: &Checkpoint,
        threads: Option<NonZeroUsize>,
        arch: Arch,
        conserve: bool,
    ) -> Result<Self, ModelError> {
        checkpoint.check("checkpoint".as_ref())?;
        let cores = || thread::available_parallelism().map_or(1, NonZeroUsize::get);
        let threads = threads.map_or_else(cores, NonZeroUsize::get).min(MOST_THREADS);
        let Checkpoint { description, tensors } = checkpoint;
        let (network, crew, room) = match description.architecture {
            Architecture::Frame => {
                let model = FrameModel::pack(arch, description, tensors);
                let crew = Crew::new(threads, model.stages());
                let room = Room::Frame(Box::new(model.room(crew.threads(), description.core)));
                (Network::Frame(model), crew, room)
            }
            Architecture::Particle => {
                let model = ParticleModel::pack(arch, description, tensors, conserve);
                let crew = Crew::new(threads, particle_model::STAGES);
                let room = Room::Particle(Box::new(model.room(crew.threads())));
                (Network::Particle(model), crew, room)
            }
        };
        Ok(Self {
            description: description.clone(),
            digest: checkpoint.digest(),
            network,
            interval: Stamp(0).advance(description.dt, 1).0,
            workshop: Mutex::new(Workshop { crew, room }),
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
        match self.description.surroundings {
            None => same_domain(&frame.domain, domain),
            Some(Surroundings { cell_width, .. }) => {
                fits_domain(&frame.domain, &self.description, cell_width, frame.len())
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
    pub fn step_into(&self, memory: &mut Memory, frame: &Frame, next: &mut Frame) {
        let particles = memory.particles();
        let lengths = [frame.position.len(), frame.velocity.len(), frame.material.len()];
        assert_eq!(lengths, [particles; 3], "the memory is for {particles} particles");
        let Frame { stream, sequence, stamp, dt, domain, position, velocity, material } = next;
        (*stream, *sequence) = (frame.stream, frame.sequence + 1);
        *stamp = Stamp(frame.stamp.0.saturating_add(self.interval));
        (*dt, *domain) = (frame.dt, frame.domain);
        material.clone_from(&frame.material);
        position.resize(particles, [0.0; 2]);
        velocity.resize(particles, [0.0; 2]);

        // A step that panicked left room behind that the next one fills anew.
        let mut workshop = self.workshop.lock().unwrap_or_else(PoisonError::into_inner);
        let Workshop { crew, room } = &mut *workshop;
        match (&self.network, room) {
            (Network::Frame(model), Room::Frame(room)) => {
                let alone = model.work() < WORTH_WAKING;
                model.step(crew, alone, room, memory, frame, next);
            }
            (Network::Particle(model), Room::Particle(room)) => {
                let alone = particles.saturating_mul(model.work()) < WORTH_WAKING;
                model.step(crew, alone, room, memory, frame, next);
            }
            _ => unreachable!("a network and its room are made together"),
        }
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
