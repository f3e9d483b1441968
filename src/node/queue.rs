//! Messages that wait for the node.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use crate::transport::{Payload, Queue, Reliability};

/// How long a receiver waits for room before it looks whether the queue is closed.
const PATIENCE: Duration = Duration::from_millis(100);

/// A message with its time of arrival.
type Arrived = (Duration, Payload);

/// A bounded queue between the thread that receives and the node that predicts. When it is full,
/// [`Reliability::Block`] lets the receiver wait and [`Reliability::Drop`] gives up the oldest
/// message.
#[derive(Debug)]
pub struct FrameQueue {
    messages: Queue<Arrived>,
    reliability: Reliability,
    closed: AtomicBool,
}

impl FrameQueue {
    /// An empty queue for `capacity` messages, at least one.
    pub fn new(capacity: usize, reliability: Reliability) -> Self {
        let messages = Queue::new(capacity.max(1));
        Self { messages, reliability, closed: AtomicBool::new(false) }
    }

    /// Adds a message. Returns whether the queue is still open.
    pub fn push(&self, arrived: Duration, payload: Payload) -> bool {
        let mut message = (arrived, payload);
        loop {
            if self.is_closed() {
                return false;
            }
            match self.reliability {
                Reliability::Drop => {
                    self.messages.push_or_replace(message);
                    return true;
                }
                Reliability::Block => match self.messages.push_or_wait(message, PATIENCE) {
                    Ok(()) => return true,
                    Err(back) => message = back,
                },
            }
        }
    }

    /// The oldest message, or `None` when there is none within `timeout`.
    pub fn pop(&self, timeout: Duration) -> Option<Arrived> {
        self.messages.pop(timeout)
    }

    /// Messages given up so far.
    pub fn dropped(&self) -> u64 {
        self.messages.dropped()
    }

    /// Takes no more messages; what is there can still be popped.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Relaxed);
    }

    /// Whether nobody wants messages any more.
    pub fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Relaxed)
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
                });
            });
            for number in 0..100 {
                let (_, payload) = queue.pop(Duration::from_secs(60)).unwrap();
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
