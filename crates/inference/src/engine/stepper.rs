//! Threads and scratch memory that predict streams: all threads on one stream, or each thread on its own.
//!
//! Threads that share a frame wait for each other at every stage. Where several streams have a frame waiting, each
//! thread takes one and none waits: more frames per second, each with a higher latency. A device steps several streams at
//! once.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use std::{fmt, sync::Arc};

use super::{
    Accelerator, DeviceStep, HiddenState, ModelError,
    frame_model::{self, FrameModel},
    hidden_state::Memory,
    particle_model::{self, ParticleModel},
};
use eddy_frames::{Frame, FrameView, Material, Particles, Stamp};
use eddy_threads::{DisjointSlice, Task, ThreadPool};

/// Multiplications per frame from which waking the other threads pays (some ten microseconds of work).
const WORTH_WAKING: usize = 1 << 18;

/// A packed network.
#[expect(clippy::large_enum_variant, reason = "there is one per surrogate")]
pub(super) enum Network {
    Frame(FrameModel),
    Particle(ParticleModel),
    /// On a device beside the processor.
    Device(Arc<dyn Accelerator>),
}

impl Network {
    fn stages(&self) -> usize {
        match self {
            Self::Frame(model) => model.stages(),
            Self::Particle(model) => model.stages.len(),
            Self::Device(_) => 1,
        }
    }

    fn scratch(&self, threads: usize) -> Scratch {
        match self {
            Self::Frame(model) => Scratch::Frame(Box::new(model.scratch(threads))),
            Self::Particle(model) => Scratch::Particle(Box::new(model.scratch(threads))),
            Self::Device(_) => Scratch::None,
        }
    }
}

impl fmt::Debug for Network {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Network")
    }
}

/// The network of a stream: that of its stiffness, or the one of all streams.
fn network_of(hidden: &HiddenState, of_all: &Arc<Network>) -> Arc<Network> {
    Arc::clone(hidden.network.as_ref().unwrap_or(of_all))
}

/// Buffers for one frame.
enum Scratch {
    Frame(Box<frame_model::Scratch>),
    Particle(Box<particle_model::Scratch>),
    None,
}

/// A frame that a stream observes, true or predicted, and where its prediction goes.
pub struct StepRequest<'a> {
    /// The stream's hidden state.
    pub hidden: &'a mut HiddenState,
    /// The observed frame.
    pub frame: FrameView<'a>,
    /// The predicted one.
    pub next: &'a mut Frame,
}

/// Predicts streams, one frame at a time, on its own threads and in its own scratch memory
/// ([`Surrogate::stepper`](super::Surrogate::stepper)).
///
/// The scratch memory grows to the largest frame predicted so far and is kept.
pub struct Stepper {
    network: Arc<Network>,
    /// Time between two frames (ns).
    interval: i64,
    pool: ThreadPool,
    scratch: Scratch,
    /// A single-threaded stepper for each thread; none if there is only one thread.
    single: Vec<Self>,
    /// Why the device predicts no more.
    failure: Option<String>,
}

impl Stepper {
    pub(super) fn new(network: &Arc<Network>, interval: i64, threads: usize) -> Self {
        let pool = ThreadPool::new("engine", threads, network.stages());
        if let Some(error) = pool.spawn_error() {
            let started = pool.threads();
            tracing::warn!("the engine has {started} threads instead of {threads}: {error}");
        }
        let threads = pool.threads();
        let single = if threads > 1 { threads } else { 0 };
        Self {
            network: Arc::clone(network),
            interval,
            scratch: network.scratch(threads),
            single: (0..single).map(|_| Self::new(network, interval, 1)).collect(),
            pool,
            failure: None,
        }
    }

    /// Number of streams that are best stepped at once: one per thread, or as many as a device takes.
    pub fn streams(&self) -> usize {
        match &*self.network {
            Network::Device(device) => device.streams(),
            _ => self.pool.threads(),
        }
    }

    /// Threads that step one stream each; `None` on a device, which steps all streams at once.
    pub fn threads(&self) -> Option<usize> {
        (!self.is_on_device()).then(|| self.pool.threads())
    }

    fn is_on_device(&self) -> bool {
        matches!(&*self.network, Network::Device(_))
    }

    /// Checks that the device has not failed. Predictions since a failure are NaN.
    ///
    /// # Errors
    /// [`ModelError::Device`].
    pub fn check(&self) -> Result<(), ModelError> {
        match &self.failure {
            None => Ok(()),
            Some(reason) => Err(ModelError::Device(reason.clone())),
        }
    }

