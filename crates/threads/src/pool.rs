//! The threads, and the two kinds of jobs that they run.

use std::{
    cell::UnsafeCell,
    fmt, hint, io, panic,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    thread::{self, JoinHandle},
};

use super::{BARRIER_SPINS, SPINS, wait_until};

/// Bits of `Shared::gate` that count the threads inside the job.
const INSIDE: u64 = (1 << 32) - 1;
/// Bit of `Shared::gate` that lets threads join the job.
const OPEN: u64 = 1 << 32;
/// Lowest bit of the job's number in `Shared::gate`.
const NUMBER: u32 = 33;

/// One item of a job.
#[derive(Clone, Copy, Debug)]
pub struct Task {
    /// The stage, counted from 0.
    pub stage: usize,
    /// The item, counted from 0 in each stage.
    pub item: usize,
    /// The thread that executes it, below [`ThreadPool::threads`]: an index for scratch buffers, because tasks
    /// that run at the same time have different ones.
    pub thread: usize,
}

/// What each thread executes, given its number. Borrowed until [`ThreadPool::execute`] returns.
type Job<'a> = dyn Fn(usize) + Sync + 'a;

/// A number of threads, including the caller's.
pub struct ThreadPool {
    shared: Arc<Shared>,
    workers: Vec<JoinHandle<()>>,
    /// Kept from job to job, so that running one allocates nothing.
    stages: Vec<Stage>,
    spawn_error: Option<io::Error>,
}

/// Counters of a stage. Aligned to cache lines of its own: all threads write them.
#[repr(align(128))]
#[derive(Default)]
struct Stage {
    items: usize,
    /// Items taken so far; each thread that finds none left adds one more.
    taken: AtomicUsize,
    done: AtomicUsize,
}

struct Shared {
    /// The job's number, whether threads may join it, and how many workers are inside.
    gate: AtomicU64,
    /// Written while the gate is closed and no worker inside, read by workers inside.
    job: UnsafeCell<Option<*const Job<'static>>>,
    /// A thread has panicked: the job cannot be completed.
    broken: AtomicBool,
    /// Workers that have started.
    ready: AtomicUsize,
    shut_down: AtomicBool,
}

// SAFETY: `job` is written only by the thread in `ThreadPool::execute` (one at a time: it takes `&mut self`), while
// the gate is closed and no worker inside; workers read it inside, after they have seen the gate open.
unsafe impl Sync for Shared {}
// SAFETY: the pointer in `job` is dereferenced only inside an open gate, and `ThreadPool::execute` keeps the job,
// which is `Sync`, borrowed while the gate is open.
unsafe impl Send for Shared {}

impl ThreadPool {
    /// A pool of `threads` threads including the caller's; workers are named `name-1`, `name-2`, ... Where the
    /// system starts no more, there are fewer, see [`ThreadPool::spawn_error`]. Jobs of up to `stages` stages
    /// allocate nothing.
    pub fn new(name: &str, threads: usize, stages: usize) -> Self {
        let shared = Arc::new(Shared {
            gate: AtomicU64::new(0),
            job: UnsafeCell::new(None),
            broken: AtomicBool::new(false),
            ready: AtomicUsize::new(0),
            shut_down: AtomicBool::new(false),
        });
        let (mut workers, mut spawn_error) = (Vec::new(), None);
        for number in 1..threads {
            let shared = Arc::clone(&shared);
            let builder = thread::Builder::new().name(format!("{name}-{number}"));
            match builder.spawn(move || shared.work(number)) {
                Ok(worker) => workers.push(worker),
                Err(error) => {
                    spawn_error = Some(error);
                    break;
                }
            }
        }
        // A thread allocates while it starts: wait until that is over.
        wait_until(SPINS, || shared.ready.load(Ordering::Acquire) == workers.len());
        Self {
            shared,
            workers,
            stages: (0..stages).map(|_| Stage::default()).collect(),
            spawn_error,
        }
    }

