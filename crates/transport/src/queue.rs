//! A bounded queue between threads.

use std::{
    collections::VecDeque,
    ops::Deref,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

/// A first-in-first-out queue, bounded in the number of its items and in their total cost.
#[derive(Debug)]
pub struct Queue<T> {
    state: Mutex<State<T>>,
    arrived: Condvar,
    freed: Condvar,
    capacity: usize,
    cost_limit: usize,
    cost_of: fn(&T) -> usize,
}

#[derive(Debug)]
struct State<T> {
    items: VecDeque<T>,
    cost: usize,
    dropped: u64,
    /// `None` before the first producer is registered.
    producers: Option<usize>,
    closed: bool,
}

/// Why an item is not in the queue.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PushError<T> {
    /// The queue stayed full.
    Full(T),
    /// The queue is closed.
    Closed(T),
}

impl<T> Queue<T> {
    /// An empty queue for `capacity` items.
    pub fn new(capacity: usize) -> Self {
        Self::with_cost(capacity, usize::MAX, |_| 0)
    }

    /// An empty queue for at most `capacity` items of a total cost (such as bytes) of at most `cost_limit`. An empty
    /// queue accepts any item. `cost_of` must return the same cost for an item each time.
    pub fn with_cost(capacity: usize, cost_limit: usize, cost_of: fn(&T) -> usize) -> Self {
        let items = VecDeque::new();
        let state = State { items, cost: 0, dropped: 0, producers: None, closed: false };
        let (arrived, freed) = (Condvar::new(), Condvar::new());
        Self { state: Mutex::new(state), arrived, freed, capacity, cost_limit, cost_of }
    }

    /// Adds `item`; waits up to `patience` while the queue is full.
    ///
    /// # Errors
    /// [`PushError`] with the item.
    pub fn push_or_wait(&self, item: T, patience: Duration) -> Result<(), PushError<T>> {
        let cost = (self.cost_of)(&item);
        let (state, _) = self
            .freed
            .wait_timeout_while(self.lock(), patience, |state| {
                !state.closed && self.is_full(state, cost)
            })
            .unwrap_or_else(PoisonError::into_inner);
        if state.closed {
            return Err(PushError::Closed(item));
        }
        if self.is_full(&state, cost) {
            return Err(PushError::Full(item));
        }
        self.push(state, item, cost);
        Ok(())
    }

    /// Adds `item` at once; drops and counts the oldest items while the queue is full. A closed queue discards the
    /// item.
    pub fn push_or_drop_oldest(&self, item: T) {
        self.push_or_drop(item, |_| vec![0]);
    }

    /// As [`Queue::push_or_drop_oldest`], but drops the items at the ascending indices that `choose` returns. Returns the
    /// dropped items.
    pub fn push_or_drop(&self, item: T, choose: impl Fn(&VecDeque<T>) -> Vec<usize>) -> Vec<T> {
        let cost = (self.cost_of)(&item);
        let mut state = self.lock();
        let mut dropped = Vec::new();
        if state.closed {
            return dropped;
        }
        while self.is_full(&state, cost) {
            let before = dropped.len();
            // From the back, so that the indices stay valid.
            for chosen in choose(&state.items).into_iter().rev() {
                let Some(old) = state.items.remove(chosen) else { continue };
                state.cost -= (self.cost_of)(&old);
                state.dropped += 1;
                dropped.push(old);
            }
            if dropped.len() == before {
                break;
            }
        }
        self.push(state, item, cost);
        dropped
    }

    fn is_full(&self, state: &State<T>, cost: usize) -> bool {
        state.items.len() >= self.capacity
            || !state.items.is_empty() && state.cost.saturating_add(cost) > self.cost_limit
    }

    fn push(&self, mut state: MutexGuard<'_, State<T>>, item: T, cost: usize) {
        state.items.push_back(item);
        state.cost += cost;
        self.arrived.notify_one();
    }

    /// The oldest item; waits for it up to `timeout`, but not after the last registered producer is gone.
    pub fn pop(&self, timeout: Duration) -> Option<T> {
        let (mut state, _) = self
            .arrived
            .wait_timeout_while(self.lock(), timeout, |state| {
                state.items.is_empty() && state.producers != Some(0)
            })
            .unwrap_or_else(PoisonError::into_inner);
        self.pop_front(&mut state)
    }

    /// Appends the oldest item to `popped`, after waiting for it up to `timeout`, and the following items while `more`
    /// returns true for the items popped so far and the next one. `map` converts each item.
    pub fn pop_while<U>(
        &self,
        timeout: Duration,
        popped: &mut Vec<U>,
        map: impl Fn(T) -> U,
        more: impl Fn(&[U], &T) -> bool,
    ) {
        let Some(first) = self.pop(timeout) else { return };
        popped.push(map(first));
        let mut state = self.lock();
        while state.items.front().is_some_and(|next| more(popped, next)) {
            popped.extend(self.pop_front(&mut state).map(&map));
        }
    }

    fn pop_front(&self, state: &mut State<T>) -> Option<T> {
        let item = state.items.pop_front()?;
        state.cost -= (self.cost_of)(&item);
        self.freed.notify_all();
        Some(item)
    }

    /// Number of items dropped by [`Queue::push_or_drop_oldest`] and [`Queue::push_or_drop`].
    pub fn dropped(&self) -> u64 {
        self.lock().dropped
    }

    /// Total cost of the items.
    pub fn cost(&self) -> usize {
        self.lock().cost
    }

    /// Registers a producer until the returned value is dropped.
    pub fn producer(self: &Arc<Self>) -> Producer<T> {
        self.add_producer();
        Producer(Arc::clone(self))
    }

