//! Streams predicted on a device, as the streaming engine uses them.

use std::{
    any::Any,
    num::NonZeroUsize,
    sync::{Arc, Mutex, MutexGuard},
    thread,
};

use eddy_frames::{Frame, FrameView, Particles};
use eddy_inference::engine::{Accelerator, DeviceState, DeviceStep, ModelError, StreamStart};
use eddy_threads::ThreadPool;

use crate::error::{CudaError, Result};

/// x, y, vx, vy of a particle.
pub(crate) type Body = [f32; 4];

/// A stream of a step: what is remembered of it, the observed frame, and the predicted one.
pub type Step<'a, M> = (&'a M, FrameView<'a>, &'a mut Frame);

/// A network that predicts streams on a device.
pub trait StreamModel: Send + 'static {
    /// What is remembered of a stream.
    type Memory: StreamMemory;

    /// Streams of a step, at most.
    const MOST: usize;

    /// The memory of a stream before its first frame.
    fn memory(&mut self, stream: &StreamStart<'_>) -> Result<Self::Memory>;

    /// How many of at most [`Self::MOST`] streams, from the first on, are best stepped together.
    fn batch(&self, steps: &[Step<'_, Self::Memory>]) -> usize {
        steps.len()
    }

    /// One frame of each stream.
    fn step(&mut self, steps: &mut [Step<'_, Self::Memory>]) -> Result<()>;
}

/// What a network remembers of a stream.
pub trait StreamMemory: Send + Sync + Sized + 'static {
    /// A copy.
    fn duplicate(&self) -> Result<Self>;

    /// Whether this can become a copy of the other one in place.
    fn resembles(&self, other: &Self) -> bool;

    /// Becomes a copy of one that it resembles.
    fn copy_from(&self, other: &Self) -> Result<()>;

    /// Forgets the observed frames.
    fn clear(&self) -> Result<()>;

    /// The state as a list.
    fn numbers(&self) -> Result<Vec<f32>>;
}

/// A network on a device, as the streaming engine uses it. Steps from several threads follow each other. After a failure of
/// the device every step fails with it.
pub struct Streams<M>(Arc<Mutex<Shared<M>>>);

struct Shared<M> {
    model: M,
    failure: Option<String>,
}

impl<M> Clone for Streams<M> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<M> Streams<M> {
    /// Of a network on a device.
    pub fn new(model: M) -> Self {
        Self(Arc::new(Mutex::new(Shared { model, failure: None })))
    }

    fn shared(&self) -> MutexGuard<'_, Shared<M>> {
        self.0.lock().unwrap_or_else(|broken| broken.into_inner())
    }

    /// Runs `work` beside no other work.
    pub(crate) fn alone<T>(&self, work: impl FnOnce(&mut M) -> T) -> T {
        work(&mut self.shared().model)
    }

    /// Runs `work`, unless the device has failed; keeps its failure.
    fn attempt<T>(
        &self,
        work: impl FnOnce(&mut M) -> Result<T>,
    ) -> std::result::Result<T, ModelError> {
        let Shared { model, failure } = &mut *self.shared();
        if failure.is_none() {
            match work(model) {
                Ok(value) => return Ok(value),
                // Nothing is lost but this state or step: other streams go on.
                Err(reason @ CudaError::Memory { .. }) => {
                    return Err(ModelError::Device(reason.to_string()));
                }
                Err(reason) => *failure = Some(reason.to_string()),
            }
        }
        Err(ModelError::Device(failure.clone().unwrap_or_default()))
    }
}

impl<M: StreamModel> Accelerator for Streams<M> {
    fn streams(&self) -> usize {
        M::MOST
    }

    fn start(
        &self,
        stream: &StreamStart<'_>,
    ) -> std::result::Result<Box<dyn DeviceState>, ModelError> {
        let memory = self.attempt(|model| model.memory(stream))?;
        Ok(Box::new(State { owner: self.clone(), memory: Ok(memory) }))
    }

    fn step(&self, steps: &mut [DeviceStep<'_>]) -> std::result::Result<(), ModelError> {
        let mut rows = Vec::with_capacity(steps.len());
        for DeviceStep { state, frame, next } in steps {
            let memory = memory_of::<M>(&**state);
            let memory = memory.map_err(|reason| ModelError::Device(reason.to_owned()))?;
            rows.push((memory, *frame, &mut **next));
        }
        let mut rows = rows.as_mut_slice();
        while !rows.is_empty() {
            let most = rows.len().min(M::MOST);
            let count = self.alone(|model| model.batch(&rows[..most]));
            let (now, later) = rows.split_at_mut(count);
            match self.attempt(|model| model.step(now)) {
                Err(reason) if now.len() == 1 => return Err(reason),
                // Too large together, perhaps, but not one by one.
                Err(_) => {
                    for one in now.chunks_mut(1) {
                        self.attempt(|model| model.step(one))?;
                    }
                }
                Ok(()) => {}
            }
            rows = later;
        }
        Ok(())
    }
}

/// The state of a stream on a device, or why it could not be copied.
struct State<M: StreamModel> {
    owner: Streams<M>,
    memory: std::result::Result<M::Memory, String>,
}

impl<M: StreamModel> Drop for State<M> {
    fn drop(&mut self) {
        self.replace(Err(String::new()));
    }
}

fn memory_of<M: StreamModel>(state: &dyn DeviceState) -> std::result::Result<&M::Memory, &str> {
    let state: &dyn Any = state;
    let state = state.downcast_ref::<State<M>>();
    let memory = state.map(|state| state.memory.as_ref().map_err(String::as_str));
    memory.unwrap_or(Err("the state of another device"))
}

impl<M: StreamModel> State<M> {
    /// A copy of a state's memory.
    fn copy_of(&self, other: &dyn DeviceState) -> std::result::Result<M::Memory, String> {
        let memory = memory_of::<M>(other)?;
        self.owner.attempt(|_| memory.duplicate()).map_err(|reason| reason.to_string())
    }

    /// Gives the memory back between steps: a step may be about to be recorded.
    fn replace(&mut self, memory: std::result::Result<M::Memory, String>) {
        let before = std::mem::replace(&mut self.memory, memory);
        self.owner.alone(|_| drop(before));
    }
}

impl<M: StreamModel> DeviceState for State<M> {
    fn duplicate(&self) -> Box<dyn DeviceState> {
        Box::new(Self { owner: self.owner.clone(), memory: self.copy_of(self) })
    }

    fn copy_from(&mut self, other: &dyn DeviceState) {
        let copied = match (&self.memory, memory_of::<M>(other)) {
            (Ok(to), Ok(from)) if to.resembles(from) => self.owner.attempt(|_| to.copy_from(from)),
            _ => return self.replace(self.copy_of(other)),
        };
        if let Err(reason) = copied {
            self.memory = Err(reason.to_string());
        }
    }

    fn forget(&mut self) {
        if let Ok(memory) = &self.memory
            && let Err(reason) = self.owner.attempt(|_| memory.clear())
        {
            self.memory = Err(reason.to_string());
        }
    }

    fn numbers(&self) -> Vec<f32> {
        let memory = self.memory.as_ref().ok();
        memory.and_then(|memory| self.owner.attempt(|_| memory.numbers()).ok()).unwrap_or_default()
    }
}

/// The threads that copy between the program's memory and the device's: this many, otherwise one per core, at most `most`.
pub(crate) fn copy_threads(threads: Option<NonZeroUsize>, most: usize) -> ThreadPool {
    let usual = || thread::available_parallelism().map_or(1, NonZeroUsize::get).min(most);
    ThreadPool::new("copies", threads.map_or_else(usual, NonZeroUsize::get), 1)
}

/// Positions and velocities side by side, from particle `first` on.
pub(crate) fn copy_bodies(frame: &FrameView<'_>, first: usize, bodies: &mut [Body]) {
    if let Particles::Lists { position, velocity, .. } = frame.particles {
        let pairs = position[first..].iter().zip(&velocity[first..]);
        for (body, (&[x, y], &[vx, vy])) in bodies.iter_mut().zip(pairs) {
            *body = [x, y, vx, vy];
        }
        return;
    }
    for (particle, body) in (first..).zip(bodies) {
        let ([x, y], [vx, vy]) = frame.particles.motion(particle);
        *body = [x, y, vx, vy];
    }
}

/// The same way back.
pub(crate) fn copy_motion(bodies: &[Body], position: &mut [[f32; 2]], velocity: &mut [[f32; 2]]) {
    for ((position, velocity), &[x, y, vx, vy]) in position.iter_mut().zip(velocity).zip(bodies) {
        (*position, *velocity) = ([x, y], [vx, vy]);
    }
}
