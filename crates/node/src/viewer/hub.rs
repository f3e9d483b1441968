//! Copies of frames for the page while a browser is connected.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{
        Arc, Mutex, MutexGuard, PoisonError,
        atomic::{AtomicU64, AtomicUsize, Ordering},
    },
    time::Duration,
};

use axum::body::Bytes;

use super::{comparison::PredictionInfo, curves::Curves, mailbox::Mailbox};
use crate::GroupCounts;
use eddy_frames::{
    Frame, FrameView,
    clock::Clock,
    tool::{ForceScale, Shape, ToolFrame, Tools, shapes},
};
use eddy_transport::Queue;

/// Frames waiting for the composer, truth and predictions together.
const QUEUE_FRAMES: usize = 8;
/// Maximum number of listed streams.
const MAX_STREAMS: usize = 256;
/// Frames of tools that are kept of a stream: a frame may be displayed some time after it was observed.
const TOOL_FRAMES: usize = 64;
/// Silence after which another stream becomes the current one.
const SILENCE_TIMEOUT: Duration = Duration::from_secs(1);
/// Silence, while other streams continue, after which a stream is no longer listed or selected.
const STREAM_TIMEOUT: Duration = Duration::from_secs(10);

/// A copy of a frame.
#[derive(Debug)]
pub(super) enum FrameCopy {
    /// An observed frame.
    Truth(Frame),
    /// A predicted frame.
    Prediction(Frame, PredictionInfo),
}

/// The state of a node, once a second.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct NodeStatus {
    /// Predictions a second.
    pub rate: f64,
    /// Median and 99th percentile of the time from the arrival of a frame to the publication of its predictions.
    pub latency: [Duration; 2],
    /// Number of streams that the node keeps.
    pub streams: usize,
    /// Frames lost before the model saw them.
    pub lost: u64,
    /// Members and streams of its group, if it has one.
    pub group: Option<GroupCounts>,
    /// All counters by name.
    pub counters: Vec<(&'static str, u64)>,
    /// Why frames are being rejected: the last reason.
    pub rejected: Option<String>,
    /// How streams differ from what the model was trained on: the stream and a sentence.
    pub warnings: Vec<(u64, String)>,
}

/// Connects one source of frames to browsers. Without a browser, a frame costs the source the increment of a counter and
/// a load; with browsers, a copy if its stream is displayed.
#[derive(Debug)]
pub struct Hub {
    clock: Clock,
    inbox: Queue<FrameCopy>,
    browsers: AtomicUsize,
    state: Mutex<HubState>,
    observed: AtomicU64,
    predicted: AtomicU64,
    shown: AtomicU64,
}

#[derive(Debug, Default)]
struct HubState {
    browsers: Vec<Arc<Mailbox>>,
    streams: BTreeMap<u64, StreamActivity>,
    /// Time of the last frame of any stream.
    latest: Duration,
    /// The stream displayed to browsers that did not select one.
    current: Option<u64>,
    status: Option<NodeStatus>,
    curves: BTreeMap<u64, Arc<Curves>>,
    /// Names of streams, if they have some.
    names: BTreeMap<u64, String>,
    /// Tools of streams, if they have some.
    tools: BTreeMap<u64, StreamTools>,
}

/// The tools of a stream.
#[derive(Debug)]
struct StreamTools {
    tools: Tools,
    /// Where they are at its last frames.
    frames: VecDeque<ToolFrame>,
    /// The strongest force so far, by which arrows are drawn.
    strongest: f64,
}

#[derive(Clone, Copy, Debug)]
struct StreamActivity {
    /// Time of its last frame.
    at: Duration,
    /// Whether its source has ended it. Frames under way may still arrive.
    ended: bool,
}

impl HubState {
    /// Whether another stream may replace this one as the current one.
    fn is_replaceable(&self, stream: u64) -> bool {
        let activity = self.streams.get(&stream);
        activity
            .is_none_or(|seen| seen.ended || self.latest.saturating_sub(seen.at) > SILENCE_TIMEOUT)
    }

