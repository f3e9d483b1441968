//! Threads that stay, and share the items of a frame's stages.
//!
//! A job is a list of stages, a stage a number of items. Whoever is free takes the next item of the
//! stage; the next stage begins when every item of the last one is done. Which thread takes which item
//! differs from frame to frame, what an item computes does not. The caller's thread takes items like
//! all others, so that a thread the system holds up costs time but never stops the job.
//!
//! Nothing here allocates once the threads run: they spin for a while, then park.
#![expect(unsafe_code, reason = "threads write to disjoint parts of one slice")]

use std::{
    cell::UnsafeCell,
    hint,
    marker::PhantomData,
    ops::Range,
    panic,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering},
    },
    thread::{self, JoinHandle},
};

/// Looks at a flag before the processor is given to somebody else, some 20 microseconds.
const SPINS: u32 = 500;

/// Of [`Gate`]: how many threads of the crew are at work.
const INSIDE: u64 = (1 << 32) - 1;
/// Of [`Gate`]: whether threads may join.
const OPEN: u64 = 1 << 32;
/// Of [`Gate`]: where the job's number begins.
const NUMBER: u32 = 33;

/// One item of a job.
#[derive(Clone, Copy, Debug)]
pub(super) struct Task {
    /// The stage, counted from 0.
    pub(super) stage: usize,
    /// The item, counted from 0 in each stage.
    pub(super) item: usize,
    /// The thread that does it, 0 to [`Crew::threads`] - 1: no two at once have the same.
    pub(super) thread: usize,
}

/// What a job does for each item. It lives at least until [`Crew::run`] returns.
type Work<'a> = dyn Fn(Task) + Sync + 'a;

/// Threads, the caller's included.
pub(super) struct Crew {
    board: Arc<Board>,
    members: Vec<JoinHandle<()>>,
}

/// A stage of the running job. On cache lines of its own: all threads count here.
#[repr(align(128))]
#[derive(Default)]
struct Stage {
    items: AtomicUsize,
    /// Items that were taken, and then one for each thread that found none.
    taken: AtomicUsize,
    done: AtomicUsize,
}

/// What the threads share.
struct Board {
    /// Number of the job, whether it is open, and how many threads of the crew are inside.
    gate: AtomicU64,
    /// The open job. Written while the gate is shut and nobody inside, read by those inside.
    work: UnsafeCell<Option<*const Work<'static>>>,
    stages: Box<[Stage]>,
    /// Stages of the open job.
    length: AtomicUsize,
    /// A thread panicked at work: the stage of this job will never be done.
    broken: AtomicBool,
    /// Threads of the crew that have begun to wait for jobs.
    ready: AtomicUsize,
    /// The crew is dismissed.
    dismissed: AtomicBool,
}

// SAFETY: `work` is written by the thread in `Crew::run` (one at a time: it takes `&mut self`) only
// while the gate is shut and nobody inside; the others read it inside, after they saw the gate open.
unsafe impl Sync for Board {}
// SAFETY: the pointer in `work` is used inside an open gate only, and while a gate is open
// `Crew::run` keeps what it points to, which is `Sync`.
unsafe impl Send for Board {}

impl Crew {
    /// So many threads, for jobs of at most so many stages; fewer, with a warning, where the system
    /// gives no more.
    pub(super) fn new(threads: usize, stages: usize) -> Self {
        let board = Arc::new(Board {
            gate: AtomicU64::new(0),
            work: UnsafeCell::new(None),
            stages: (0..stages).map(|_| Stage::default()).collect(),
            length: AtomicUsize::new(0),
            broken: AtomicBool::new(false),
            ready: AtomicUsize::new(0),
            dismissed: AtomicBool::new(false),
        });
        let mut members = Vec::new();
        for number in 1..threads {
            let shared = Arc::clone(&board);
            let name = format!("engine-{number}");
            match thread::Builder::new().name(name).spawn(move || shared.serve(number)) {
                Ok(member) => members.push(member),
                Err(error) => {
                    tracing::warn!("the engine has {number} threads instead of {threads}: {error}");
                    break;
                }
            }
        }
        // The system allocates for a thread as it starts: that is over when jobs begin.
        wait_until(|| board.ready.load(Ordering::Acquire) == members.len());
        Self { board, members }
    }

