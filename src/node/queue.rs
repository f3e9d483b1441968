//! A bounded queue between the thread that receives and the node that predicts.

use std::{
    collections::VecDeque,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use crate::transport::{Payload, Reliability};

/// A message with its time of arrival.
type Arrived = (Duration, Payload);

/// Messages that wait for the node. When it is full, [`Reliability::Block`] lets the receiver wait
/// and [`Reliability::Drop`] gives up the oldest message.
#[derive(Debug)]
pub struct FrameQueue {
    capacity: usize,
    reliability: Reliability,
    waiting: Mutex<Waiting>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct Waiting {
    messages: VecDeque<Arrived>,
    dropped: u64,
    closed: bool,
}

impl FrameQueue {
    /// An empty queue for `capacity` messages, at least one.
    pub fn new(capacity: usize, reliability: Reliability) -> Self {
        Self {
            capacity: capacity.max(1),
            reliability,
            waiting: Mutex::default(),
            changed: Condvar::new(),
        }
    }

    /// Adds a message. Returns whether the queue is still open.
    pub fn push(&self, arrived: Duration, payload: Payload) -> bool {
        let mut waiting = self.lock();
        while waiting.messages.len() >= self.capacity && !waiting.closed {
            match self.reliability {
                Reliability::Drop => {
                    waiting.messages.pop_front();
                    waiting.dropped += 1;
                }
                Reliability::Block => {
                    waiting = self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
                }
            }
        }
        if !waiting.closed {
            waiting.messages.push_back((arrived, payload));
            self.changed.notify_all();
        }
        !waiting.closed
    }

    /// The oldest message, or `None` when there is none within `timeout`.
    pub fn pop(&self, timeout: Duration) -> Option<Arrived> {
        let waiting = self.lock();
        let (mut waiting, _) = self
            .changed
            .wait_timeout_while(waiting, timeout, |w| w.messages.is_empty() && !w.closed)
            .unwrap_or_else(PoisonError::into_inner);
        let message = waiting.messages.pop_front();
        self.changed.notify_all();
        message
    }

    /// Messages given up so far.
    pub fn dropped(&self) -> u64 {
        self.lock().dropped
    }

    /// Lets nobody wait any more: pushing ends, what is there can still be popped.
    pub fn close(&self) {
        self.lock().closed = true;
        self.changed.notify_all();
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        // A thread that panicked while it held the lock left whole messages behind.
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    fn message(number: u8) -> Payload {
        Payload::Cdr(vec![number])
    }

    #[test]
    fn drop_gives_up_the_oldest_and_counts_it() {
        let queue = FrameQueue::new(2, Reliability::Drop);
        for number in 0..5 {
            assert!(queue.push(Duration::ZERO, message(number)));
        }
        assert_eq!(queue.dropped(), 3);
        assert_eq!(queue.pop(Duration::ZERO), Some((Duration::ZERO, message(3))));
        assert_eq!(queue.pop(Duration::ZERO), Some((Duration::ZERO, message(4))));
        assert_eq!(queue.pop(Duration::ZERO), None);
    }

    #[test]
    fn block_loses_nothing_with_a_slow_reader() {
        let queue = FrameQueue::new(2, Reliability::Block);
        thread::scope(|scope| {
            scope.spawn(|| {
                (0..100).for_each(|number| {
                    queue.push(Duration::ZERO, message(number));
                })
            });
            for number in 0..100 {
                let (_, payload) = queue.pop(Duration::from_secs(10)).unwrap();
                assert_eq!(payload, message(number));
            }
        });
        assert_eq!(queue.dropped(), 0);
    }

    #[test]
    fn closing_frees_a_waiting_writer() {
        let queue = FrameQueue::new(1, Reliability::Block);
        queue.push(Duration::ZERO, message(0));
        thread::scope(|scope| {
            let writer = scope.spawn(|| queue.push(Duration::ZERO, message(1)));
            queue.close();
            assert!(!writer.join().unwrap());
        });
    }
}
