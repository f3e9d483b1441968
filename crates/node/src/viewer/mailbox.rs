//! What waits for one browser: the newest frame, and a few words.

use std::{
    collections::VecDeque,
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use axum::body::Bytes;
use tokio::sync::Notify;

/// Words that wait, at most; of more the oldest go.
const WORDS: usize = 16;

/// Something for a browser.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Mail {
    /// A frame ([`wire`](super::wire)).
    Frame(Bytes),
    /// JSON.
    Words(String),
}

/// The mailbox of one browser. Who puts something in never waits: a frame takes the place of one that was not fetched,
/// which is counted.
#[derive(Debug, Default)]
pub(super) struct Mailbox {
    waiting: Mutex<Waiting>,
    dropped: AtomicU64,
    arrived: Notify,
}

#[derive(Debug, Default)]
struct Waiting {
    frame: Option<Bytes>,
    words: VecDeque<String>,
    /// The stream that the browser wants; the current one if `None`.
    stream: Option<u64>,
}

impl Mailbox {
    pub(super) fn put(&self, frame: Bytes) {
        if self.lock().frame.replace(frame).is_some() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
        self.arrived.notify_one();
    }

    pub(super) fn say(&self, words: String) {
        let mut waiting = self.lock();
        if waiting.words.len() >= WORDS {
            waiting.words.pop_front();
        }
        waiting.words.push_back(words);
        drop(waiting);
        self.arrived.notify_one();
    }

    /// The next thing, words first; frames only where they are `wanted`. Nothing is lost when this is given up.
    pub(super) async fn next(&self, wanted: bool) -> Mail {
        loop {
            if let Some(mail) = self.fetch(wanted) {
                return mail;
            }
            self.arrived.notified().await;
        }
    }

    fn fetch(&self, wanted: bool) -> Option<Mail> {
        let mut waiting = self.lock();
        if let Some(words) = waiting.words.pop_front() {
            return Some(Mail::Words(words));
        }
        if wanted { waiting.frame.take().map(Mail::Frame) } else { None }
    }

    /// Frames that were not fetched in time.
    pub(super) fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    pub(super) fn select(&self, stream: Option<u64>) {
        let mut waiting = self.lock();
        waiting.stream = stream;
        waiting.frame = None;
    }

    pub(super) fn stream(&self) -> Option<u64> {
        self.lock().stream
    }

    fn lock(&self) -> MutexGuard<'_, Waiting> {
        self.waiting.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_newest_frame_waits_the_others_are_counted_and_words_go_first() {
        let mailbox = Mailbox::default();
        for number in 0..10u8 {
            mailbox.put(Bytes::from(vec![number]));
        }
        mailbox.say("hello".into());
        assert_eq!(mailbox.dropped(), 9);
        assert_eq!(mailbox.fetch(true), Some(Mail::Words("hello".into())));
        assert_eq!(mailbox.fetch(false), None);
        assert_eq!(mailbox.fetch(true), Some(Mail::Frame(Bytes::from(vec![9]))));
        assert_eq!(mailbox.fetch(true), None);
    }

    #[test]
    fn words_are_bounded() {
        let mailbox = Mailbox::default();
        (0..100).for_each(|number| mailbox.say(number.to_string()));
        let words = std::iter::from_fn(|| mailbox.fetch(true)).count();
        assert_eq!(words, WORDS);
    }
}