    /// Observes a frame, true or predicted, of the particles that `hidden` was started for, and writes the predicted next
    /// frame to `next`: its sequence is one higher, its stamp `dt` later. The prediction may contain non-finite numbers;
    /// check it with [`Frame::check`].
    ///
    /// Nothing is allocated once a frame with as many particles in as large a domain was predicted into `next`.
    ///
    /// # Panics
    /// If the number of particles differs from that of `hidden`. A domain that
    /// [`Surrogate::fits`](super::Surrogate::fits) rejects may exhaust the memory.
    pub fn step_into<'a>(
        &mut self,
        hidden: &mut HiddenState,
        frame: impl Into<FrameView<'a>>,
        next: &mut Frame,
    ) {
        let request = StepRequest { hidden, frame: frame.into(), next };
        if self.is_on_device() {
            return self.step_on_device(&mut [request]);
        }
        let StepRequest { hidden, frame, next } = request;
        let particles = self.prepare(hidden, &frame, next);
        let network = network_of(hidden, &self.network);
        match (&*network, &mut self.scratch, &mut hidden.memory) {
            (Network::Frame(model), Scratch::Frame(scratch), Memory::Frame(memory)) => {
                let alone = model.work() < WORTH_WAKING;
                model.step(&mut self.pool, alone, scratch, memory, frame, next);
            }
            (Network::Particle(model), Scratch::Particle(scratch), Memory::Particle(memory)) => {
                let alone = particles.saturating_mul(model.work()) < WORTH_WAKING;
                model.step(&mut self.pool, alone, scratch, memory, frame, next);
            }
            _ => unreachable!(
                "a network, its scratch buffers and the states of its streams are made together"
            ),
        }
    }

    /// [`Stepper::step_into`] for several streams; a device steps them together.
    ///
    /// # Panics
    /// As [`Stepper::step_into`].
    pub fn step_all(&mut self, requests: &mut [StepRequest<'_>]) {
        if self.is_on_device() {
            return self.step_on_device(requests);
        }
        self.for_each(requests, |stepper, StepRequest { hidden, frame, next }| {
            stepper.step_into(hidden, *frame, next);
        });
    }

    /// Runs a sequence of steps for each item, such as one stream: `next_step` gives the item's next step, which may depend
    /// on the predictions before it, or `None` at its end, and is not called again after that. A device takes one step of
    /// every item at a time; otherwise the items are run to their ends as by [`Stepper::for_each`].
    ///
    /// # Panics
    /// As [`Stepper::step_into`], and if `next_step` does.
    pub fn run_all<T: Send + Sync>(
        &mut self,
        items: &mut [T],
        next_step: impl for<'a> Fn(&'a mut T) -> Option<StepRequest<'a>> + Sync,
    ) {
        if !self.is_on_device() {
            return self.for_each(items, |stepper, item| {
                while let Some(StepRequest { hidden, frame, next }) = next_step(item) {
                    stepper.step_into(hidden, frame, next);
                }
            });
        }
        let mut ended = vec![false; items.len()];
        loop {
            let running = items.iter_mut().zip(&mut ended).filter(|(_, ended)| !**ended);
            let mut requests: Vec<_> = running
                .filter_map(|(item, ended)| {
                    let request = next_step(item);
                    *ended = request.is_none();
                    request
                })
                .collect();
            if requests.is_empty() {
                return;
            }
            self.step_on_device(&mut requests);
        }
    }

    fn step_on_device(&mut self, requests: &mut [StepRequest<'_>]) {
        // Streams of one stiffness have a network, most often all of them.
        let mut of_network: Vec<(Arc<Network>, Vec<DeviceStep<'_>>)> = Vec::new();
        for StepRequest { hidden, frame, next } in &mut *requests {
            self.prepare(hidden, frame, next);
            let network = network_of(hidden, &self.network);
            let Memory::Device(state) = &mut hidden.memory else {
                unreachable!("a state of this network is on its device")
            };
            let state = &mut **state;
            let step = DeviceStep { state, frame: *frame, next };
            match of_network.iter_mut().find(|(other, _)| Arc::ptr_eq(other, &network)) {
                Some((_, steps)) => steps.push(step),
                None => of_network.push((network, vec![step])),
            }
        }
        for (network, mut steps) in of_network {
            let Network::Device(device) = &*network else { continue };
            if let Err(reason) = device.step(&mut steps) {
                self.failure.get_or_insert_with(|| reason.to_string());
                for DeviceStep { next, .. } in steps {
                    next.position.fill([f32::NAN; 2]);
                    next.velocity.fill([f32::NAN; 2]);
                }
            }
        }
    }

    /// As [`Stepper::step_into`], with a new frame for the prediction.
    pub fn step(&mut self, hidden: &mut HiddenState, frame: &Frame) -> Frame {
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
        self.step_into(hidden, frame, &mut next);
        next
    }

    /// Calls `work` for each item with a stepper: all threads together for a single item, one thread per item for
    /// several. The predictions have the same bits either way.
    ///
    /// # Panics
    /// If `work` does, on any thread.
    pub fn for_each<T: Send + Sync>(
        &mut self,
        items: &mut [T],
        work: impl Fn(&mut Self, &mut T) + Sync,
    ) {
        if items.len() < 2 || self.single.is_empty() {
            items.iter_mut().for_each(|item| work(self, item));
            return;
        }
        let (count, items, single) =
            (items.len(), DisjointSlice::new(items), DisjointSlice::new(&mut self.single));
        self.pool.run([count], false, &|Task { item, thread, .. }| {
            // SAFETY: each item runs once, and no two running items have the same thread number.
            let (item, stepper) = unsafe {
                (&mut items.part(item..item + 1)[0], &mut single.part(thread..thread + 1)[0])
            };
            work(stepper, item);
        });
    }

    /// Sets everything in `next` but positions and velocities, for which it makes room. Returns the number of particles.
    fn prepare(&self, hidden: &HiddenState, frame: &FrameView<'_>, next: &mut Frame) -> usize {
        let particles = hidden.particles();
        let found = frame.particles.len();
        assert_eq!(found, particles, "the hidden state is for {particles} particles");
        let Frame { stream, sequence, stamp, dt, domain, position, velocity, material } = next;
        (*stream, *sequence) = (frame.stream, frame.sequence + 1);
        *stamp = Stamp(frame.stamp.0.saturating_add(self.interval));
        (*dt, *domain) = (frame.dt, frame.domain);
        match frame.particles {
            Particles::Lists { material: kinds, .. } => kinds.clone_into(material),
            rows @ Particles::Rows(_) => {
                // Checked by the caller; but in shared memory, a program may still write to the rows. Their number must
                // not change.
                let kind = |particle| rows.material(particle).unwrap_or(Material::Liquid);
                material.clear();
                material.extend((0..particles).map(kind));
            }
        }
        position.resize(particles, [0.0; 2]);
        velocity.resize(particles, [0.0; 2]);
        particles
    }
}