    /// Number of threads, including the caller's.
    pub fn threads(&self) -> usize {
        self.workers.len() + 1
    }

    /// Why there are fewer threads than requested.
    pub fn spawn_error(&self) -> Option<&io::Error> {
        self.spawn_error.as_ref()
    }

    /// Executes `work` for each item of each stage; `stages` has the number of items of each. The items of a
    /// stage run in any order on any thread, after all items of the stage before, whose writes they see. With
    /// `inline`, everything runs on the calling thread: for jobs too small to wake the others.
    ///
    /// # Panics
    /// When `work` panics, on any thread.
    pub fn run(
        &mut self,
        stages: impl IntoIterator<Item = usize>,
        inline: bool,
        work: &(dyn Fn(Task) + Sync),
    ) {
        let mut length = 0;
        for items in stages {
            if length == self.stages.len() {
                self.stages.push(Stage::default());
            }
            self.stages[length] = Stage { items, ..Stage::default() };
            length += 1;
        }
        let (stages, broken) = (&self.stages[..length], &self.shared.broken);
        let job = |thread| run_stages(stages, broken, thread, work);
        if inline || self.workers.is_empty() {
            broken.store(false, Ordering::Relaxed);
            job(0);
        } else {
            Self::execute(&self.shared, &self.workers, &job);
        }
    }

    /// Calls `work` once on each of the first `threads` threads at the same time, with the number of the thread and
    /// a barrier for all of them.
    ///
    /// # Panics
    /// When `work` panics, on any thread, or `threads` exceeds [`ThreadPool::threads`].
    pub fn broadcast(&mut self, threads: usize, work: &(dyn Fn(usize, &Barrier<'_>) + Sync)) {
        assert!(threads <= self.threads(), "{threads} threads of {}", self.threads());
        let Self { shared, workers, .. } = self;
        let barrier = Barrier::new(threads, &shared.broken);
        if threads <= 1 {
            shared.broken.store(false, Ordering::Relaxed);
            work(0, &barrier);
            return;
        }
        Self::execute(shared, &workers[..threads - 1], &|thread| {
            if thread < threads {
                work(thread, &barrier);
                // The caller must not close the gate before all have joined.
                barrier.wait();
            }
        });
    }

    /// Calls `job` on the calling thread and on those workers that join before it returns.
    fn execute(shared: &Shared, workers: &[JoinHandle<()>], job: &Job<'_>) {
        shared.broken.store(false, Ordering::Relaxed);
        // SAFETY: only the lifetime changes; `closing` below ends every use of the pointer before this function
        // returns or unwinds, and so before the borrow ends.
        let pointer = unsafe { std::mem::transmute::<&Job<'_>, *const Job<'static>>(job) };
        // SAFETY: the gate is closed and no worker inside, since the last job's `Closing` was dropped.
        unsafe { *shared.job.get() = Some(pointer) };
        let number = (shared.gate.load(Ordering::Relaxed) >> NUMBER) + 1;
        shared.gate.store(number << NUMBER | OPEN, Ordering::Release);
        let closing = Closing(shared);
        for worker in workers {
            worker.thread().unpark();
        }
        job(0);
        drop(closing);
    }
}

impl Drop for ThreadPool {
    fn drop(&mut self) {
        self.shared.shut_down.store(true, Ordering::Release);
        for worker in self.workers.drain(..) {
            worker.thread().unpark();
            // A worker's panic has surfaced in `execute` already.
            let _ = worker.join();
        }
    }
}

impl fmt::Debug for ThreadPool {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("ThreadPool").field("threads", &self.threads()).finish_non_exhaustive()
    }
}

/// Closes the gate and waits until every worker has left, also when the calling thread panics.
struct Closing<'a>(&'a Shared);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            self.0.broken.store(true, Ordering::Release);
        }
        self.0.gate.fetch_and(!OPEN, Ordering::AcqRel);
        wait_until(SPINS, || self.0.gate.load(Ordering::Acquire) & INSIDE == 0);
    }
}

