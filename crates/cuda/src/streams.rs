//! Streams predicted on a device, as the streaming engine uses them.
//!
//! A step of many streams takes little longer than one of a single stream. Threads that step streams of their own, as in an
//! evaluation, therefore leave their steps in a queue while the device is busy; who has it next takes all of them together.

#![expect(unsafe_code, reason = "steps of threads that wait for them")]

use std::{
    any::Any,
    collections::VecDeque,
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

/// A network on a device, as the streaming engine uses it. Steps that come from several threads at the same time are taken
/// together. After a failure of the device every step fails with it.
pub struct Streams<M: StreamModel>(Arc<Inner<M>>);

struct Inner<M: StreamModel> {
    device: Mutex<Shared<M>>,
    /// Steps of threads that wait for the device.
    waiting: Mutex<VecDeque<Arc<Waiting<M>>>>,
}

struct Shared<M> {
    model: M,
    failure: Option<String>,
}

/// The steps of a thread that waits until they are done.
struct Waiting<M: StreamModel> {
    /// Rows of the waiting thread, which are there as long as this is in the queue or in the hands of the one who has the device.
    rows: *mut [Step<'static, M::Memory>],
    outcome: Mutex<Option<std::result::Result<(), ModelError>>>,
}

// SAFETY: the rows are used by the thread that has the device, while their own thread waits; memories are `Sync`, frames `Send`.
unsafe impl<M: StreamModel> Send for Waiting<M> {}
// SAFETY: as above.
unsafe impl<M: StreamModel> Sync for Waiting<M> {}

impl<M: StreamModel> Waiting<M> {
    /// The outcome, once there is one.
    fn take_outcome(&self) -> Option<std::result::Result<(), ModelError>> {
        lock(&self.outcome).take()
    }

    fn finish(&self, outcome: std::result::Result<(), ModelError>) {
        *lock(&self.outcome) = Some(outcome);
    }

    /// The rows.
    ///
    /// # Safety
    /// The device must be this thread's, since before these steps were taken from the queue.
    unsafe fn rows(&self) -> impl Iterator<Item = Step<'_, M::Memory>> {
        // SAFETY: their thread waits for the device, and no other has it.
        let rows = unsafe { &mut *self.rows };
        rows.iter_mut().map(|(memory, frame, next)| (*memory, *frame, &mut **next))
    }
}

/// Takes steps out of the queue when their thread leaves, as it does when a step panics.
struct Queued<'a, M: StreamModel> {
    streams: &'a Streams<M>,
    own: &'a Arc<Waiting<M>>,
}

impl<M: StreamModel> Drop for Queued<'_, M> {
    fn drop(&mut self) {
        if !thread::panicking() {
            return; // it has left the queue with its outcome
        }
        // Whoever has taken these steps meanwhile is done with them before.
        let _device = self.streams.shared();
        lock(&self.streams.0.waiting).retain(|waiting| !Arc::ptr_eq(waiting, self.own));
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(|broken| broken.into_inner())
}

impl<M: StreamModel> Clone for Streams<M> {
    fn clone(&self) -> Self {
        Self(Arc::clone(&self.0))
    }
}

