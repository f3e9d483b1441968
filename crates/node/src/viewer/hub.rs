//! Where a node leaves copies of its frames while somebody looks.

use std::{
    collections::BTreeMap,
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
    time::Duration,
};

use axum::body::Bytes;

use super::{comparison::Ahead, curves::Curves, mailbox::Mailbox};
use eddy_frames::{Frame, FrameView, clock::Clock};
use eddy_transport::Queue;

/// Frames that wait for the composer, truth and predictions together.
const WAITING: usize = 8;
/// Streams that are listed.
const LISTED: usize = 256;
/// A stream that was silent for so long makes room as the one that is shown.
const SILENT: Duration = Duration::from_secs(1);
/// A stream that was silent for so long, while others were not, is no longer listed, and nobody's choice any more.
const GONE: Duration = Duration::from_secs(10);

/// A copy of a frame.
#[derive(Debug)]
pub(super) enum Copied {
    /// What was observed.
    Truth(Frame),
    /// What was predicted.
    Prediction(Frame, Ahead),
}

/// What a node says of itself, once a second.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Report {
    /// Predictions a second.
    pub rate: f64,
    /// Median and 99th percentile of the time from a frame's arrival to its predictions' publication.
    pub latency: [Duration; 2],
    /// Streams that the node keeps.
    pub streams: usize,
    /// Frames that were lost before the model saw them.
    pub lost: u64,
    /// Everything it counts, by name.
    pub counters: Vec<(&'static str, u64)>,
}

/// Between one source of frames and the browsers that look at it. While nobody looks, a frame costs the source one look
/// at an atomic number; while somebody does, one copy of the frames of the streams that are shown.
#[derive(Debug)]
pub struct Hub {
    clock: Clock,
    inbox: Queue<Copied>,
    browsers: AtomicUsize,
    state: Mutex<State>,
    observed: AtomicU64,
    predicted: AtomicU64,
    shown: AtomicU64,
}

#[derive(Debug, Default)]
struct State {
    browsers: Vec<Arc<Mailbox>>,
    streams: BTreeMap<u64, Seen>,
    /// When a frame of any stream came last.
    latest: Duration,
    /// The stream that is shown to who did not choose one.
    current: Option<u64>,
    report: Option<Report>,
    curves: BTreeMap<u64, Arc<Curves>>,
}

/// What is known of a stream.
#[derive(Clone, Copy, Debug)]
struct Seen {
    /// When its last frame came.
    at: Duration,
    /// Whether its source said that no more come, but for those that are on their way.
    ended: bool,
}

impl State {
    /// Whether it makes room as the one that is shown.
    fn is_over(&self, stream: u64) -> bool {
        let seen = self.streams.get(&stream);
        seen.is_none_or(|seen| seen.ended || self.latest.saturating_sub(seen.at) > SILENT)
    }

    /// Forgets streams of which nothing came while others went on; where all pause, all stay.
    fn forget(&mut self) {
        let Self { streams, current, latest, browsers, .. } = self;
        streams.retain(|&stream, seen| {
            latest.saturating_sub(seen.at) < GONE || *current == Some(stream)
        });
        for browser in browsers {
            let gone = |stream| streams.get(&stream).is_none_or(|seen: &Seen| seen.ended);
            if browser.stream().is_some_and(gone) {
                browser.select(None);
            }
        }
    }
}

impl Default for Hub {
    fn default() -> Self {
        Self {
            clock: Clock::start(),
            inbox: Queue::new(WAITING),
            browsers: AtomicUsize::new(0),
            state: Mutex::default(),
            observed: AtomicU64::new(0),
            predicted: AtomicU64::new(0),
            shown: AtomicU64::new(0),
        }
    }
}

impl Hub {
    /// Whether somebody looks.
    pub fn is_watched(&self) -> bool {
        self.browsers.load(Ordering::Relaxed) > 0
    }

    /// A frame was observed. Never waits.
    pub fn observed(&self, frame: &FrameView<'_>) {
        self.observed.fetch_add(1, Ordering::Relaxed);
        if self.is_watched() && self.wants(frame.stream) {
            self.inbox.push_or_drop_oldest(Copied::Truth(frame.to_frame()));
        }
    }