    /// Removes streams that were silent while others continued; if all pause, all stay.
    fn remove_silent(&mut self) {
        let Self { streams, current, latest, browsers, .. } = self;
        streams.retain(|&stream, seen| {
            latest.saturating_sub(seen.at) < STREAM_TIMEOUT || *current == Some(stream)
        });
        for browser in browsers {
            let gone = |stream| streams.get(&stream).is_none_or(|seen: &StreamActivity| seen.ended);
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
            inbox: Queue::new(QUEUE_FRAMES),
            browsers: AtomicUsize::new(0),
            state: Mutex::default(),
            observed: AtomicU64::new(0),
            predicted: AtomicU64::new(0),
            shown: AtomicU64::new(0),
        }
    }
}

impl Hub {
    /// Whether a browser is connected.
    pub fn is_watched(&self) -> bool {
        self.browsers.load(Ordering::Relaxed) > 0
    }

    /// Passes on an observed frame. Never blocks.
    pub fn observed(&self, frame: &FrameView<'_>) {
        self.observed.fetch_add(1, Ordering::Relaxed);
        if self.is_watched() && self.note_activity(frame.stream) {
            self.inbox.push_or_drop_oldest(FrameCopy::Truth(frame.to_frame()));
        }
    }

    /// Passes on a predicted frame. Never blocks.
    pub fn predicted(&self, frame: &Frame, info: PredictionInfo) {
        self.predicted.fetch_add(1, Ordering::Relaxed);
        if self.is_watched() && self.note_activity(frame.stream) {
            self.inbox.push_or_drop_oldest(FrameCopy::Prediction(frame.clone(), info));
        }
    }

    /// Passes on the state of the node.
    pub fn report(&self, status: NodeStatus) {
        self.lock().status = Some(status);
    }

    /// Gives a stream a name. Those of streams that have ended are forgotten.
    pub fn begins(&self, stream: u64, name: String) {
        let mut state = self.lock();
        let HubState { names, streams, .. } = &mut *state;
        names.retain(|stream, _| streams.get(stream).is_none_or(|seen| !seen.ended));
        names.insert(stream, name);
    }

    /// Says what the tools of a stream are. Those of streams that are no longer listed are forgotten.
    pub fn describes(&self, tools: Tools) {
        let mut state = self.lock();
        if state.tools.len() >= MAX_STREAMS {
            let HubState { tools, streams, .. } = &mut *state;
            tools.retain(|stream, _| streams.contains_key(stream));
        }
        let known = state.tools.get(&tools.stream).is_some_and(|known| known.tools == tools);
        if !known && state.tools.len() < MAX_STREAMS {
            let begun = StreamTools { frames: VecDeque::new(), strongest: 0.0, tools };
            state.tools.insert(begun.tools.stream, begun);
        }
    }

    /// The tools of a stream, if it has some.
    pub fn tools(&self, stream: u64) -> Option<Tools> {
        self.lock().tools.get(&stream).map(|known| known.tools.clone())
    }

    /// Says where the tools of a stream are at a frame.
    pub fn moved(&self, frame: ToolFrame) {
        let mut state = self.lock();
        let Some(known) = state.tools.get_mut(&frame.stream) else { return };
        known.strongest = known.strongest.max(frame.strongest_force());
        // A stream that begins again.
        while known.frames.back().is_some_and(|last| last.sequence >= frame.sequence) {
            known.frames.pop_back();
        }
        if known.frames.len() == TOOL_FRAMES {
            known.frames.pop_front();
        }
        known.frames.push_back(frame);
    }

    /// The tools of a stream at a frame, or at the last one before it that is known, as shapes in a domain of this height.
    pub(super) fn shapes(&self, stream: u64, sequence: u64, height: f32) -> Vec<Shape> {
        let state = self.lock();
        let Some(StreamTools { tools, frames, strongest }) = state.tools.get(&stream) else {
            return Vec::new();
        };
        let frame = frames.iter().rev().find(|frame| frame.sequence <= sequence);
        let scale = ForceScale::new(*strongest, height);
        frame.map_or_else(Vec::new, |frame| shapes(tools, frame, scale))
    }

    /// The name of a stream.
    pub(super) fn name(&self, stream: u64) -> Option<String> {
        self.lock().names.get(&stream).cloned()
    }

    /// Ends a stream: the next one becomes the current one.
    pub fn ended(&self, stream: u64) {
        let mut state = self.lock();
        if let Some(seen) = state.streams.get_mut(&stream) {
            seen.ended = true;
        }
    }