impl<M: StreamModel> Shared<M> {
    /// Runs `work`, unless the device has failed; keeps its failure.
    fn attempt<T>(
        &mut self,
        work: impl FnOnce(&mut M) -> Result<T>,
    ) -> std::result::Result<T, ModelError> {
        let Self { model, failure } = self;
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

    /// One frame of each row, as many together as the network takes. Returns the rows that failed, in order.
    fn step(&mut self, rows: &mut [Step<'_, M::Memory>]) -> Vec<(usize, ModelError)> {
        let mut failed = Vec::new();
        let mut first = 0;
        while first < rows.len() {
            let end = rows.len().min(first + M::MOST);
            let count = self.model.batch(&rows[first..end]);
            let now = &mut rows[first..first + count];
            match self.attempt(|model| model.step(now)) {
                Ok(()) => {}
                Err(reason) if count == 1 => failed.push((first, reason)),
                // Too large together, perhaps, but not one by one.
                Err(_) => failed.extend(now.chunks_mut(1).zip(first..).filter_map(|(one, row)| {
                    Some((row, self.attempt(|model| model.step(one)).err()?))
                })),
            }
            first += count;
        }
        failed
    }
}

impl<M: StreamModel> Streams<M> {
    /// Of a network on a device.
    pub fn new(model: M) -> Self {
        let device = Mutex::new(Shared { model, failure: None });
        Self(Arc::new(Inner { device, waiting: Mutex::new(VecDeque::new()) }))
    }

    fn shared(&self) -> MutexGuard<'_, Shared<M>> {
        lock(&self.0.device)
    }

    /// The first of the waiting steps, and as many after them as fit beside them.
    fn take_waiting(&self) -> Vec<Arc<Waiting<M>>> {
        let mut waiting = lock(&self.0.waiting);
        let mut taken = Vec::new();
        let mut rows = 0;
        while let Some(next) = waiting.front() {
            rows += next.rows.len();
            if rows > M::MOST && !taken.is_empty() {
                break;
            }
            taken.extend(waiting.pop_front());
        }
        taken
    }

    /// Takes the steps of several threads together.
    fn step_waiting(device: &mut Shared<M>, all: &[Arc<Waiting<M>>]) {
        // Should the step panic, no thread waits for ever.
        let lost = || Err(ModelError::Device("a step of another stream has panicked".to_owned()));
        all.iter().for_each(|waiting| waiting.finish(lost()));
        // SAFETY: the device is this thread's, and the others see their outcomes only after it.
        let rows_of = |waiting: &Arc<Waiting<M>>| unsafe { (*Arc::as_ptr(waiting)).rows() };
        let mut together: Vec<_> = all.iter().flat_map(rows_of).collect();
        let mut failed = device.step(&mut together).into_iter().peekable();
        let mut end = 0;
        for waiting in all {
            end += waiting.rows.len();
            let mut outcome = Ok(());
            while let Some((_, reason)) = failed.next_if(|&(row, _)| row < end) {
                outcome = outcome.and(Err(reason));
            }
            waiting.finish(outcome);
        }
    }

    /// Runs `work` beside no other work.
    pub(crate) fn alone<T>(&self, work: impl FnOnce(&mut M) -> T) -> T {
        work(&mut self.shared().model)
    }

    /// As [`Shared::attempt`].
    fn attempt<T>(
        &self,
        work: impl FnOnce(&mut M) -> Result<T>,
    ) -> std::result::Result<T, ModelError> {
        self.shared().attempt(work)
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
        let rows: *mut [Step<'_, M::Memory>] = rows.as_mut_slice();
        // The rows outlive their use: this function returns once they have an outcome.
        #[expect(clippy::unnecessary_cast, reason = "it changes the lifetime")]
        let rows = rows as *mut [Step<'static, M::Memory>];
        let own = Arc::new(Waiting::<M> { rows, outcome: Mutex::new(None) });
        lock(&self.0.waiting).push_back(Arc::clone(&own));
        let _queued = Queued { streams: self, own: &own };
        loop {
            let mut device = self.shared();
            // Another thread may have taken these steps with its own.
            if let Some(outcome) = own.take_outcome() {
                return outcome;
            }
            let taken = self.take_waiting();
            Self::step_waiting(&mut device, &taken);
        }
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

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, Sender, channel};

    use super::*;
    use eddy_frames::{Domain, Material, Stamp, clock::Clock};

    /// Remembers nothing.
    struct Nothing;

    impl StreamMemory for Nothing {
        fn duplicate(&self) -> Result<Self> {
            Ok(Self)
        }

        fn resembles(&self, _: &Self) -> bool {
            true
        }

        fn copy_from(&self, _: &Self) -> Result<()> {
            Ok(())
        }

        fn clear(&self) -> Result<()> {
            Ok(())
        }

        fn numbers(&self) -> Result<Vec<f32>> {
            Ok(Vec::new())
        }
    }

    /// Adds 1 to positions. A step tells how many rows it has, and then waits for a word; without one it panics.
    struct Counter {
        rows: Sender<usize>,
        go: Receiver<()>,
    }

    impl StreamModel for Counter {
        type Memory = Nothing;

        const MOST: usize = 3;

        fn memory(&mut self, _: &StreamStart<'_>) -> Result<Nothing> {
            Ok(Nothing)
        }

        fn step(&mut self, steps: &mut [Step<'_, Nothing>]) -> Result<()> {
            self.rows.send(steps.len()).unwrap();
            self.go.recv().unwrap();
            for (_, frame, next) in steps {
                next.position[0] = frame.particles.motion(0).0.map(|x| x + 1.0);
            }
            Ok(())
        }
    }

    fn frame(x: f32) -> Frame {
        Frame {
            stream: 1,
            sequence: 0,
            stamp: Stamp::default(),
            dt: 0.016,
            domain: Domain::UNIT,
            position: vec![[x; 2]],
            velocity: vec![[0.0; 2]],
            material: vec![Material::Liquid],
        }
    }

    /// One step of a stream at x.
    fn step(streams: &Streams<Counter>, x: f32) -> std::result::Result<f32, ModelError> {
        // Without the device, which another step may have.
        let mut state = State::<Counter> { owner: streams.clone(), memory: Ok(Nothing) };
        let (frame, mut next) = (frame(x), frame(x));
        let mut steps = [DeviceStep { state: &mut state, frame: (&frame).into(), next: &mut next }];
        let outcome = streams.step(&mut steps);
        // Nothing is given back to the device.
        std::mem::forget(state);
        outcome.map(|()| next.position[0][0])
    }

    /// Waits until so many steps are in the queue.
    fn wait_for(streams: &Streams<Counter>, queued: usize) {
        let clock = Clock::start();
        while lock(&streams.0.waiting).len() != queued {
            assert!(clock.now().as_secs() < 30, "{queued} steps are not in the queue");
            thread::yield_now();
        }
    }

    fn counter() -> (Streams<Counter>, Receiver<usize>, Sender<()>) {
        let ((rows, counts), (word, go)) = (channel(), channel());
        (Streams::new(Counter { rows, go }), counts, word)
    }

    #[test]
    fn steps_that_come_while_the_device_is_busy_are_taken_together() {
        let (streams, counts, word) = counter();
        thread::scope(|scope| {
            let asked = |x: f32| {
                let streams = &streams;
                scope.spawn(move || step(streams, x))
            };
            let first = asked(0.0);
            assert_eq!(counts.recv().unwrap(), 1);
            let others: Vec<_> = (1..6).map(|x| asked(x as f32)).collect();
            wait_for(&streams, 5);
            (0..3).for_each(|_| word.send(()).unwrap());
            assert_eq!(first.join().unwrap().unwrap(), 1.0);
            for (x, other) in (1..6).zip(others) {
                assert_eq!(other.join().unwrap().unwrap(), (x + 1) as f32);
            }
            // Three at most.
            assert_eq!(counts.try_iter().collect::<Vec<_>>(), [3, 2]);
        });
    }

    #[test]
    fn a_step_that_panics_fails_those_beside_it_and_lets_nobody_wait() {
        let (streams, counts, word) = counter();
        thread::scope(|scope| {
            let asked = |x: f32| {
                let streams = &streams;
                scope.spawn(move || step(streams, x))
            };
            let first = asked(0.0);
            assert_eq!(counts.recv().unwrap(), 1);
            let others: Vec<_> = (1..4).map(|x| asked(x as f32)).collect();
            wait_for(&streams, 3);
            word.send(()).unwrap();
            drop(word);
            assert_eq!(first.join().unwrap().unwrap(), 1.0);
            let outcomes: Vec<_> = others.into_iter().map(thread::ScopedJoinHandle::join).collect();
            let panicked = outcomes.iter().filter(|outcome| outcome.is_err()).count();
            let said = |outcome: &std::result::Result<f32, ModelError>| {
                outcome.as_ref().unwrap_err().to_string().contains("has panicked")
            };
            assert_eq!(panicked, 1);
            assert!(outcomes.iter().flatten().all(said));
            assert!(lock(&streams.0.waiting).is_empty());
        });
    }
}
