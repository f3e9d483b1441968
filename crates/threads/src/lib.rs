//! A thread pool that spins before it parks, for jobs of some ten microseconds to milliseconds.
//!
//! 1. [`ThreadPool::run`]: a job is a list of stages, a stage a number of items. Whichever thread is free takes
//!    the next item, so a thread that the system has descheduled delays the job but does not block it.
//! 2. [`ThreadPool::broadcast`]: one call per thread, with a [`Barrier`] between the phases: for work whose data
//!    should stay in the caches of the same thread.
//! 3. [`DisjointSlice`]: a slice that the threads write in disjoint parts.
//!
//! The calling thread takes part in every job. Nothing allocates once the threads run.
#![expect(
    unsafe_code,
    reason = "threads borrow the caller's closure and write disjoint parts of one slice"
)]

mod disjoint;
mod pool;

pub use disjoint::DisjointSlice;
pub use pool::{Barrier, Task, ThreadPool};

use std::{hint, ops::Range, thread};

/// Checks of a flag before a thread that waits for a job parks, or for the end of a stage yields: about 20 microseconds.
const SPINS: u32 = 500;
/// Checks of a barrier before a thread yields. Fewer, because all threads of a broadcast must run: on a busy machine, the
/// one that is missing may be waiting for the processor of one that spins.
const BARRIER_SPINS: u32 = 100;

/// The part of `0..length` that belongs to one of `threads` threads.
pub fn share(length: usize, thread: usize, threads: usize) -> Range<usize> {
    length * thread / threads..length * (thread + 1) / threads
}

/// Checks a condition until it holds: `most` times spinning, then yielding.
fn wait_until(most: u32, condition: impl Fn() -> bool) {
    let mut spins = 0;
    while !condition() {
        if spins < most {
            spins += 1;
            hint::spin_loop();
        } else {
            thread::yield_now();
        }
    }
}

/// Compiles and runs the example of the README.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