    /// Registers a producer.
    pub fn add_producer(&self) {
        *self.lock().producers.get_or_insert(0) += 1;
    }

    /// Unregisters a producer.
    pub fn remove_producer(&self) {
        let mut state = self.lock();
        state.producers = state.producers.map(|producers| producers.saturating_sub(1));
        self.arrived.notify_all();
    }

    /// Whether the queue is empty and all registered producers are gone.
    pub fn is_ended(&self) -> bool {
        let state = self.lock();
        state.producers == Some(0) && state.items.is_empty()
    }

    /// Rejects all items from now on, wakes waiting producers, and returns the items in the queue.
    pub fn close(&self) -> Vec<T> {
        let mut state = self.lock();
        state.closed = true;
        state.cost = 0;
        self.freed.notify_all();
        state.items.drain(..).collect()
    }

    /// Whether the queue is closed.
    pub fn is_closed(&self) -> bool {
        self.lock().closed
    }

    /// A panic in another thread leaves the state consistent: every change is one push or pop.
    fn lock(&self) -> MutexGuard<'_, State<T>> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A registered producer of a [`Queue`].
#[derive(Debug)]
pub struct Producer<T>(Arc<Queue<T>>);

impl<T> Deref for Producer<T> {
    type Target = Queue<T>;

    fn deref(&self) -> &Queue<T> {
        &self.0
    }
}

impl<T> Drop for Producer<T> {
    fn drop(&mut self) {
        self.0.remove_producer();
    }
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;

    const LONG: Duration = Duration::from_secs(60);

    /// A queue for texts of 10 bytes in all.
    fn of_bytes() -> Queue<&'static str> {
        Queue::with_cost(usize::MAX, 10, |text| text.len())
    }

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
        let patience = Duration::from_millis(1);
        assert_eq!(queue.push_or_wait(2, patience), Err(PushError::Full(2)));
        assert_eq!(queue.dropped(), 0);
    }

    #[test]
    fn a_full_queue_drops_its_oldest_item_and_counts_it() {
        let queue = Queue::new(2);
        (0..5).for_each(|item| queue.push_or_drop_oldest(item));
        assert_eq!(queue.dropped(), 3);
        assert_eq!([queue.pop(LONG), queue.pop(LONG)], [Some(3), Some(4)]);
    }

    #[test]
    fn the_chosen_item_of_a_full_queue_is_dropped_and_returned() {
        let queue = Queue::new(2);
        assert_eq!(queue.push_or_drop(0, |_| vec![1]), [0; 0]);
        assert_eq!(queue.push_or_drop(1, |_| vec![1]), [0; 0]);
        assert_eq!(queue.push_or_drop(2, |_| vec![1]), [1]);
        assert_eq!([queue.pop(LONG), queue.pop(LONG)], [Some(0), Some(2)]);
    }

    #[test]
    fn the_cost_of_all_items_is_bounded() {
        let queue = of_bytes();
        queue.push_or_wait("12345", LONG).unwrap();
        assert_eq!(queue.push_or_wait("123456", Duration::ZERO), Err(PushError::Full("123456")));
        queue.push_or_wait("12", LONG).unwrap();
        assert_eq!(queue.cost(), 7);
        assert_eq!(queue.pop(LONG), Some("12345"));
        assert_eq!(queue.cost(), 2);
        queue.push_or_drop_oldest("123456789");
        assert_eq!((queue.dropped(), queue.cost()), (1, 9));
    }

    #[test]
    fn an_empty_queue_accepts_an_item_that_exceeds_the_limit() {
        let queue = of_bytes();
        queue.push_or_wait("1234567890 1234567890", Duration::ZERO).unwrap();
        assert_eq!(queue.push_or_wait("1", Duration::ZERO), Err(PushError::Full("1")));
        assert_eq!(queue.pop(LONG), Some("1234567890 1234567890"));
        queue.push_or_wait("1", Duration::ZERO).unwrap();
    }

    #[test]
    fn a_queue_ends_with_its_last_producer() {
        let queue = Queue::new(2);
        queue.add_producer();
        queue.add_producer();
        queue.push_or_drop_oldest(1);
        queue.remove_producer();
        assert_eq!([queue.pop(LONG), queue.pop(Duration::ZERO)], [Some(1), None]);
        assert!(!queue.is_ended());
        queue.push_or_drop_oldest(2);
        queue.remove_producer();
        assert!(!queue.is_ended());
        assert_eq!([queue.pop(LONG), queue.pop(LONG)], [Some(2), None]);
        assert!(queue.is_ended());
    }

    type Producer = thread::JoinHandle<Result<(), PushError<i32>>>;

    fn waiting_for_a_full_queue() -> (Arc<Queue<i32>>, Producer) {
        let queue = Arc::new(Queue::new(1));
        queue.push_or_drop_oldest(0);
        let waiting = thread::spawn({
            let queue = Arc::clone(&queue);
            move || queue.push_or_wait(1, LONG)
        });
        (queue, waiting)
    }

    #[test]
    fn a_pop_wakes_a_waiting_producer() {
        let (queue, waiting) = waiting_for_a_full_queue();
        assert_eq!([queue.pop(LONG), queue.pop(LONG)], [Some(0), Some(1)]);
        waiting.join().unwrap().unwrap();
    }

    #[test]
    fn closing_wakes_a_waiting_producer_and_returns_the_items() {
        let (queue, waiting) = waiting_for_a_full_queue();
        assert_eq!(queue.close(), [0]);
        assert_eq!(waiting.join().unwrap(), Err(PushError::Closed(1)));
        queue.push_or_drop_oldest(2);
        assert_eq!(queue.pop(Duration::ZERO), None);
    }
}
