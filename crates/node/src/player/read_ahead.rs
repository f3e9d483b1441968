//! The messages of a bag, read by a thread of its own before they are due: decompressing a chunk would delay them.

use std::{io, sync::Arc, thread, time::Duration};

use eddy_bag::{BagError, BagMessage, Messages};
use eddy_transport::Queue;

/// How far to read ahead (bytes of messages).
const CAPACITY: usize = 32 << 20;
/// The same in messages, for bags of small ones.
const MAX_MESSAGES: usize = 1 << 17;
/// Duration of one wait for a message, after which the next begins.
const WAIT: Duration = Duration::from_secs(1);

/// A message, or damage of the bag.
type Item = Result<BagMessage, BagError>;

pub(super) struct ReadAhead {
    queue: Arc<Queue<Item>>,
}

fn cost(message: &Item) -> usize {
    message.as_ref().map_or(0, |message| message.data.len())
}

impl ReadAhead {
    /// Starts the thread.
    pub(super) fn start(messages: Messages) -> io::Result<Self> {
        let queue = Arc::new(Queue::with_cost(MAX_MESSAGES, CAPACITY, cost));
        let producer = queue.producer();
        thread::Builder::new().name("bag reader".to_owned()).spawn(move || {
            for message in messages {
                // Fails when the queue was closed.
                if producer.push_or_wait(message, Duration::MAX).is_err() {
                    break;
                }
            }
        })?;
        Ok(Self { queue })
    }
}

impl Iterator for ReadAhead {
    type Item = Item;

    fn next(&mut self) -> Option<Item> {
        loop {
            match self.queue.pop(WAIT) {
                Some(message) => return Some(message),
                None if self.queue.is_ended() => return None,
                None => {}
            }
        }
    }
}

impl Drop for ReadAhead {
    fn drop(&mut self) {
        self.queue.close();
    }
}