    /// How many threads there are, the caller's included.
    pub(super) fn threads(&self) -> usize {
        self.members.len() + 1
    }

    /// Does `work` for each item of each stage; `stages` says how many items each has. With `alone`
    /// on the caller's thread only: for jobs too small to wake the others for.
    ///
    /// # Panics
    /// Where `work` does, on any thread.
    pub(super) fn run(
        &mut self,
        stages: impl IntoIterator<Item = usize>,
        alone: bool,
        work: &Work<'_>,
    ) {
        let board = &*self.board;
        let mut length = 0;
        for (stage, items) in board.stages.iter().zip(stages) {
            stage.items.store(items, Ordering::Relaxed);
            stage.taken.store(0, Ordering::Relaxed);
            stage.done.store(0, Ordering::Relaxed);
            length += 1;
        }
        board.length.store(length, Ordering::Relaxed);
        board.broken.store(false, Ordering::Relaxed);
        if alone || self.members.is_empty() {
            board.attend(0, work);
            return;
        }
        // SAFETY: only the lifetime changes; `closing` below ends every use of the pointer before
        // this function returns or unwinds, and so before the borrow ends.
        let pointer = unsafe { std::mem::transmute::<&Work<'_>, *const Work<'static>>(work) };
        // SAFETY: the gate is shut and nobody inside: the last job's `closing` saw to it.
        unsafe { *board.work.get() = Some(pointer) };
        let number = (board.gate.load(Ordering::Relaxed) >> NUMBER) + 1;
        board.gate.store(number << NUMBER | OPEN, Ordering::Release);
        let closing = Closing(board);
        for member in &self.members {
            member.thread().unpark();
        }
        board.attend(0, work);
        drop(closing);
    }
}

impl Drop for Crew {
    fn drop(&mut self) {
        self.board.dismissed.store(true, Ordering::Release);
        for member in self.members.drain(..) {
            member.thread().unpark();
            // A panic of a thread has surfaced in `run` already.
            let _ = member.join();
        }
    }
}

/// Shuts the gate and waits until everybody has left, also where the caller's thread panics.
struct Closing<'a>(&'a Board);

impl Drop for Closing<'_> {
    fn drop(&mut self) {
        if thread::panicking() {
            self.0.broken.store(true, Ordering::Release);
        }
        self.0.gate.fetch_and(!OPEN, Ordering::AcqRel);
        wait_until(|| self.0.gate.load(Ordering::Acquire) & INSIDE == 0);
    }
}

impl Board {
    /// The life of a thread: waits for jobs and takes part.
    fn serve(&self, thread: usize) {
        self.ready.fetch_add(1, Ordering::Release);
        let mut last = 0;
        while let Some(number) = self.enter(last) {
            last = number;
            // SAFETY: inside an open gate, see `Board::work`.
            let work = unsafe { *self.work.get() };
            let attended = panic::catch_unwind(panic::AssertUnwindSafe(|| {
                if let Some(work) = work {
                    // SAFETY: the caller waits in `Closing` until this thread has left.
                    self.attend(thread, unsafe { &*work });
                }
            }));
            if attended.is_err() {
                self.broken.store(true, Ordering::Release);
            }
            self.gate.fetch_sub(1, Ordering::Release);
        }
    }

    /// Waits for a job after number `last`, and joins it. `None` when the crew is dismissed.
    fn enter(&self, last: u64) -> Option<u64> {
        let mut spins = 0;
        loop {
            let gate = self.gate.load(Ordering::Acquire);
            if gate & OPEN != 0 && gate >> NUMBER != last {
                let joined =
                    self.gate.compare_exchange(gate, gate + 1, Ordering::AcqRel, Ordering::Relaxed);
                if joined.is_ok() {
                    return Some(gate >> NUMBER);
                }
            } else if self.dismissed.load(Ordering::Acquire) {
                return None;
            } else if spins < SPINS {
                spins += 1;
                hint::spin_loop();
            } else {
                // Whoever opens the gate unparks; one that came in between makes this return at once.
                thread::park();
                spins = 0;
            }
        }
    }

