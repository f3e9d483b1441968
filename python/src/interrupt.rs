//! Long work on a thread of its own, while the calling thread looks for Ctrl-C and calls back into Python.

use std::{
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc::{self, SyncSender},
    },
    thread,
    time::Duration,
};

use eddy_frames::progress::Progress;
use pyo3::prelude::*;

/// Time between two looks for signals.
const INTERVAL: Duration = Duration::from_millis(50);

/// What the work reports, and how it learns that it should stop.
pub(crate) struct Watch<E> {
    events: SyncSender<E>,
    cancelled: AtomicBool,
}

impl<E: Send> Watch<E> {
    /// Passes an event to the calling thread.
    pub(crate) fn report(&self, event: E) {
        // The calling thread listens until the work is done.
        let _ = self.events.send(event);
    }
}

impl<E: Send> Progress for Watch<E> {
    fn cancelled(&self) -> bool {
        self.cancelled.load(Ordering::Relaxed)
    }
}

/// Wakes a thread when it is dropped.
struct Wake(thread::Thread);

impl Drop for Wake {
    fn drop(&mut self) {
        self.0.unpark();
    }
}

/// Runs `work` without the interpreter's lock. `on_event` is called with the lock, on the calling thread.
///
/// # Errors
/// The exception of a signal handler (`KeyboardInterrupt`) or of `on_event`, after the work was asked to stop and has ended.
pub(crate) fn run<T: Send, E: Send>(
    py: Python<'_>,
    mut on_event: impl FnMut(Python<'_>, E) -> PyResult<()>,
    work: impl FnOnce(&Watch<E>) -> T + Send,
) -> PyResult<T> {
    let (events, received) = mpsc::sync_channel(64);
    let watch = Watch { events, cancelled: AtomicBool::new(false) };
    let caller = thread::current();
    thread::scope(|scope| {
        let running = scope.spawn(|| {
            // Also after a panic.
            let _wake = Wake(caller);
            work(&watch)
        });
        let mut failure = None;
        loop {
            py.detach(|| thread::park_timeout(INTERVAL));
            let finished = running.is_finished();
            let handled = received
                .try_iter()
                .try_for_each(|event| on_event(py, event))
                .and_then(|()| py.check_signals());
            if let Err(error) = handled
                && failure.is_none()
            {
                watch.cancelled.store(true, Ordering::Relaxed);
                failure = Some(error);
            }
            if finished {
                break;
            }
        }
        let outcome = py.detach(|| running.join());
        match (failure, outcome) {
            (Some(error), _) => Err(error),
            (None, Ok(outcome)) => Ok(outcome),
            (None, Err(panic)) => std::panic::resume_unwind(panic),
        }
    })
}
