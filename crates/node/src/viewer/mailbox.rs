//! Messages waiting for one browser: the newest frame and a few texts.

use std::{
    collections::VecDeque,
    sync::{
        Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use axum::body::Bytes;
use tokio::sync::Notify;

/// Maximum number of waiting texts; the oldest are dropped.
const MAX_TEXTS: usize = 16;

/// A message to a browser.
#[derive(Clone, Debug, PartialEq)]
pub(super) enum Outgoing {
    /// A frame ([`wire`](super::wire)).
    Frame(Bytes),
    /// JSON ([`protocol`](super::protocol)).
    Text(String),
}

/// The mailbox of one browser. Adding a message never blocks: a frame replaces one that was not fetched, which counts as
/// dropped.
#[derive(Debug, Default)]
pub(super) struct Mailbox {
    waiting: Mutex<Waiting>,
    dropped: AtomicU64,
    arrived: Notify,
}

#[derive(Debug, Default)]
struct Waiting {
    frame: Option<Bytes>,
    texts: VecDeque<String>,
    /// The selected stream; the current one if `None`.
    stream: Option<u64>,
}

impl Mailbox {
    pub(super) fn put(&self, frame: Bytes) {
        if self.lock().frame.replace(frame).is_some() {
            self.dropped.fetch_add(1, Ordering::Relaxed);
        }
        self.arrived.notify_one();
    }

    pub(super) fn put_text(&self, text: String) {
        let mut waiting = self.lock();
        if waiting.texts.len() >= MAX_TEXTS {
            waiting.texts.pop_front();
        }
        waiting.texts.push_back(text);
        drop(waiting);
        self.arrived.notify_one();
    }

    /// The next message, texts first; frames only if `with_frames`. Cancel-safe.
    pub(super) async fn next(&self, with_frames: bool) -> Outgoing {
        loop {
            if let Some(mail) = self.fetch(with_frames) {
                return mail;
            }
            self.arrived.notified().await;
        }
    }

    fn fetch(&self, with_frames: bool) -> Option<Outgoing> {
        let mut waiting = self.lock();
        if let Some(text) = waiting.texts.pop_front() {
            return Some(Outgoing::Text(text));
        }
        if with_frames { waiting.frame.take().map(Outgoing::Frame) } else { None }
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
    fn only_the_newest_frame_waits_and_texts_come_first() {
        let mailbox = Mailbox::default();
        for number in 0..10u8 {
            mailbox.put(Bytes::from(vec![number]));
        }
        mailbox.put_text("hello".into());
        assert_eq!(mailbox.dropped(), 9);
        assert_eq!(mailbox.fetch(true), Some(Outgoing::Text("hello".into())));
        assert_eq!(mailbox.fetch(false), None);
        assert_eq!(mailbox.fetch(true), Some(Outgoing::Frame(Bytes::from(vec![9]))));
        assert_eq!(mailbox.fetch(true), None);
    }

    #[test]
    fn the_number_of_texts_is_bounded() {
        let mailbox = Mailbox::default();
        (0..100).for_each(|number| mailbox.put_text(number.to_string()));
        let texts = std::iter::from_fn(|| mailbox.fetch(true)).count();
        assert_eq!(texts, MAX_TEXTS);
    }
}
