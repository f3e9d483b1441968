//! Messages waiting for the node.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use super::Arrival;
use eddy_transport::{Payload, PushError, Queue, Reliability};

/// Interval at which a blocked receiver checks whether the queue was closed.
const POLL_INTERVAL: Duration = Duration::from_millis(100);
/// Streams whose losses are counted separately.
const COUNTED_STREAMS: usize = 1024;

/// A bounded queue between the thread that receives and the node that predicts. When it is full,
/// [`Reliability::Block`] makes the receiver wait, and [`Reliability::Drop`] drops the oldest half of the messages of the
/// stream with the most messages in the queue: a stream that floods the node loses frames, streams within their share do
/// not. Ties are broken by the age of the oldest message, so that losses are distributed evenly.
///
/// Half of them at once, because one long gap costs less than many short ones: a node that is too slow would fill each
/// short gap with a prediction, which takes as long as a frame, and would be slower still. After a long gap it warms up
/// again.
#[derive(Debug)]
pub struct FrameQueue {
    messages: Queue<Waiting>,
    reliability: Reliability,
    dropped: Mutex<BTreeMap<u64, u64>>,
    closed: AtomicBool,
}

#[derive(Debug)]
struct Waiting {
    /// `None` for a message that cannot be decoded.
    stream: Option<u64>,
    arrival: Arrival,
}

impl FrameQueue {
    /// An empty queue for `capacity` messages; 0 counts as 1.
    pub fn new(capacity: usize, reliability: Reliability) -> Self {
        let messages = Queue::new(capacity.max(1));
        Self { messages, reliability, dropped: Mutex::default(), closed: AtomicBool::new(false) }
    }

    /// Adds a message. Returns whether the queue is still open.
    pub fn push(&self, arrived: Duration, payload: Payload) -> bool {
        let stream = payload.stream();
        let mut message = Waiting { stream, arrival: (arrived, payload) };
        loop {
            if self.is_closed() {
                return false;
            }
            match self.reliability {
                Reliability::Drop => {
                    let dropped =
                        self.messages.push_or_drop(message, |waiting| oldest_half(waiting, stream));
                    dropped.iter().filter_map(|message| message.stream).for_each(|stream| {
                        self.count(stream);
                    });
                    return true;
                }
                Reliability::Block => match self.messages.push_or_wait(message, POLL_INTERVAL) {
                    Ok(()) => return true,
                    Err(PushError::Full(back) | PushError::Closed(back)) => message = back,
                },
            }
        }
    }

    /// The oldest message, or `None` after `timeout`.
    pub fn pop(&self, timeout: Duration) -> Option<Arrival> {
        self.messages.pop(timeout).map(|message| message.arrival)
    }

    /// Moves the oldest messages into the empty `batch`, up to `limit` and up to the first that belongs to a stream
    /// already in the batch; none after `timeout`.
    pub fn pop_batch(&self, timeout: Duration, limit: usize, batch: &mut Vec<Arrival>) {
        let streams = |batch: &[Arrival], stream: Option<u64>| {
            stream.is_some() && batch.iter().all(|(_, payload)| payload.stream() != stream)
        };
        let keep = |message: Waiting| message.arrival;
        self.messages.pop_while(timeout, batch, keep, |batch: &[Arrival], next| {
            batch.len() < limit && streams(batch, next.stream)
        });
    }

    /// Messages dropped so far.
    pub fn dropped(&self) -> u64 {
        self.messages.dropped()
    }

    /// The dropped messages of each stream that lost any.
    pub fn dropped_by_stream(&self) -> BTreeMap<u64, u64> {
        self.dropped.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    fn count(&self, stream: u64) {
        let mut dropped = self.dropped.lock().unwrap_or_else(PoisonError::into_inner);
        if dropped.len() < COUNTED_STREAMS || dropped.contains_key(&stream) {
            *dropped.entry(stream).or_default() += 1;
        }
    }

    /// Rejects further messages; those in the queue can still be popped.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Relaxed);
    }

    /// Whether the queue was closed.
    pub fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Relaxed)
    }
}

