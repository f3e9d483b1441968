//! Threads that stay, and meet between the phases of a substep.

use std::{
    marker::PhantomData,
    ops::Range,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
};

use rayon::prelude::*;

/// Looks at the barrier before the processor is given to somebody else. A phase takes microseconds.
const SPINS: u32 = 100;

/// Lists that are worth the waking of other threads.
const LONG: usize = 1000;

/// A number of threads.
#[derive(Clone, Debug)]
pub(super) struct Team {
    pool: Option<Arc<rayon::ThreadPool>>,
}

impl Team {
    /// So many threads; with one, everything runs on the caller's, and so it does with a warning where
    /// the system gives none.
    pub(super) fn new(threads: usize) -> Self {
        let build = || rayon::ThreadPoolBuilder::new().num_threads(threads).build();
        let pool = match (threads > 1).then(build) {
            Some(Err(error)) => {
                tracing::warn!("the solver runs on one thread instead of {threads}: {error}");
                None
            }
            Some(Ok(pool)) => Some(Arc::new(pool)),
            None => None,
        };
        Self { pool }
    }

    /// How many threads there are.
    pub(super) fn threads(&self) -> usize {
        self.pool.as_ref().map_or(1, |pool| pool.current_num_threads())
    }

    /// Runs `work` on so many of the threads at once, with the thread's number and where they meet.
    pub(super) fn run(&self, threads: usize, work: impl Fn(usize, &Barrier) + Sync) {
        let barrier = Barrier::new(threads);
        match &self.pool {
            Some(pool) if threads > 1 => {
                pool.broadcast(|context| {
                    if context.index() < threads {
                        let _panic = Panic(&barrier);
                        work(context.index(), &barrier);
                    }
                });
            }
            _ => work(0, &barrier),
        }
    }

    /// Fills a list with what `make` gives for 0, 1, 2, ...
    pub(super) fn collect<T: Send>(
        &self,
        length: usize,
        make: impl Fn(usize) -> T + Sync + Send,
        into: &mut Vec<T>,
    ) {
        match &self.pool {
            Some(pool) if length > LONG => pool.install(|| {
                (0..length).into_par_iter().map(&make).collect_into_vec(into);
            }),
            _ => {
                into.clear();
                into.extend((0..length).map(make));
            }
        }
    }
}

/// The part of `0..length` that is this thread's, of so many threads.
pub(super) fn share(length: usize, thread: usize, threads: usize) -> Range<usize> {
    length * thread / threads..length * (thread + 1) / threads
}

/// Where threads wait for each other.
#[derive(Debug)]
pub(super) struct Barrier {
    threads: usize,
    arrived: AtomicUsize,
    round: AtomicUsize,
    /// A thread will not come any more.
    broken: AtomicBool,
}

/// Breaks the barrier if its thread panics, so that the others do not wait for ever.
struct Panic<'a>(&'a Barrier);

impl Drop for Panic<'_> {
    fn drop(&mut self) {
        if std::thread::panicking() {
            self.0.broken.store(true, Ordering::Release);
        }
    }
}

impl Barrier {
    fn new(threads: usize) -> Self {
        Self {
            threads,
            arrived: AtomicUsize::new(0),
            round: AtomicUsize::new(0),
            broken: AtomicBool::new(false),
        }
    }

    /// Waits until every thread is here. What each did before is seen by all afterwards. Panics where
    /// another thread has.
    pub(super) fn wait(&self) {
        if self.threads == 1 {
            return;
        }
        let round = self.round.load(Ordering::Relaxed);
        if self.arrived.fetch_add(1, Ordering::AcqRel) + 1 == self.threads {
            self.arrived.store(0, Ordering::Relaxed);
            self.round.store(round + 1, Ordering::Release);
            return;
        }
        let mut spins = 0;
        while self.round.load(Ordering::Acquire) == round {
            assert!(!self.broken.load(Ordering::Acquire), "another thread has panicked");
            if spins < SPINS {
                spins += 1;
                std::hint::spin_loop();
            } else {
                std::thread::yield_now();
            }
        }
    }
}

/// A slice that threads divide among themselves anew in every phase.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shared<'a, T> {
    start: *mut T,
    length: usize,
    slice: PhantomData<&'a mut [T]>,
}

// SAFETY: a `Shared` is a `&mut [T]` in parts; whoever takes a part answers for it.
unsafe impl<T: Send + Sync> Sync for Shared<'_, T> {}

impl<'a, T> Shared<'a, T> {
    /// Divides a slice.
    pub(super) fn new(slice: &'a mut [T]) -> Self {
        Self { start: slice.as_mut_ptr(), length: slice.len(), slice: PhantomData }
    }

    /// A part to write.
    ///
    /// # Safety
    /// Until the next meeting at the barrier no other thread uses any of it.
    #[expect(clippy::mut_from_ref, reason = "that is what the safety section is about")]
    pub(super) unsafe fn part(&self, range: Range<usize>) -> &mut [T] {
        assert!(range.start <= range.end && range.end <= self.length);
        // SAFETY: inside the slice; the caller answers for nobody else using it.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(range.start), range.len()) }
    }

    /// All of it to read.
    ///
    /// # Safety
    /// Until the next meeting at the barrier no thread writes any of it.
    pub(super) unsafe fn whole(&self) -> &[T] {
        // SAFETY: the slice itself; the caller answers for nobody writing it.
        unsafe { std::slice::from_raw_parts(self.start, self.length) }
    }
}

#[cfg(test)]
mod tests {
    use std::{panic, sync::atomic::AtomicU32};

    use super::*;

    #[test]
    fn threads_meet_and_see_what_the_others_did() {
        let sums = [AtomicU32::new(0), AtomicU32::new(0)];
        Team::new(3).run(3, |thread, barrier| {
            for round in 0..200 {
                sums[round % 2].fetch_add(1, Ordering::Relaxed);
                barrier.wait();
                assert_eq!(sums[round % 2].load(Ordering::Relaxed), 3);
                barrier.wait();
                if thread == 0 {
                    sums[round % 2].store(0, Ordering::Relaxed);
                }
            }
        });
    }

    #[test]
    fn a_panic_ends_all_threads() {
        let team = Team::new(2);
        let outcome = panic::catch_unwind(panic::AssertUnwindSafe(|| {
            team.run(2, |thread, barrier| {
                assert!(thread != 1, "on purpose");
                barrier.wait();
            });
        }));
        assert!(outcome.is_err());
    }
}
