//! What waits to be written: a queue between several receivers and one writer, bounded in bytes.

use std::{
    collections::VecDeque,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

/// A first-in-first-out queue of bounded size.
pub struct Cache<T> {
    state: Mutex<State<T>>,
    arrived: Condvar,
    freed: Condvar,
    /// Bytes it may hold.
    capacity: usize,
}

struct State<T> {
    items: VecDeque<(T, usize)>,
    bytes: usize,
    producers: usize,
    closed: bool,
}

/// What a look into the queue gave.
#[derive(Debug, PartialEq, Eq)]
pub enum Taken<T> {
    /// The oldest item.
    Item(T),
    /// None came in time.
    Nothing,
    /// None will come any more: the producers are gone, and what they left is taken.
    Ended,
}

impl<T> Cache<T> {
    /// A queue for so many bytes. A longer item has it for itself.
    pub fn new(capacity: usize) -> Arc<Self> {
        let state = State { items: VecDeque::new(), bytes: 0, producers: 0, closed: false };
        let (arrived, freed) = (Condvar::new(), Condvar::new());
        Arc::new(Self { state: Mutex::new(state), arrived, freed, capacity })
    }

    /// One more producer; the queue ends with the last of them.
    pub fn producer(self: &Arc<Self>) -> Producer<T> {
        self.lock().producers += 1;
        Producer { cache: Arc::clone(self) }
    }

    /// The oldest item, waiting `timeout` for it at most.
    pub fn take(&self, timeout: Duration) -> Taken<T> {
        let waits = |state: &mut State<T>| state.items.is_empty() && state.producers > 0;
        let (mut state, _) = self
            .arrived
            .wait_timeout_while(self.lock(), timeout, waits)
            .unwrap_or_else(PoisonError::into_inner);
        match state.items.pop_front() {
            Some((item, bytes)) => {
                state.bytes -= bytes;
                self.freed.notify_all();
                Taken::Item(item)
            }
            None if state.producers == 0 => Taken::Ended,
            None => Taken::Nothing,
        }
    }

    /// Bytes that wait now.
    pub fn bytes(&self) -> usize {
        self.lock().bytes
    }

    /// Frees whoever waits for room, now and later: what they bring vanishes. Gives what waited here.
    pub fn close(&self) -> Vec<T> {
        let mut state = self.lock();
        state.closed = true;
        state.bytes = 0;
        self.freed.notify_all();
        state.items.drain(..).map(|(item, _)| item).collect()
    }

    /// A panic elsewhere cannot leave the state half changed: every change is one push or pop.
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// What became of an item.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Brought {
    /// It waits.
    Queued,
    /// There never was room for it: it is given up.
    NoRoom,
    /// Nobody takes anything any more: it is given up.
    Unwanted,
}

/// What an item takes at least, beside its own bytes: its place here and what it is kept in.
const LEAST: usize = 256;

/// Brings items.
pub struct Producer<T> {
    cache: Arc<Cache<T>>,
}

impl<T> Producer<T> {
    /// Adds an item of so many bytes when there is room, waiting `patience` for it at most.
    pub fn bring(&self, item: T, bytes: usize, patience: Duration) -> Brought {
        let Cache { arrived, freed, capacity, .. } = &*self.cache;
        let bytes = bytes + LEAST;
        let full = |state: &mut State<T>| {
            !state.closed && !state.items.is_empty() && state.bytes + bytes > *capacity
        };
        let (mut state, _) = freed
            .wait_timeout_while(self.cache.lock(), patience, full)
            .unwrap_or_else(PoisonError::into_inner);
        if state.closed {
            return Brought::Unwanted;
        }
        if full(&mut state) {
            return Brought::NoRoom;
        }
        state.items.push_back((item, bytes));
        state.bytes += bytes;
        arrived.notify_one();
        Brought::Queued
    }
}

impl<T> Producer<T> {
    /// Whether the queue was closed: nobody takes anything any more.
    pub fn is_unwanted(&self) -> bool {
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
        assert_eq!(first.bring('a', 4_000, LONG), Brought::Queued);
        assert_eq!(second.bring('b', 4_000, LONG), Brought::Queued);
        assert_eq!(cache.bytes(), 8_000 + 2 * LEAST);
        drop(first);
        assert_eq!([cache.take(LONG), cache.take(LONG)], [Taken::Item('a'), Taken::Item('b')]);
        assert_eq!(cache.take(Duration::ZERO), Taken::Nothing);
        second.bring('c', 0, LONG);
        drop(second);
        assert_eq!([cache.take(LONG), cache.take(LONG)], [Taken::Item('c'), Taken::Ended]);
    }

    #[test]
    fn what_finds_no_room_in_time_is_given_up_and_said_so() {
        let cache = Cache::new(10_000);
        let producer = cache.producer();
        assert_eq!(producer.bring('a', 7_000, LONG), Brought::Queued);
        assert_eq!(producer.bring('b', 4_000, Duration::from_millis(1)), Brought::NoRoom);
        assert_eq!(producer.bring('c', 2_000, Duration::ZERO), Brought::Queued);
        assert_eq!([cache.take(LONG), cache.take(LONG)], [Taken::Item('a'), Taken::Item('c')]);
    }

    #[test]
    fn a_longer_item_than_the_queue_has_it_for_itself() {
        let cache = Cache::new(10_000);
        let producer = cache.producer();
        assert_eq!(producer.bring('a', 100_000, Duration::ZERO), Brought::Queued);
        assert_eq!(producer.bring('b', 1, Duration::ZERO), Brought::NoRoom);
        assert_eq!(cache.take(LONG), Taken::Item('a'));
        assert_eq!(producer.bring('b', 1, Duration::ZERO), Brought::Queued);
    }

    #[test]
    fn room_or_closing_frees_the_one_who_waits() {
        for close in [false, true] {
            let cache = Cache::new(1);
            let producer = cache.producer();
            producer.bring(0, 1, LONG);
            let waiting = thread::spawn(move || producer.bring(1, 1, LONG));
            let expected = if close {
                // The one that waited in the queue comes back; the other may have come before it.
                let left = cache.close();
                assert_eq!(left[0], 0);
                if left.len() == 1 { Brought::Unwanted } else { Brought::Queued }
            } else {
                assert_eq!(cache.take(LONG), Taken::Item(0));
                Brought::Queued
            };
            assert_eq!(waiting.join().unwrap(), expected);
        }
    }
}