    /// Takes items until all stages are done.
    fn attend(&self, thread: usize, work: &Work<'_>) {
        let length = self.length.load(Ordering::Relaxed);
        for (number, stage) in self.stages[..length].iter().enumerate() {
            let items = stage.items.load(Ordering::Relaxed);
            loop {
                let item = stage.taken.fetch_add(1, Ordering::Relaxed);
                if item >= items {
                    break;
                }
                work(Task { stage: number, item, thread });
                stage.done.fetch_add(1, Ordering::Release);
            }
            // Acquire, against the release above: what the items of this stage wrote is seen next.
            wait_until(|| {
                assert!(!self.broken.load(Ordering::Acquire), "another thread has panicked");
                stage.done.load(Ordering::Acquire) == items
            });
        }
    }
}

fn wait_until(condition: impl Fn() -> bool) {
    let mut spins = 0;
    while !condition() {
        if spins < SPINS {
            spins += 1;
            hint::spin_loop();
        } else {
            thread::yield_now();
        }
    }
}

/// A slice that the items of a stage write in parts.
#[derive(Clone, Copy)]
pub(super) struct Parts<'a, T> {
    start: *mut T,
    length: usize,
    slice: PhantomData<&'a mut [T]>,
}

// SAFETY: a `Parts` is a `&mut [T]` in parts; whoever takes a part answers for it.
unsafe impl<T: Send + Sync> Sync for Parts<'_, T> {}

impl<'a, T> Parts<'a, T> {
    pub(super) fn new(slice: &'a mut [T]) -> Self {
        Self { start: slice.as_mut_ptr(), length: slice.len(), slice: PhantomData }
    }

    /// Length of the slice.
    #[inline(always)]
    pub(super) fn len(&self) -> usize {
        self.length
    }

    /// A part to write.
    ///
    /// # Safety
    /// While it lives, no other item uses any of it.
    #[inline(always)]
    #[expect(clippy::mut_from_ref, reason = "that is what the safety section is about")]
    pub(super) unsafe fn part(&self, range: Range<usize>) -> &mut [T] {
        assert!(range.start <= range.end && range.end <= self.length);
        // SAFETY: inside the slice; the caller answers for nobody else using it.
        unsafe { std::slice::from_raw_parts_mut(self.start.add(range.start), range.len()) }
    }

    /// A part to read.
    ///
    /// # Safety
    /// While it lives, no item writes any of it.
    #[inline(always)]
    pub(super) unsafe fn read(&self, range: Range<usize>) -> &[T] {
        assert!(range.start <= range.end && range.end <= self.length);
        // SAFETY: inside the slice; the caller answers for nobody writing it.
        unsafe { std::slice::from_raw_parts(self.start.add(range.start), range.len()) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_item_is_done_once_and_stages_follow_each_other() {
        for threads in [1, 2, 5] {
            let mut crew = Crew::new(threads, 3);
            for round in 0..300 {
                let items = [7, 0, 1 + round % 13];
                let mut first = [0u32; 7];
                let mut sums = [0u32; 13];
                let (written, summed) = (Parts::new(&mut first), Parts::new(&mut sums));
                crew.run(items, round % 3 == 0, &|task: Task| {
                    // SAFETY: each item of stage 0 has its own number, those of stage 2 only read
                    // these and have their own sum.
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
    fn a_panic_reaches_the_caller_whoever_had_it_and_the_crew_goes_on() {
        for culprit in [0, 1] {
            let mut crew = Crew::new(2, 1);
            let met = AtomicUsize::new(0);
            let outcome = panic::catch_unwind(panic::AssertUnwindSafe(|| {
                crew.run([2], false, &|task: Task| {
                    // Both threads are at work before one of them panics.
                    met.fetch_add(1, Ordering::SeqCst);
                    wait_until(|| met.load(Ordering::SeqCst) == 2);
                    assert!(task.thread != culprit, "on purpose");
                });
            }));
            assert!(outcome.is_err(), "thread {culprit}");

            let done = AtomicUsize::new(0);
            crew.run([9], false, &|_| {
                done.fetch_add(1, Ordering::SeqCst);
            });
            assert_eq!(done.into_inner(), 9, "the crew goes on");
        }
    }
}