    /// A frame was predicted. Never waits.
    pub fn predicted(&self, frame: &Frame, ahead: Ahead) {
        self.predicted.fetch_add(1, Ordering::Relaxed);
        if self.is_watched() && self.wants(frame.stream) {
            self.inbox.push_or_drop_oldest(Copied::Prediction(frame.clone(), ahead));
        }
    }

    /// The node speaks of itself.
    pub fn report(&self, report: Report) {
        self.lock().report = Some(report);
    }

    /// A stream has ended: the next one is shown to who did not choose another.
    pub fn ended(&self, stream: u64) {
        let mut state = self.lock();
        if let Some(seen) = state.streams.get_mut(&stream) {
            seen.ended = true;
        }
    }

    /// Whether a browser wants to see this stream, which is listed from now on.
    fn wants(&self, stream: u64) -> bool {
        let now = self.clock.now();
        let mut state = self.lock();
        state.latest = now;
        if state.streams.len() >= LISTED {
            state.forget();
        }
        if state.streams.len() < LISTED || state.streams.contains_key(&stream) {
            let seen = state.streams.entry(stream).or_insert(Seen { at: now, ended: false });
            seen.at = now;
        }
        // What is still on its way from a stream that ended takes nobody's place.
        let goes_on = state.streams.get(&stream).is_none_or(|seen| !seen.ended);
        if goes_on && state.current.is_none_or(|current| state.is_over(current)) {
            state.current = Some(stream);
        }
        let current = state.current;
        state.browsers.iter().any(|browser| browser.stream().or(current) == Some(stream))
    }

    /// The next copy, or `None` when none came within `timeout`.
    pub(super) fn next(&self, timeout: Duration) -> Option<Copied> {
        self.inbox.pop(timeout)
    }

    /// Copies that the composer was too slow for.
    pub(super) fn skipped(&self) -> u64 {
        self.inbox.dropped()
    }

    /// A browser comes, if there is room for one more.
    pub(super) fn join(&self, limit: usize) -> Option<Arc<Mailbox>> {
        let mut state = self.lock();
        if state.browsers.len() >= limit {
            return None;
        }
        let mailbox = Arc::new(Mailbox::default());
        state.browsers.push(Arc::clone(&mailbox));
        self.browsers.store(state.browsers.len(), Ordering::Relaxed);
        Some(mailbox)
    }

    /// A browser is gone.
    pub(super) fn leave(&self, mailbox: &Arc<Mailbox>) {
        let mut state = self.lock();
        state.browsers.retain(|other| !Arc::ptr_eq(other, mailbox));
        self.browsers.store(state.browsers.len(), Ordering::Relaxed);
    }

    /// A frame for every browser that looks at its stream.
    pub(super) fn show(&self, stream: u64, frame: &Bytes) {
        self.shown.fetch_add(1, Ordering::Relaxed);
        let state = self.lock();
        let looks = |browser: &&Arc<Mailbox>| browser.stream().or(state.current) == Some(stream);
        state.browsers.iter().filter(looks).for_each(|browser| browser.put(frame.clone()));
    }

    pub(super) fn draw(&self, stream: u64, curves: Curves) {
        let mut state = self.lock();
        let State { streams, curves: all, .. } = &mut *state;
        all.insert(stream, Arc::new(curves));
        all.retain(|stream, _| streams.contains_key(stream));
    }

    /// The curves of the stream that a browser looks at.
    pub(super) fn curves(&self, mailbox: &Mailbox) -> (Option<u64>, Option<Arc<Curves>>) {
        let state = self.lock();
        let stream = mailbox.stream().or(state.current);
        (stream, stream.and_then(|stream| state.curves.get(&stream).cloned()))
    }

    /// The streams that were seen lately, and the one that is shown.
    pub(super) fn streams(&self) -> Vec<u64> {
        let mut state = self.lock();
        state.forget();
        let shown = |(&stream, seen): (&u64, &Seen)| {
            (!seen.ended || state.current == Some(stream)).then_some(stream)
        };
        state.streams.iter().filter_map(shown).collect()
    }