    /// Records a frame of the stream. Returns whether a browser displays it.
    fn note_activity(&self, stream: u64) -> bool {
        let now = self.clock.now();
        let mut state = self.lock();
        state.latest = now;
        if state.streams.len() >= MAX_STREAMS {
            state.remove_silent();
        }
        if state.streams.len() < MAX_STREAMS || state.streams.contains_key(&stream) {
            let seen =
                state.streams.entry(stream).or_insert(StreamActivity { at: now, ended: false });
            seen.at = now;
        }
        // The last frames of an ended stream do not make it the current one again.
        let continues = state.streams.get(&stream).is_none_or(|seen| !seen.ended);
        if continues && state.current.is_none_or(|current| state.is_replaceable(current)) {
            state.current = Some(stream);
        }
        let current = state.current;
        state.browsers.iter().any(|browser| browser.stream().or(current) == Some(stream))
    }

    /// The next copy, or `None` after `timeout`.
    pub(super) fn next(&self, timeout: Duration) -> Option<FrameCopy> {
        self.inbox.pop(timeout)
    }

    /// Copies dropped because the composer was too slow.
    pub(super) fn skipped(&self) -> u64 {
        self.inbox.dropped()
    }

    /// Connects a browser unless `limit` are connected.
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

    /// Disconnects a browser.
    pub(super) fn leave(&self, mailbox: &Arc<Mailbox>) {
        let mut state = self.lock();
        state.browsers.retain(|other| !Arc::ptr_eq(other, mailbox));
        self.browsers.store(state.browsers.len(), Ordering::Relaxed);
    }

    /// Sends a frame to every browser that displays its stream.
    pub(super) fn show(&self, stream: u64, frame: &Bytes) {
        self.shown.fetch_add(1, Ordering::Relaxed);
        let state = self.lock();
        let displays = |browser: &&Arc<Mailbox>| browser.stream().or(state.current) == Some(stream);
        state.browsers.iter().filter(displays).for_each(|browser| browser.put(frame.clone()));
    }

    /// Keeps the curves of a stream.
    pub(super) fn store_curves(&self, stream: u64, curves: Curves) {
        let mut state = self.lock();
        let HubState { streams, curves: all, .. } = &mut *state;
        all.insert(stream, Arc::new(curves));
        all.retain(|stream, _| streams.contains_key(stream));
    }

    /// The stream that a browser displays, and its curves.
    pub(super) fn curves(&self, mailbox: &Mailbox) -> (Option<u64>, Option<Arc<Curves>>) {
        let state = self.lock();
        let stream = mailbox.stream().or(state.current);
        (stream, stream.and_then(|stream| state.curves.get(&stream).cloned()))
    }

    /// The listed streams.
    pub(super) fn streams(&self) -> Vec<u64> {
        let mut state = self.lock();
        state.remove_silent();
        let shown = |(&stream, seen): (&u64, &StreamActivity)| {
            (!seen.ended || state.current == Some(stream)).then_some(stream)
        };
        state.streams.iter().filter_map(shown).collect()
    }

    pub(super) fn node_status(&self) -> Option<NodeStatus> {
        self.lock().status.clone()
    }

    /// Connected browsers; frames observed, predicted and encoded since the start.
    pub(super) fn counts(&self) -> (usize, [u64; 3]) {
        let count = |counter: &AtomicU64| counter.load(Ordering::Relaxed);
        let counts = [&self.observed, &self.predicted, &self.shown].map(count);
        (self.browsers.load(Ordering::Relaxed), counts)
    }

