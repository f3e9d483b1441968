//! Running jobs allocates nothing: a binary of its own, whose allocator counts.
#![expect(unsafe_code, reason = "an allocator that counts")]

use std::{
    alloc::{GlobalAlloc, Layout, System},
    sync::atomic::{AtomicUsize, Ordering},
};

use eddy_threads::ThreadPool;

/// Counts the allocations of all threads.
struct Counting;

static ALLOCATIONS: AtomicUsize = AtomicUsize::new(0);

// SAFETY: every call is forwarded to the system's allocator.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATIONS.fetch_add(1, Ordering::SeqCst);
        // SAFETY: the caller's guarantees are forwarded.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, pointer: *mut u8, layout: Layout) {
        // SAFETY: the caller's guarantees are forwarded.
        unsafe { System.dealloc(pointer, layout) }
    }
}

#[global_allocator]
static COUNTING: Counting = Counting;

#[test]
fn running_jobs_allocates_nothing() {
    let mut pool = ThreadPool::new("test", 3, 2);
    let done = AtomicUsize::new(0);
    // Threads allocate when they start, which may be late on busy processors.
    pool.broadcast(3, &|_, barrier| barrier.wait());
    let before = ALLOCATIONS.load(Ordering::SeqCst);
    for job in 0..200 {
        pool.run([5, 3], job % 2 == 0, &|_| {
            done.fetch_add(1, Ordering::SeqCst);
        });
        pool.broadcast(3, &|_, barrier| barrier.wait());
        if job % 50 == 0 {
            // Long enough for the workers to park.
            std::thread::sleep(std::time::Duration::from_millis(2));
        }
    }
    assert_eq!(ALLOCATIONS.load(Ordering::SeqCst), before);
    assert_eq!(done.into_inner(), 200 * 8);
}
