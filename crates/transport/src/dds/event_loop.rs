//! A thread that handles events of RustDDS until it is dropped.

use std::{
    fmt::Display,
    io,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::{self, JoinHandle},
};

use ros2_client::dds::rustdds::mio1::{Events, Poll, Registry, Token, Waker};

/// Token of the waker; event sources have others.
const WAKE: Token = Token(0);

/// Stops and joins its thread when it is dropped.
pub(super) struct EventLoop {
    stop: Arc<AtomicBool>,
    waker: Arc<Waker>,
    thread: Option<JoinHandle<()>>,
}

impl EventLoop {
    /// What a thread waits with, and what wakes it.
    pub(super) fn poll() -> io::Result<(Poll, Arc<Waker>)> {
        let poll = Poll::new()?;
        let waker = Waker::new(poll.registry(), WAKE)?;
        Ok((poll, Arc::new(waker)))
    }

    /// Starts a thread that calls `handle` at once and after every event. `subject` is for log messages.
    pub(super) fn start(
        name: &str,
        subject: impl Display + Send + 'static,
        (mut poll, waker): (Poll, Arc<Waker>),
        mut handle: impl FnMut(&Registry) + Send + 'static,
    ) -> io::Result<Self> {
        let stop = Arc::<AtomicBool>::default();
        let stopped = Arc::clone(&stop);
        let thread = thread::Builder::new().name(name.to_owned()).spawn(move || {
            let mut events = Events::with_capacity(4);
            while !stopped.load(Ordering::Relaxed) {
                handle(poll.registry());
                match poll.poll(&mut events, None) {
                    Err(error) if error.kind() != io::ErrorKind::Interrupted => {
                        tracing::warn!("{subject}: receiving stopped: {error}");
                        return;
                    }
                    _ => {}
                }
            }
        })?;
        Ok(Self { stop, waker, thread: Some(thread) })
    }
}

impl Drop for EventLoop {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        // A thread that cannot be woken is not joined.
        if self.waker.wake().is_ok()
            && let Some(thread) = self.thread.take()
        {
            let _ = thread.join();
        }
    }
}