    pub(super) fn last_report(&self) -> Option<Report> {
        self.lock().report.clone()
    }

    /// Browsers, and since the start: frames observed, predicted, made ready to be shown.
    pub(super) fn counts(&self) -> (usize, [u64; 3]) {
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let counts = [&self.observed, &self.predicted, &self.shown].map(count);
        (self.browsers.load(Ordering::Relaxed), counts)
    }

    /// Nothing is computed, and nothing that can panic is called, while this is held.
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{Domain, Material, Stamp};

    fn frame(stream: u64) -> Frame {
        Frame {
            stream,
            sequence: 1,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain::UNIT,
            position: vec![[0.5; 2]],
            velocity: vec![[0.0; 2]],
            material: vec![Material::Liquid],
        }
    }

    #[test]
    fn nothing_is_copied_while_nobody_looks() {
        let hub = Hub::default();
        hub.observed(&(&frame(1)).into());
        assert!(hub.next(Duration::ZERO).is_none());
        let browser = hub.join(1).unwrap();
        hub.observed(&(&frame(1)).into());
        assert!(hub.next(Duration::ZERO).is_some());
        hub.leave(&browser);
        hub.observed(&(&frame(1)).into());
        assert!(hub.next(Duration::ZERO).is_none());
        assert_eq!(hub.counts(), (0, [3, 0, 0]));
    }

    #[test]
    fn only_streams_that_are_shown_are_copied_and_others_are_listed() {
        let hub = Hub::default();
        let browser = hub.join(1).unwrap();
        for stream in [4, 5] {
            hub.observed(&(&frame(stream)).into());
        }
        assert!(
            matches!(hub.next(Duration::ZERO), Some(Copied::Truth(frame)) if frame.stream == 4)
        );
        assert!(hub.next(Duration::ZERO).is_none());
        assert_eq!(hub.streams(), [4, 5]);
        browser.select(Some(5));
        for stream in [4, 5] {
            hub.observed(&(&frame(stream)).into());
        }
        assert!(
            matches!(hub.next(Duration::ZERO), Some(Copied::Truth(frame)) if frame.stream == 5)
        );
    }

    #[test]
    fn a_stream_that_ended_makes_room_at_once_and_is_nobodys_choice() {
        let hub = Hub::default();
        let (follower, other) = (hub.join(3).unwrap(), hub.join(3).unwrap());
        let observe = |stream| hub.observed(&(&frame(stream)).into());
        let copied = || match hub.next(Duration::ZERO) {
            Some(Copied::Truth(frame)) => Some(frame.stream),
            _ => None,
        };
        observe(4);
        other.select(Some(4));
        assert_eq!(copied(), Some(4));
        hub.ended(4);
        // What was on its way is shown, until the next one begins.
        observe(4);
        assert_eq!(copied(), Some(4));
        observe(5);
        assert_eq!(copied(), Some(5));
        assert_eq!(hub.streams(), [5]);
        assert_eq!((follower.stream(), other.stream()), (None, None));
        observe(4);
        assert_eq!(copied(), None);
        assert_eq!(hub.curves(&other).0, Some(5));
    }

    #[test]
    fn a_choice_that_was_never_there_is_given_up() {
        let hub = Hub::default();
        let browser = hub.join(1).unwrap();
        hub.observed(&(&frame(4)).into());
        browser.select(Some(9));
        assert_eq!(hub.streams(), [4]);
        assert_eq!(browser.stream(), None);
    }

    #[test]
    fn a_composer_that_is_late_costs_frames_and_no_memory() {
        let hub = Hub::default();
        let _browser = hub.join(1).unwrap();
        for _ in 0..100 {
            hub.observed(&(&frame(1)).into());
        }
        assert_eq!(hub.skipped(), 100 - WAITING as u64);
        assert_eq!(std::iter::from_fn(|| hub.next(Duration::ZERO)).count(), WAITING);
    }

    #[test]
    fn there_is_room_for_so_many_browsers() {
        let hub = Hub::default();
        let first = hub.join(1).unwrap();
        assert!(hub.join(1).is_none());
        hub.leave(&first);
        assert!(hub.join(1).is_some());
    }
}