    /// No code that can panic runs while this is held.
    fn lock(&self) -> MutexGuard<'_, HubState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{
        Domain, Material, Stamp,
        tool::{Contact, Outline, Part, Pose, Tool, ToolState},
    };

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
    fn nothing_is_copied_without_a_browser() {
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
    fn the_tools_of_a_frame_are_those_of_its_number_or_the_last_before() {
        let hub = Hub::default();
        let disc = Outline::Disc { radius: 0.1 };
        let disc = Tool { name: "disc".into(), shape: disc, contact: Contact::Slip };
        hub.moved(at(0, 0.5));
        assert_eq!(hub.shapes(3, 0, 1.0), [], "nobody has said what moves");
        hub.describes(Tools { stream: 3, tools: vec![disc] });
        for (sequence, x) in [(0, 0.1), (1, 0.2), (5, 0.3)] {
            hub.moved(at(sequence, x));
        }
        let seen = |stream, sequence| -> Vec<f32> {
            let shapes = hub.shapes(stream, sequence, 1.0);
            let centre = |shape: &Shape| match shape.part {
                Part::Disc { centre, .. } => centre[0],
                Part::Convex { .. } => f32::NAN,
            };
            shapes.iter().map(centre).collect()
        };
        assert_eq!([seen(3, 0), seen(3, 4), seen(3, 9)], [vec![0.1], vec![0.2], vec![0.3]]);
        assert!(seen(4, 0).is_empty());
        hub.moved(at(1, 0.4));
        assert_eq!(seen(3, 9), [0.4], "the stream has begun again");
    }

    fn at(sequence: u64, x: f32) -> ToolFrame {
        let pose = Pose { position: [x, 0.5], angle: 0.0 };
        let states = vec![ToolState { pose, velocity: [0.0; 2], spin: 0.0 }];
        ToolFrame { stream: 3, sequence, stamp: Stamp(0), states, wrenches: Vec::new() }
    }

    #[test]
    fn only_displayed_streams_are_copied_and_others_are_listed() {
        let hub = Hub::default();
        let browser = hub.join(1).unwrap();
        for stream in [4, 5] {
            hub.observed(&(&frame(stream)).into());
        }
        assert!(
            matches!(hub.next(Duration::ZERO), Some(FrameCopy::Truth(frame)) if frame.stream == 4)
        );
        assert!(hub.next(Duration::ZERO).is_none());
        assert_eq!(hub.streams(), [4, 5]);
        browser.select(Some(5));
        for stream in [4, 5] {
            hub.observed(&(&frame(stream)).into());
        }
        assert!(
            matches!(hub.next(Duration::ZERO), Some(FrameCopy::Truth(frame)) if frame.stream == 5)
        );
    }

    #[test]
    fn an_ended_stream_is_replaced_at_once_and_deselected() {
        let hub = Hub::default();
        let (follower, other) = (hub.join(3).unwrap(), hub.join(3).unwrap());
        let observe = |stream| hub.observed(&(&frame(stream)).into());
        let copied = || match hub.next(Duration::ZERO) {
            Some(FrameCopy::Truth(frame)) => Some(frame.stream),
            _ => None,
        };
        observe(4);
        other.select(Some(4));
        assert_eq!(copied(), Some(4));
        hub.ended(4);
        // Frames under way are displayed until the next stream begins.
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
    fn a_stream_has_its_name_until_another_begins_after_its_end() {
        let hub = Hub::default();
        let _browser = hub.join(1).unwrap();
        for stream in [4, 5] {
            hub.begins(stream, format!("scene {stream}"));
            hub.observed(&(&frame(stream)).into());
            assert_eq!(hub.name(stream), Some(format!("scene {stream}")));
            hub.ended(stream);
        }
        assert_eq!(hub.name(4), None);
    }

    #[test]
    fn an_unknown_stream_is_deselected() {
        let hub = Hub::default();
        let browser = hub.join(1).unwrap();
        hub.observed(&(&frame(4)).into());
        browser.select(Some(9));
        assert_eq!(hub.streams(), [4]);
        assert_eq!(browser.stream(), None);
    }

    #[test]
    fn a_slow_composer_drops_frames() {
        let hub = Hub::default();
        let _browser = hub.join(1).unwrap();
        for _ in 0..100 {
            hub.observed(&(&frame(1)).into());
        }
        assert_eq!(hub.skipped(), 100 - QUEUE_FRAMES as u64);
        assert_eq!(std::iter::from_fn(|| hub.next(Duration::ZERO)).count(), QUEUE_FRAMES);
    }

    #[test]
    fn the_number_of_browsers_is_limited() {
        let hub = Hub::default();
        let first = hub.join(1).unwrap();
        assert!(hub.join(1).is_none());
        hub.leave(&first);
        assert!(hub.join(1).is_some());
    }
}
