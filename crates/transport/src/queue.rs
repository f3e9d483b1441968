//! The bounded queue between a thread that receives and whoever works on what came.

use std::{
    collections::VecDeque,
    sync::{Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

/// A first-in-first-out queue of bounded length, with both ways to meet a full one.
#[derive(Debug)]
pub struct Queue<T> {
    state: Mutex<State<T>>,
    arrived: Condvar,
    freed: Condvar,
    capacity: usize,
}

#[derive(Debug)]
struct State<T> {
    items: VecDeque<T>,
    dropped: u64,
    closed: bool,
}

impl<T> Queue<T> {
    /// An empty queue for `capacity` items.
    pub fn new(capacity: usize) -> Self {
        let state = State { items: VecDeque::new(), dropped: 0, closed: false };
        Self { state: Mutex::new(state), arrived: Condvar::new(), freed: Condvar::new(), capacity }
    }

    /// Adds `item` when there is room, waiting `patience` for it at most. Gives the item back when
    /// there never was. Once closed, items vanish: nobody waits for them any more.
    pub fn push_or_wait(&self, item: T, patience: Duration) -> Result<(), T> {
        let full = |state: &mut State<T>| state.items.len() >= self.capacity && !state.closed;
        let (mut state, wait) = self
            .freed
            .wait_timeout_while(self.lock(), patience, full)
            .unwrap_or_else(PoisonError::into_inner);
        if wait.timed_out() && full(&mut state) {
            return Err(item);
        }
        self.push(state, item);
        Ok(())
    }

    /// Adds `item` at once; a full queue gives up its oldest item, which is counted.
    pub fn push_or_replace(&self, item: T) {
        self.push_or_give_up(item, |_| 0);
    }

    /// Adds `item` at once; a full queue gives up the one of its items that `which` chooses. It is counted
    /// and returned.
    pub fn push_or_give_up(&self, item: T, which: impl FnOnce(&VecDeque<T>) -> usize) -> Option<T> {
        let mut state = self.lock();
        let mut given_up = None;
        if state.items.len() >= self.capacity {
            let which = which(&state.items);
            given_up = state.items.remove(which);
            state.dropped += 1;
        }
        self.push(state, item);
        given_up
    }

    fn push(&self, mut state: MutexGuard<'_, State<T>>, item: T) {
        if !state.closed {
            state.items.push_back(item);
            self.arrived.notify_one();
        }
    }

    /// The oldest item, or `None` when none came within `timeout`.
    pub fn pop(&self, timeout: Duration) -> Option<T> {
        let (mut state, _) = self
            .arrived
            .wait_timeout_while(self.lock(), timeout, |state| state.items.is_empty())
            .unwrap_or_else(PoisonError::into_inner);
        let item = state.items.pop_front();
        self.freed.notify_one();
        item
    }

    /// Takes the oldest item into `taken`, waiting `timeout` for it at most, and those that follow it while
    /// `more` says so, given what was taken.
    pub fn pop_while<U>(
        &self,
        timeout: Duration,
        taken: &mut Vec<U>,
        keep: impl Fn(T) -> U,
        more: impl Fn(&[U], &T) -> bool,
    ) {
        let Some(first) = self.pop(timeout) else { return };
        taken.push(keep(first));
        let mut state = self.lock();
        while state.items.front().is_some_and(|next| more(taken, next)) {
            taken.extend(state.items.pop_front().map(&keep));
            self.freed.notify_one();
        }
    }

    /// Items given up by [`Queue::push_or_replace`] and [`Queue::push_or_give_up`].
    pub fn dropped(&self) -> u64 {
        self.lock().dropped
    }

    /// Frees whoever waits for room, now and later.
    pub fn close(&self) {
        let mut state = self.lock();
        state.closed = true;
        state.items.clear();
        self.freed.notify_all();
    }

    /// A panic elsewhere cannot leave the state half changed: every change is one push or pop.
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use std::{sync::Arc, thread};

    use super::*;

    const LONG: Duration = Duration::from_secs(60);

    #[test]
    fn items_come_out_in_the_order_they_went_in() {
        let queue = Queue::new(3);
        for item in 0..3 {
            queue.push_or_wait(item, Duration::ZERO).unwrap();
        }
        assert_eq!(
            [queue.pop(LONG), queue.pop(LONG), queue.pop(LONG)],
            [Some(0), Some(1), Some(2)]
        );
        assert_eq!(queue.pop(Duration::ZERO), None);
    }

    #[test]
    fn a_full_queue_gives_the_item_back_when_patience_ends() {
        let queue = Queue::new(1);
        queue.push_or_wait(1, Duration::ZERO).unwrap();
        assert_eq!(queue.push_or_wait(2, Duration::from_millis(1)), Err(2));
        assert_eq!(queue.dropped(), 0);
    }

    #[test]
    fn a_full_queue_gives_up_its_oldest_item_and_counts_it() {
        let queue = Queue::new(2);
        (0..5).for_each(|item| queue.push_or_replace(item));
        assert_eq!(queue.dropped(), 3);
        assert_eq!([queue.pop(LONG), queue.pop(LONG)], [Some(3), Some(4)]);
    }

    #[test]
    fn room_frees_the_one_who_waits_for_it() {
        let queue = Arc::new(Queue::new(1));
        queue.push_or_replace(0);
        let waiting = thread::spawn({
            let queue = Arc::clone(&queue);
            move || queue.push_or_wait(1, LONG)
        });
        assert_eq!([queue.pop(LONG), queue.pop(LONG)], [Some(0), Some(1)]);
        waiting.join().unwrap().unwrap();
    }

    #[test]
    fn closing_frees_the_one_who_waits() {
        let queue = Arc::new(Queue::new(1));
        queue.push_or_replace(0);
        let waiting = thread::spawn({
            let queue = Arc::clone(&queue);
            move || queue.push_or_wait(1, LONG)
        });
        queue.close();
        waiting.join().unwrap().unwrap();
        assert_eq!(queue.pop(Duration::ZERO), None);
    }
}