impl Shared {
    /// The main loop of a worker.
    fn work(&self, thread: usize) {
        self.ready.fetch_add(1, Ordering::Release);
        let mut last = 0;
        while let Some(number) = self.join_next(last) {
            last = number;
            // SAFETY: inside an open gate, see `Shared::job`.
            let job = unsafe { *self.job.get() };
            let outcome = panic::catch_unwind(panic::AssertUnwindSafe(|| {
                if let Some(job) = job {
                    // SAFETY: the caller waits in `Closing` until this thread has left.
                    unsafe { (*job)(thread) };
                }
            }));
            if outcome.is_err() {
                self.broken.store(true, Ordering::Release);
            }
            self.gate.fetch_sub(1, Ordering::Release);
        }
    }

    /// Waits for a job after number `last` and joins it. `None` when the pool shuts down.
    fn join_next(&self, last: u64) -> Option<u64> {
        let mut spins = 0;
        loop {
            let gate = self.gate.load(Ordering::Acquire);
            if gate & OPEN != 0 && gate >> NUMBER != last {
                let joined =
                    self.gate.compare_exchange(gate, gate + 1, Ordering::AcqRel, Ordering::Relaxed);
                if joined.is_ok() {
                    return Some(gate >> NUMBER);
                }
            } else if self.shut_down.load(Ordering::Acquire) {
                return None;
            } else if spins < SPINS {
                spins += 1;
                hint::spin_loop();
            } else {
                // Whoever opens the gate unparks; an `unpark` since the last check makes this return at once.
                thread::park();
                spins = 0;
            }
        }
    }
}

/// Takes items until all stages are done.
fn run_stages(stages: &[Stage], broken: &AtomicBool, thread: usize, work: &(dyn Fn(Task) + Sync)) {
    for (number, stage) in stages.iter().enumerate() {
        loop {
            let item = stage.taken.fetch_add(1, Ordering::Relaxed);
            if item >= stage.items {
                break;
            }
            work(Task { stage: number, item, thread });
            stage.done.fetch_add(1, Ordering::Release);
        }
        // Acquire pairs with the release above: the next stage sees the writes of this one.
        wait_until(SPINS, || {
            assert!(!broken.load(Ordering::Acquire), "another thread panicked");
            stage.done.load(Ordering::Acquire) == stage.items
        });
    }
}

/// Where the threads of a [`ThreadPool::broadcast`] wait for each other.
#[derive(Debug)]
pub struct Barrier<'a> {
    threads: usize,
    arrived: AtomicUsize,
    round: AtomicUsize,
    broken: &'a AtomicBool,
}

impl<'a> Barrier<'a> {
    fn new(threads: usize, broken: &'a AtomicBool) -> Self {
        Self { threads, arrived: AtomicUsize::new(0), round: AtomicUsize::new(0), broken }
    }

