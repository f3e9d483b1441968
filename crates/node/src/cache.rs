//! A queue from several producers to one consumer, bounded in bytes.

use std::{
    collections::VecDeque,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

/// A first-in-first-out queue of bounded size.
pub struct Cache<T> {
    contents: Mutex<Contents<T>>,
    arrived: Condvar,
    freed: Condvar,
    /// Bytes.
    capacity: usize,
}

struct Contents<T> {
    items: VecDeque<(T, usize)>,
    bytes: usize,
    producers: usize,
    closed: bool,
}

/// The result of [`Cache::pop`].
#[derive(Debug, PartialEq, Eq)]
pub enum Pop<T> {
    /// The oldest item.
    Item(T),
    /// No item arrived in time.
    Timeout,
    /// The queue is empty and all producers are gone.
    Ended,
}

impl<T> Cache<T> {
    /// A queue for `capacity` bytes. A larger item is accepted when the queue is empty.
    pub fn new(capacity: usize) -> Arc<Self> {
        let contents = Contents { items: VecDeque::new(), bytes: 0, producers: 0, closed: false };
        let (arrived, freed) = (Condvar::new(), Condvar::new());
        Arc::new(Self { contents: Mutex::new(contents), arrived, freed, capacity })
    }

    /// One more producer; the queue ends with the last of them.
    pub fn producer(self: &Arc<Self>) -> Producer<T> {
        self.lock().producers += 1;
        Producer { cache: Arc::clone(self) }
    }

    /// The oldest item; waits for it up to `timeout`.
    pub fn pop(&self, timeout: Duration) -> Pop<T> {
        let waits =
            |contents: &mut Contents<T>| contents.items.is_empty() && contents.producers > 0;
        let (mut contents, _) = self
            .arrived
            .wait_timeout_while(self.lock(), timeout, waits)
            .unwrap_or_else(PoisonError::into_inner);
        match contents.items.pop_front() {
            Some((item, bytes)) => {
                contents.bytes -= bytes;
                self.freed.notify_all();
                Pop::Item(item)
            }
            None if contents.producers == 0 => Pop::Ended,
            None => Pop::Timeout,
        }
    }

    /// Bytes in the queue.
    pub fn bytes(&self) -> usize {
        self.lock().bytes
    }

    /// Closes the queue: producers no longer wait and their items are discarded. Returns the items that were queued.
    pub fn close(&self) -> Vec<T> {
        let mut contents = self.lock();
        contents.closed = true;
        contents.bytes = 0;
        self.freed.notify_all();
        contents.items.drain(..).map(|(item, _)| item).collect()
    }

    /// A panic in another thread leaves the contents consistent: every change is one push or pop.
    fn lock(&self) -> MutexGuard<'_, Contents<T>> {
        self.contents.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// The result of [`Producer::push`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Push {
    /// The item is in the queue.
    Queued,
    /// The queue stayed full; the item was discarded.
    Full,
    /// The queue is closed; the item was discarded.
    Closed,
}

/// Memory that an item takes beside its own bytes: its slot in the queue and its allocation.
const ITEM_OVERHEAD: usize = 256;

/// The sending end of a [`Cache`].
pub struct Producer<T> {
    cache: Arc<Cache<T>>,
}

impl<T> Producer<T> {
    /// Adds an item of `bytes` bytes; waits up to `timeout` while the queue is full.
    pub fn push(&self, item: T, bytes: usize, timeout: Duration) -> Push {
        let Cache { arrived, freed, capacity, .. } = &*self.cache;
        let bytes = bytes + ITEM_OVERHEAD;
        let full = |contents: &mut Contents<T>| {
            !contents.closed && !contents.items.is_empty() && contents.bytes + bytes > *capacity
        };
        let (mut contents, _) = freed
            .wait_timeout_while(self.cache.lock(), timeout, full)
            .unwrap_or_else(PoisonError::into_inner);
        if contents.closed {
            return Push::Closed;
        }
        if full(&mut contents) {
            return Push::Full;
        }
        contents.items.push_back((item, bytes));
        contents.bytes += bytes;
        arrived.notify_one();
        Push::Queued
    }

    /// Whether the queue was closed.
    pub fn is_closed(&self) -> bool {
        self.cache.lock().closed
    }
}

impl<T> Drop for Producer<T> {
    fn drop(&mut self) {
        self.cache.lock().producers -= 1;
        self.cache.arrived.notify_all();
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    const LONG: Duration = Duration::from_secs(60);

    #[test]
    fn items_come_out_in_order_and_the_queue_ends_with_its_producers() {
        let cache = Cache::new(10_000);
        let (first, second) = (cache.producer(), cache.producer());
        assert_eq!(first.push('a', 4_000, LONG), Push::Queued);
        assert_eq!(second.push('b', 4_000, LONG), Push::Queued);
        assert_eq!(cache.bytes(), 8_000 + 2 * ITEM_OVERHEAD);
        drop(first);
        assert_eq!([cache.pop(LONG), cache.pop(LONG)], [Pop::Item('a'), Pop::Item('b')]);
        assert_eq!(cache.pop(Duration::ZERO), Pop::Timeout);
        second.push('c', 0, LONG);
        drop(second);
        assert_eq!([cache.pop(LONG), cache.pop(LONG)], [Pop::Item('c'), Pop::Ended]);
    }

    #[test]
    fn an_item_is_discarded_when_the_queue_stays_full() {
        let cache = Cache::new(10_000);
        let producer = cache.producer();
        assert_eq!(producer.push('a', 7_000, LONG), Push::Queued);
        assert_eq!(producer.push('b', 4_000, Duration::from_millis(1)), Push::Full);
        assert_eq!(producer.push('c', 2_000, Duration::ZERO), Push::Queued);
        assert_eq!([cache.pop(LONG), cache.pop(LONG)], [Pop::Item('a'), Pop::Item('c')]);
    }

    #[test]
    fn an_item_larger_than_the_queue_is_accepted_alone() {
        let cache = Cache::new(10_000);
        let producer = cache.producer();
        assert_eq!(producer.push('a', 100_000, Duration::ZERO), Push::Queued);
        assert_eq!(producer.push('b', 1, Duration::ZERO), Push::Full);
        assert_eq!(cache.pop(LONG), Pop::Item('a'));
        assert_eq!(producer.push('b', 1, Duration::ZERO), Push::Queued);
    }

    #[test]
    fn a_waiting_producer_is_released_by_free_space_or_by_closing() {
        for close in [false, true] {
            let cache = Cache::new(1);
            let producer = cache.producer();
            producer.push(0, 1, LONG);
            let waiting = thread::spawn(move || producer.push(1, 1, LONG));
            let expected = if close {
                // The queued item is returned; the waiting one may have been queued before.
                let left = cache.close();
                assert_eq!(left[0], 0);
                if left.len() == 1 { Push::Closed } else { Push::Queued }
            } else {
                assert_eq!(cache.pop(LONG), Pop::Item(0));
                Push::Queued
            };
            assert_eq!(waiting.join().unwrap(), expected);
        }
    }
}
