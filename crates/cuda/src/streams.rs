//! Streams predicted on a device, as the streaming engine uses them.
//!
//! A step of many streams takes little longer than one of a single stream. Threads that step streams of their own, as in an
//! evaluation, therefore leave their steps in a queue while the device is busy; one of them then takes all that wait together.

#![expect(unsafe_code, reason = "steps of threads that wait for them")]

use std::{
    any::Any,
    collections::VecDeque,
    num::NonZeroUsize,
    sync::{Arc, Condvar, Mutex, MutexGuard},
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
    queue: Mutex<Queue<M>>,
    /// Steps that were taken have an outcome.
    done: Condvar,
}

/// Steps of threads that wait for their outcome.
struct Queue<M: StreamModel> {
    waiting: VecDeque<Arc<Waiting<M>>>,
    /// Whether a thread is taking steps.
    busy: bool,
}

struct Shared<M> {
    model: M,
    failure: Option<String>,
}

/// The steps of a thread that waits for their outcome.
struct Waiting<M: StreamModel> {
    rows: Rows<M>,
    outcome: Mutex<Option<std::result::Result<(), ModelError>>>,
}

/// Rows of a waiting thread, which are there until it has an outcome.
struct Rows<M: StreamModel>(*mut [Step<'static, M::Memory>]);

// SAFETY: one thread uses the rows while their own waits; memories are `Sync`, frames `Send`.
unsafe impl<M: StreamModel> Send for Rows<M> {}
// SAFETY: as above.
unsafe impl<M: StreamModel> Sync for Rows<M> {}

impl<M: StreamModel> Waiting<M> {
    fn finish(&self, outcome: std::result::Result<(), ModelError>) {
        *lock(&self.outcome) = Some(outcome);
    }

    /// The rows.
    ///
    /// # Safety
    /// This thread must have taken these steps from the queue, and they must have no outcome yet.
    unsafe fn rows(&self) -> impl Iterator<Item = Step<'_, M::Memory>> {
        // SAFETY: their thread waits, and no other has them.
        let rows = unsafe { &mut *self.rows.0 };
        rows.iter_mut().map(|(memory, frame, next)| (*memory, *frame, &mut **next))
    }
}

impl<M: StreamModel> Queue<M> {
    /// The first of the waiting steps, and as many after them as fit beside them.
    fn take(&mut self) -> Vec<Arc<Waiting<M>>> {
        let mut taken = Vec::new();
        let mut rows = 0;
        while let Some(next) = self.waiting.front() {
            rows += next.rows.0.len();
            if rows > M::MOST && !taken.is_empty() {
                break;
            }
            taken.extend(self.waiting.pop_front());
        }
        taken
    }
}

/// Steps of several threads that one of them takes together.
struct Batch<'a, M: StreamModel> {
    streams: &'a Inner<M>,
    /// The steps of the thread that takes them, which may be still in the queue.
    own: &'a Arc<Waiting<M>>,
    taken: Vec<Arc<Waiting<M>>>,
}

impl<M: StreamModel> Batch<'_, M> {
    fn run(&mut self) {
        // SAFETY: they were taken from the queue, and have an outcome at the end.
        let rows_of = |waiting: &Arc<Waiting<M>>| unsafe { (*Arc::as_ptr(waiting)).rows() };
        let mut together: Vec<_> = self.taken.iter().flat_map(rows_of).collect();
        let mut failed = lock(&self.streams.device).step(&mut together).into_iter().peekable();
        drop(together);
        let mut end = 0;
        for waiting in self.taken.drain(..) {
            end += waiting.rows.0.len();
            let mut outcome = Ok(());
            while let Some((_, reason)) = failed.next_if(|&(row, _)| row < end) {
                outcome = outcome.and(Err(reason));
            }
            waiting.finish(outcome);
        }
    }
}

