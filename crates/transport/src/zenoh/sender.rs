//! Puts messages into a Zenoh session without being stuck in it.
//!
//! A put of a blocking publisher waits within Zenoh until every peer has room for the message, and Zenoh closes the
//! connection to a peer that has none for [`TransportOptions::patience`](crate::TransportOptions::patience). Nothing can
//! end this wait earlier, so it takes place on a thread that can be left behind when the program is asked to stop.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
        mpsc,
    },
    thread::{self, JoinHandle},
    time::Duration,
};

use crate::{
    Producer, PushError, Queue,
    patience::{GRACE, Patience},
};
use eddy_frames::clock::Clock;

/// Messages that may wait for the thread.
const QUEUED: usize = 4;
/// How long closing something may take without a stop.
const CLOSE_TIMEOUT: Duration = Duration::from_secs(2);
/// How long closing something may take after a stop, even if the grace is over.
const MIN_CLOSE_TIMEOUT: Duration = Duration::from_millis(100);

/// A thread that sends messages in order.
pub(super) struct Sender<T> {
    queue: Producer<T>,
    counts: Arc<Counts>,
    thread: JoinHandle<()>,
}

#[derive(Default)]
struct Counts {
    /// Messages that are queued or being sent.
    pending: AtomicU64,
    /// Messages that took as long as the patience lasts, so that Zenoh closed the connection to a peer.
    stalled: AtomicU64,
}

impl<T: Send + 'static> Sender<T> {
    /// Starts the thread, which calls `send` for each message.
    pub(super) fn start(
        patience: &Patience,
        mut send: impl FnMut(T) + Send + 'static,
    ) -> io::Result<Self> {
        let (queue, counts) = (Arc::new(Queue::<T>::new(QUEUED)), Arc::<Counts>::default());
        let (producer, limit) = (queue.producer(), patience.limit());
        let counted = Arc::clone(&counts);
        let thread =
            thread::Builder::new().name("zenoh publisher".to_owned()).spawn(move || {
                while !queue.is_ended() {
                    let Some(message) = queue.pop(Duration::from_secs(1)) else { continue };
                    let clock = Clock::start();
                    send(message);
                    if clock.now() >= limit {
                        counted.stalled.fetch_add(1, Ordering::Relaxed);
                    }
                    counted.pending.fetch_sub(1, Ordering::Release);
                }
            })?;
        Ok(Self { queue: producer, counts, thread })
    }

    /// Ends the thread after the queued messages.
    pub(super) fn end(self) -> JoinHandle<()> {
        self.thread
    }

    /// Queues a message; waits for room with `patience`. Returns whether it is queued.
    pub(super) fn send(&self, message: T, patience: &Patience) -> bool {
        self.counts.pending.fetch_add(1, Ordering::Relaxed);
        let mut waiting = Some(message);
        let sent = patience.wait(|slice| match self.queue.push_or_wait(waiting.take()?, slice) {
            Err(PushError::Full(back)) => {
                waiting = Some(back);
                None
            }
            pushed => Some(pushed.is_ok()),
        });
        let is_sent = sent.unwrap_or(false);
        if !is_sent {
            self.counts.pending.fetch_sub(1, Ordering::Relaxed);
        }
        is_sent
    }

    /// Waits until everything is sent. Returns the number of messages that are not.
    pub(super) fn flush(&self, patience: &Patience) -> u64 {
        let pending = || self.counts.pending.load(Ordering::Acquire);
        let sent = patience.wait(|slice| {
            if pending() > 0 {
                thread::sleep(slice.min(Duration::from_millis(1)));
            }
            (pending() == 0).then_some(0)
        });
        sent.unwrap_or_else(pending)
    }

    /// Messages since the last call after which Zenoh closed the connection to a peer.
    pub(super) fn take_stalled(&self) -> u64 {
        self.counts.stalled.swap(0, Ordering::Relaxed)
    }
}

/// Runs `end`, which closes a part of the session, on a thread of its own, and leaves it behind if it takes too long: a
/// peer that reads nothing would keep it for 10 s.
pub(super) fn close(patience: &Patience, end: impl FnOnce() + Send + 'static) {
    let (ended, wait) = mpsc::channel();
    let closing = thread::Builder::new().name("zenoh close".to_owned()).spawn(move || {
        end();
        let _ = ended.send(()); // nobody waits any longer
    });
    let timeout = match patience.is_stopped() {
        true => patience.left(Duration::ZERO).min(GRACE).max(MIN_CLOSE_TIMEOUT),
        false => CLOSE_TIMEOUT,
    };
    if closing.is_ok() && wait.recv_timeout(timeout) == Err(mpsc::RecvTimeoutError::Timeout) {
        tracing::debug!("zenoh: a peer that reads nothing is not waited for at the end");
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Mutex, atomic::AtomicBool};

    use super::*;

    fn patience(stop: &Arc<AtomicBool>) -> Patience {
        Patience::new(Duration::from_secs(60), Arc::clone(stop))
    }

    #[test]
    fn messages_are_sent_in_order_and_flushed() {
        let (patience, sent) = (patience(&Arc::default()), Arc::<Mutex<Vec<u32>>>::default());
        let into = Arc::clone(&sent);
        let sender = Sender::start(&patience, move |n| into.lock().unwrap().push(n)).unwrap();
        for number in 0..100 {
            assert!(sender.send(number, &patience));
        }
        assert_eq!(sender.flush(&patience), 0);
        assert_eq!(*sent.lock().unwrap(), (0..100).collect::<Vec<_>>());
        assert_eq!(sender.take_stalled(), 0);
    }

    #[test]
    fn a_stop_leaves_a_stuck_put_and_a_stuck_close_behind() {
        let stop = Arc::<AtomicBool>::default();
        let patience = patience(&stop);
        let sender = Sender::start(&patience, |()| thread::park()).unwrap();
        let clock = Clock::start();
        // One is stuck in the thread, the others wait in the queue.
        while sender.counts.pending.load(Ordering::Relaxed) < 5 {
            assert!(sender.send((), &patience));
        }
        stop.store(true, Ordering::Relaxed);
        while sender.send((), &patience) {}
        assert!(sender.flush(&patience) >= 5);
        close(&patience, || thread::sleep(Duration::from_secs(60)));
        assert!(clock.now() < Duration::from_secs(10), "{:?}", clock.now());
    }
}