    /// Waits until every thread has arrived. What each wrote before is visible to all afterwards.
    ///
    /// # Panics
    /// When another thread panicked.
    pub fn wait(&self) {
        if self.threads <= 1 {
            return;
        }
        let round = self.round.load(Ordering::Relaxed);
        if self.arrived.fetch_add(1, Ordering::AcqRel) + 1 == self.threads {
            self.arrived.store(0, Ordering::Relaxed);
            self.round.store(round + 1, Ordering::Release);
            return;
        }
        wait_until(BARRIER_SPINS, || {
            assert!(!self.broken.load(Ordering::Acquire), "another thread panicked");
            self.round.load(Ordering::Acquire) != round
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DisjointSlice;

    #[test]
    fn every_item_is_executed_once_and_stages_follow_each_other() {
        for threads in [1, 2, 5] {
            let mut pool = ThreadPool::new("test", threads, 3);
            for round in 0..300 {
                let items = [7, 0, 1 + round % 13];
                let mut first = [0u32; 7];
                let mut sums = [0u32; 13];
                let (written, summed) =
                    (DisjointSlice::new(&mut first), DisjointSlice::new(&mut sums));
                pool.run(items, round % 3 == 0, &|task: Task| {
                    // SAFETY: each item of stage 0 writes its own element; those of stage 2 only read
                    // these and write their own sum.
                    unsafe {
                        match task.stage {
                            0 => written.part(task.item..task.item + 1)[0] += 1 + task.item as u32,
                            _ => {
                                let sum = written.read(0..7).iter().sum::<u32>();
                                summed.part(task.item..task.item + 1)[0] += sum;
                            }
                        }
                    }
                });
                assert_eq!(first, [1, 2, 3, 4, 5, 6, 7]);
                assert!(sums[..items[2]].iter().all(|&sum| sum == 28), "{sums:?}");
            }
        }
    }

    #[test]
    fn a_panic_on_any_thread_reaches_the_caller_and_the_pool_stays_usable() {
        for culprit in [0, 1] {
            let mut pool = ThreadPool::new("test", 2, 1);
            let met = AtomicUsize::new(0);
            let outcome = panic::catch_unwind(panic::AssertUnwindSafe(|| {
                pool.run([2], false, &|task: Task| {
                    // Both threads are at work before one of them panics.
                    met.fetch_add(1, Ordering::SeqCst);
                    wait_until(SPINS, || met.load(Ordering::SeqCst) == 2);
                    assert!(task.thread != culprit, "on purpose");
                });
            }));
            assert!(outcome.is_err(), "thread {culprit}");

            let done = AtomicUsize::new(0);
            pool.run([9], false, &|_| {
                done.fetch_add(1, Ordering::SeqCst);
            });
            assert_eq!(done.into_inner(), 9);
        }
    }

    #[test]
    fn threads_of_a_broadcast_meet_and_see_what_the_others_wrote() {
        let mut pool = ThreadPool::new("test", 4, 0);
        for threads in [3, 1, 4] {
            let sums = [AtomicUsize::new(0), AtomicUsize::new(0)];
            let called = AtomicUsize::new(0);
            pool.broadcast(threads, &|thread, barrier| {
                called.fetch_add(1 << (8 * thread), Ordering::Relaxed);
                for round in 0..200 {
                    sums[round % 2].fetch_add(1, Ordering::Relaxed);
                    barrier.wait();
                    assert_eq!(sums[round % 2].load(Ordering::Relaxed), threads);
                    barrier.wait();
                    if thread == 0 {
                        sums[round % 2].store(0, Ordering::Relaxed);
                    }
                }
            });
            assert_eq!(called.into_inner(), 0x0101_0101 & ((1 << (8 * threads)) - 1));
        }
    }

    #[test]
    fn a_panic_in_a_broadcast_ends_all_threads_and_the_pool_stays_usable() {
        for culprit in [0, 1] {
            let mut pool = ThreadPool::new("test", 2, 1);
            let outcome = panic::catch_unwind(panic::AssertUnwindSafe(|| {
                pool.broadcast(2, &|thread, barrier| {
                    assert!(thread != culprit, "on purpose");
                    barrier.wait();
                });
            }));
            assert!(outcome.is_err(), "thread {culprit}");
            let done = AtomicUsize::new(0);
            pool.broadcast(2, &|_, _| {
                done.fetch_add(1, Ordering::SeqCst);
            });
            assert_eq!(done.into_inner(), 2);
        }
    }

    #[test]
    fn shares_are_disjoint_and_complete() {
        for threads in 1..6 {
            let all: Vec<usize> = (0..threads).flat_map(|t| crate::share(17, t, threads)).collect();
            assert!(all.into_iter().eq(0..17));
        }
    }
}