/// Indices of the oldest half of the messages of the stream with the most messages, the arriving one included.
fn oldest_half(waiting: &VecDeque<Waiting>, arriving: Option<u64>) -> Vec<usize> {
    let mut shares = BTreeMap::from([(arriving, 1)]);
    for message in waiting {
        *shares.entry(message.stream).or_default() += 1;
    }
    let most = waiting.iter().map(|message| shares[&message.stream]).max();
    let chosen = waiting.iter().find(|message| Some(shares[&message.stream]) == most);
    let Some(chosen) = chosen.map(|message| message.stream) else { return Vec::new() };
    let of_stream = waiting.iter().enumerate().filter(|(_, message)| message.stream == chosen);
    let half = of_stream.clone().count().div_ceil(2);
    of_stream.take(half).map(|(index, _)| index).collect()
}

#[cfg(test)]
mod tests {
    use std::thread;

    use super::*;
    use eddy_frames::{Domain, Frame, Material, Stamp};

    fn message(number: u8) -> Payload {
        Payload::Cdr(vec![number])
    }

    #[test]
    fn drop_removes_the_oldest_message_and_counts_it() {
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
    fn a_single_stream_loses_many_frames_at_once_and_not_one_at_a_time() {
        let queue = FrameQueue::new(64, Reliability::Drop);
        let mut seen = Vec::new();
        // Three frames arrive while the node predicts from two.
        for number in 0..300 {
            queue.push(Duration::ZERO, of_stream(0, number));
            if number % 3 != 0 {
                seen.extend(queue.pop(Duration::ZERO).and_then(|(_, payload)| match payload {
                    Payload::Frame(frame) => Some(frame.sequence),
                    _ => None,
                }));
            }
        }
        let gaps: Vec<u64> =
            seen.windows(2).map(|pair| pair[1] - pair[0] - 1).filter(|&gap| gap > 0).collect();
        assert!(!gaps.is_empty() && gaps.iter().all(|&gap| gap >= 31), "{gaps:?}");
    }

    /// Message `number` of a stream.
    fn of_stream(stream: u64, number: u64) -> Payload {
        Payload::Frame(Frame {
            stream,
            sequence: number,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain::UNIT,
            position: vec![[0.5; 2]],
            velocity: vec![[0.0; 2]],
            material: vec![Material::Liquid],
        })
    }

    fn streams(batch: &[Arrival]) -> Vec<Option<u64>> {
        batch.iter().map(|(_, payload)| payload.stream()).collect()
    }

    #[test]
    fn a_flooding_stream_loses_only_its_own_messages() {
        let queue = FrameQueue::new(16, Reliability::Drop);
        for number in 0..100 {
            queue.push(Duration::ZERO, of_stream(0, number));
            // Seven slow streams: each has two messages waiting in the end.
            if number % 50 == 25 {
                (1..8).for_each(|stream| {
                    queue.push(Duration::ZERO, of_stream(stream, number));
                });
            }
        }
        let lost = 100 - 2;
        assert_eq!((queue.dropped(), queue.dropped_by_stream()), (lost, [(0, lost)].into()));
        let left: Vec<_> = std::iter::from_fn(|| queue.pop(Duration::ZERO)).collect();
        let of = |stream: u64| left.iter().filter(|(_, p)| p.stream() == Some(stream)).count();
        assert_eq!((0..8).map(of).collect::<Vec<_>>(), [2; 8]);
    }

    #[test]
    fn streams_of_equal_rate_lose_equally() {
        let queue = FrameQueue::new(8, Reliability::Drop);
        for number in 0..100 {
            (0..4).for_each(|stream| {
                queue.push(Duration::ZERO, of_stream(stream, number));
            });
        }
        assert_eq!(queue.dropped_by_stream(), (0..4).map(|stream| (stream, 98)).collect());
    }

    #[test]
    fn a_batch_has_a_message_of_each_stream_and_keeps_the_order() {
        let queue = FrameQueue::new(16, Reliability::Drop);
        for stream in [1, 2, 3, 2, 1, 4, 5] {
            queue.push(Duration::ZERO, of_stream(stream, 0));
        }
        let mut batch = Vec::new();
        for expected in [vec![1, 2, 3], vec![2, 1], vec![4, 5], vec![]] {
            batch.clear();
            queue.pop_batch(Duration::ZERO, if expected.len() == 2 { 2 } else { 8 }, &mut batch);
            assert_eq!(streams(&batch), expected.into_iter().map(Some).collect::<Vec<_>>());
        }
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
    fn closing_releases_a_waiting_writer() {
        let queue = FrameQueue::new(1, Reliability::Block);
        queue.push(Duration::ZERO, message(0));
        thread::scope(|scope| {
            let writer = scope.spawn(|| queue.push(Duration::ZERO, message(1)));
            queue.close();
            assert!(!writer.join().unwrap());
        });
    }
}