impl<M: StreamModel> Drop for Batch<'_, M> {
    /// Lets the other threads go on, also where a step has panicked.
    fn drop(&mut self) {
        let mut queue = lock(&self.streams.queue);
        if thread::panicking() {
            // Their thread leaves without an outcome.
            queue.waiting.retain(|waiting| !Arc::ptr_eq(waiting, self.own));
        }
        for waiting in &self.taken {
            let lost = "a step of another stream has panicked".to_owned();
            waiting.finish(Err(ModelError::Device(lost)));
        }
        queue.busy = false;
        self.streams.done.notify_all();
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
        Self(Arc::new(Inner {
            device: Mutex::new(Shared { model, failure: None }),
            queue: Mutex::new(Queue { waiting: VecDeque::new(), busy: false }),
            done: Condvar::new(),
        }))
    }

    fn shared(&self) -> MutexGuard<'_, Shared<M>> {
        lock(&self.0.device)
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
        let own = Arc::new(Waiting { rows: Rows(rows), outcome: Mutex::new(None) });
        let Inner { queue: waiting, done, .. } = &*self.0;
        let mut queue = lock(waiting);
        queue.waiting.push_back(Arc::clone(&own));
        loop {
            if let Some(outcome) = lock(&own.outcome).take() {
                return outcome;
            }
            if queue.busy {
                queue = done.wait(queue).unwrap_or_else(|broken| broken.into_inner());
                continue;
            }
            queue.busy = true;
            let mut batch = Batch { streams: &self.0, own: &own, taken: queue.take() };
            drop(queue);
            batch.run();
            drop(batch);
            queue = lock(waiting);
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
    use std::{
        sync::mpsc::{Receiver, Sender, channel},
        thread::ScopedJoinHandle,
    };

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
    fn step(streams: &Streams<Counter>, x: f32) -> Outcome {
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
        while lock(&streams.0.queue).waiting.len() != queued {
            assert!(clock.now().as_secs() < 30, "{queued} steps are not in the queue");
            thread::yield_now();
        }
    }

    /// The position after a step.
    type Outcome = std::result::Result<f32, ModelError>;

    /// Steps of streams at 0, 1, 2, .., of which the first has the device while the others come.
    fn step_together(
        others: usize,
        look: impl FnOnce(Receiver<usize>, Sender<()>, Vec<ScopedJoinHandle<'_, Outcome>>),
    ) {
        let ((rows, counts), (word, go)) = (channel(), channel());
        let streams = Streams::new(Counter { rows, go });
        thread::scope(|scope| {
            let streams = &streams;
            let asked = |x: usize| scope.spawn(move || step(streams, x as f32));
            let mut all = vec![asked(0)];
            assert_eq!(counts.recv().unwrap(), 1);
            all.extend((1..=others).map(asked));
            wait_for(streams, others);
            look(counts, word, all);
        });
        let queue = lock(&streams.0.queue);
        assert!(queue.waiting.is_empty() && !queue.busy);
    }

    #[test]
    fn steps_that_come_while_the_device_is_busy_are_taken_together() {
        step_together(5, |counts, word, all| {
            (0..3).for_each(|_| word.send(()).unwrap());
            for (x, one) in all.into_iter().enumerate() {
                assert_eq!(one.join().unwrap().unwrap(), (x + 1) as f32);
            }
            // Three at most.
            assert_eq!(counts.try_iter().collect::<Vec<_>>(), [3, 2]);
        });
    }

    #[test]
    fn a_step_that_panics_fails_those_beside_it_and_lets_nobody_wait() {
        // More than are taken at once: the thread of one that is still in the queue may be the one that panics.
        step_together(7, |_, word, all| {
            word.send(()).unwrap();
            drop(word);
            let mut all = all.into_iter().map(ScopedJoinHandle::join);
            assert_eq!(all.next().unwrap().unwrap().unwrap(), 1.0);
            let (ended, panicked): (Vec<_>, Vec<_>) = all.partition(|joined| joined.is_ok());
            let said = |outcome: &Outcome| {
                outcome.as_ref().unwrap_err().to_string().contains("has panicked")
            };
            // Three are taken each time; those of the thread that panics are among them or not.
            assert!((2..=3).contains(&panicked.len()), "{} of 7", panicked.len());
            assert!(ended.into_iter().flatten().all(|outcome| said(&outcome)));
        });
    }
}
