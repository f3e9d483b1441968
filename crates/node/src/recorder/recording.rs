//! A recording: one thread per topic fills a bounded queue, this thread writes it into the bag.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread,
    time::Duration,
};

use super::{
    Losses, OpenTopic, Recorder, TopicDiscovery,
    intake::{Event, FULL_QUEUE_TIMEOUT, MAX_WAIT, Shared, receive},
};
use eddy_bag::{BagError, TopicId};
use eddy_frames::clock::{self, Clock};
use eddy_transport::{Link, Producer, Queue, SeenTopic, TransportError};

/// Delay before the links are named that are not published yet: time for the transports to find their topics.
const WAITING_DELAY: Duration = Duration::from_secs(1);

/// When a recording ends, and where it reports to.
pub struct RecordingOptions<'a> {
    /// Capacity of the queue of messages to write (bytes).
    pub cache_bytes: usize,
    /// Ends after this number of messages.
    pub max_messages: Option<u64>,
    /// Ends after this time.
    pub stop_after: Option<Duration>,
    /// Ends when this is raised.
    pub interrupted: &'a AtomicBool,
    /// Called for each topic when its recording starts.
    pub on_topic: &'a dyn Fn(&SeenTopic),
    /// Called once with the links that are waited for, if there are any after a second.
    pub on_waiting: &'a dyn Fn(&[Link]),
    /// Called at least every 0.1 s with the number of messages written and the time since the start.
    pub on_progress: &'a dyn Fn(u64, Duration),
}

/// Why a recording ended early.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The bag cannot be written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// The last link that was recorded failed.
    #[error(transparent)]
    Transport(TransportError),
}

/// Records topics until a limit, a failure or an interrupt. A topic that fails does not end it, unless nothing is left to
/// record. Returns the outcome and the losses; the caller finishes `recorder` in each case.
pub fn record(
    recorder: &mut Recorder,
    discovery: &TopicDiscovery,
    options: &RecordingOptions<'_>,
) -> (Result<(), RecordError>, Losses) {
    let search = |producer: &Producer<Event>, stop: &AtomicBool| discovery.run(producer, stop);
    record_found(recorder, discovery, search, options)
}

/// As [`record`]; `search` opens the topics.
fn record_found(
    recorder: &mut Recorder,
    discovery: &TopicDiscovery,
    search: impl FnOnce(&Producer<Event>, &AtomicBool) + Send,
    options: &RecordingOptions<'_>,
) -> (Result<(), RecordError>, Losses) {
    let stop = AtomicBool::new(false);
    let queue = Arc::new(Queue::with_cost(usize::MAX, options.cache_bytes, Event::cost));
    let shared = Shared {
        timeout: FULL_QUEUE_TIMEOUT,
        cache_bytes: options.cache_bytes,
        held: AtomicUsize::new(0),
        stop: &stop,
    };
    thread::scope(|scope| {
        let (stop, shared, mut receivers) = (&stop, &shared, Vec::new());
        let mut receive_from = |number: usize, OpenTopic { topic, mut subscriber }| {
            let producer = queue.producer();
            receivers.push(scope.spawn(move || {
                let type_of = || discovery.opener().type_of(&topic, stop);
                receive(number, &topic.link, subscriber.as_mut(), type_of, &producer, shared)
            }));
        };
        let producer = queue.producer();
        scope.spawn(move || search(&producer, stop));
        let outcome = write(recorder, &queue, &mut receive_from, discovery, options, stop);
        stop.store(true, Ordering::Relaxed);
        let queued = queue.close().into_iter();
        let queued = queued.filter(|event| matches!(event, Event::Message(..))).count() as u64;
        let losses = receivers.into_iter().map(|receiver| match receiver.join() {
            Ok(losses) => losses,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        let mut losses: Losses = losses.sum();
        losses.unwritten += queued;
        if outcome.is_ok() {
            // Messages after the last one to record are not lost.
            losses.unwritten = 0;
        }
        (outcome, losses)
    })
}

/// Starts to receive the messages of a topic with this number.
type ReceiveFrom<'a> = dyn FnMut(usize, OpenTopic) + 'a;

/// Writes events until the recording ends, raises `stop`, then writes the messages that had already arrived.
fn write(
    recorder: &mut Recorder,
    queue: &Queue<Event>,
    receive_from: &mut ReceiveFrom<'_>,
    discovery: &TopicDiscovery,
    options: &RecordingOptions<'_>,
    stop: &AtomicBool,
) -> Result<(), RecordError> {
    let clock = Clock::start();
    let limit = options.max_messages.unwrap_or(u64::MAX);
    // Topics by number; without an id until their type is known.
    let mut topics: Vec<(SeenTopic, Option<TopicId>)> = Vec::new();
    let (mut failure, mut has_told_waiting) = (None, false);
    loop {
        let timed_out = options.stop_after.is_some_and(|limit| clock.now() >= limit);
        let interrupted = options.interrupted.load(Ordering::Relaxed);
        if timed_out || interrupted || failure.is_some() {
            stop.store(true, Ordering::Relaxed);
        }
        match queue.pop(MAX_WAIT) {
            Some(Event::Message(number, payload, arrived)) => {
                // Without an id, the topic was noted as failed.
                if let Some(id) = topics[number].1 {
                    recorder.on_message(id, payload, arrived)?;
                }
            }
            Some(Event::Opened(opened)) => {
                (options.on_topic)(&opened.topic);
                topics.push((opened.topic.clone(), None));
                receive_from(topics.len() - 1, *opened);
            }
            Some(Event::Typed(number, support)) => {
                let (SeenTopic { link, offered, .. }, id) = &mut topics[number];
                match recorder.topic_of(&link.topic, &support, offered) {
                    Ok(known) => *id = Some(known),
                    Err(error @ BagError::TopicType { .. }) => discovery.note_failed(link, &error),
                    Err(error) => return Err(error.into()),
                }
            }
            Some(Event::Failed(link, error)) => {
                let ends_recording = discovery.note_ended(&link, &error);
                if ends_recording {
                    failure = Some(RecordError::Transport(error));
                }
            }
            None if queue.is_ended() => break,
            None => {}
        }
        recorder.on_tick(clock::wall())?;
        let messages = recorder.bag().messages();
        (options.on_progress)(messages, clock.now());
        if !has_told_waiting && clock.now() >= WAITING_DELAY {
            has_told_waiting = true;
            (options.on_waiting)(&discovery.unpublished());
        }
        if messages >= limit {
            break;
        }
    }
    failure.map_or(Ok(()), Err)
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::recorder::TopicOpener;
    use eddy_bag::{BagReader, BagWriter, QosOverrides, TopicFilter, WriterOptions};
    use eddy_messages::{Message, RosString, TypeSupport, cdr};
    use eddy_transport::{
        Payload, Publisher, Reliability, Subscriber, TransportOptions, Transports,
    };

    const LONG: Duration = Duration::from_secs(60);
    const INT32: &str = "std_msgs/msg/Int32";

    fn word() -> Vec<u8> {
        cdr::encode(&RosString { data: "eddy".into() })
    }

    /// Topics within this process.
    struct World {
        transports: Transports,
        interrupted: AtomicBool,
        folder: tempfile::TempDir,
    }

    /// What a recording has left.
    struct Recorded {
        outcome: Result<(), RecordError>,
        losses: Losses,
        /// Names and types of the topics, and their messages.
        topics: Vec<(String, String, u64)>,
        not_recorded: Vec<String>,
        ended: Vec<String>,
    }

    impl World {
        fn new() -> Self {
            let transports = Transports::new(TransportOptions::new("record"));
            let folder = tempfile::tempdir().unwrap();
            Self { transports, interrupted: AtomicBool::new(false), folder }
        }

        fn publisher(&self, topic: &str, type_name: &str) -> Box<dyn Publisher> {
            let link = Link::memory(topic);
            self.transports.publisher(&link, type_name, Reliability::Block).unwrap()
        }

        fn discovery(&self, links: &[&str], choice: TopicFilter) -> TopicDiscovery {
            let opener = TopicOpener::new(self.transports.clone(), Vec::new(), QosOverrides::new());
            let links: Vec<_> = links.iter().map(|topic| Link::memory(topic)).collect();
            let from = vec![Link::memory("/").transport];
            TopicDiscovery::new(opener, links, from, choice)
        }

        fn options(&self) -> RecordingOptions<'_> {
            RecordingOptions {
                cache_bytes: 1 << 20,
                max_messages: None,
                stop_after: Some(LONG),
                interrupted: &self.interrupted,
                on_topic: &|_| (),
                on_waiting: &|_| (),
                on_progress: &|_, _| (),
            }
        }

        /// Records while `meanwhile` runs; interrupted at its end.
        fn record(
            &self,
            discovery: &TopicDiscovery,
            options: &RecordingOptions<'_>,
            meanwhile: impl FnOnce() + Send,
        ) -> Recorded {
            let search = |producer: &Producer<Event>, stop: &AtomicBool| {
                discovery.run(producer, stop);
            };
            self.record_found(discovery, search, options, meanwhile)
        }

        fn record_found(
            &self,
            discovery: &TopicDiscovery,
            search: impl FnOnce(&Producer<Event>, &AtomicBool) + Send,
            options: &RecordingOptions<'_>,
            meanwhile: impl FnOnce() + Send,
        ) -> Recorded {
            let path = self.folder.path().join("bag");
            let writer = BagWriter::create(&path, WriterOptions::default()).unwrap();
            let mut recorder = Recorder::new(writer, clock::wall());
            let (outcome, losses) = thread::scope(|scope| {
                scope.spawn(|| {
                    meanwhile();
                    self.interrupted.store(true, Ordering::Relaxed);
                });
                record_found(&mut recorder, discovery, search, options)
            });
            recorder.finish().unwrap();
            let reasons = |reasons: crate::recorder::Reasons| {
                reasons.into_iter().map(|(link, reason)| format!("{link}: {reason}")).collect()
            };
            let (not_recorded, ended) = (discovery.not_recorded(), discovery.ended());
            let (not_recorded, ended) = (reasons(not_recorded), reasons(ended));
            Recorded { outcome, losses, topics: topics(&path), not_recorded, ended }
        }
    }

    fn topics(bag: &Path) -> Vec<(String, String, u64)> {
        let bag = BagReader::open(bag).unwrap();
        let topics = bag.topics().iter();
        topics.map(|t| (t.name.clone(), t.type_name.clone(), t.message_count)).collect()
    }

    fn of(topic: &str, type_name: &str, messages: u64) -> (String, String, u64) {
        (topic.to_owned(), type_name.to_owned(), messages)
    }

    /// Publishes words once somebody listens.
    fn publish(publisher: &mut dyn Publisher, count: usize) {
        let clock = Clock::start();
        while publisher.subscribers() == 0 {
            assert!(clock.now() < LONG, "nobody listens");
            thread::sleep(Duration::from_millis(1));
        }
        for _ in 0..count {
            publisher.publish_cdr(&word()).unwrap();
        }
    }

    fn everything() -> TopicFilter {
        TopicFilter { all: true, ..TopicFilter::default() }
    }

    #[test]
    fn a_recorder_that_is_first_waits_for_the_publisher_and_has_its_type() {
        let world = World::new();
        // Its name promises nothing.
        let discovery = world.discovery(&["/robot_description"], TopicFilter::default());
        let recorded = world.record(&discovery, &world.options(), || {
            let clock = Clock::start();
            while clock.now() < Duration::from_millis(300) {
                assert_eq!(discovery.unpublished(), [Link::memory("/robot_description")]);
                thread::sleep(Duration::from_millis(10));
            }
            publish(&mut *world.publisher("/robot_description", RosString::TYPE), 5);
        });
        recorded.outcome.unwrap();
        assert_eq!(recorded.topics, [of("/robot_description", RosString::TYPE, 5)]);
        assert_eq!((recorded.losses.total(), recorded.not_recorded.len()), (0, 0));
    }

    #[test]
    fn links_that_nobody_publishes_are_told_once_and_not_in_the_bag() {
        let world = World::new();
        let _other = world.publisher("/words", RosString::TYPE);
        let discovery = world.discovery(&["/words", "/nothing"], TopicFilter::default());
        let told = std::sync::Mutex::new(Vec::new());
        let options = RecordingOptions {
            on_waiting: &|links| told.lock().unwrap().push(links.to_vec()),
            ..world.options()
        };
        let recorded = world.record(&discovery, &options, || {
            let clock = Clock::start();
            while told.lock().unwrap().is_empty() {
                assert!(clock.now() < LONG, "no line was sent");
                thread::sleep(Duration::from_millis(1));
            }
        });
        recorded.outcome.unwrap();
        assert_eq!(*told.lock().unwrap(), [[Link::memory("/nothing")]]);
        assert_eq!(recorded.topics, [of("/words", RosString::TYPE, 0)]);
        assert_eq!(recorded.not_recorded, ["memory:/nothing: not published"]);
    }

    #[test]
    fn an_interrupt_ends_a_recording_after_everything_that_has_arrived() {
        let world = World::new();
        let discovery = world.discovery(&[], everything());
        let mut publisher = world.publisher("/words", RosString::TYPE);
        let recorded =
            world.record(&discovery, &world.options(), || publish(publisher.as_mut(), 50));
        recorded.outcome.unwrap();
        assert_eq!(recorded.topics, [of("/words", RosString::TYPE, 50)]);
        assert_eq!(recorded.losses.total(), 0);
    }

    #[test]
    fn limits_end_a_recording() {
        let world = World::new();
        let discovery = world.discovery(&["/words"], TopicFilter::default());
        let mut publisher = world.publisher("/words", RosString::TYPE);
        let few = RecordingOptions { max_messages: Some(3), ..world.options() };
        let recorded = world.record(&discovery, &few, || publish(publisher.as_mut(), 5));
        recorded.outcome.unwrap();
        // Messages after the last one to record are not lost.
        assert_eq!((recorded.topics[0].2, recorded.losses.unwritten), (3, 0));

        let world = World::new();
        let discovery = world.discovery(&["/words"], TopicFilter::default());
        let short = RecordingOptions { stop_after: Some(Duration::ZERO), ..world.options() };
        let recorded = world.record(&discovery, &short, || ());
        recorded.outcome.unwrap();
        assert_eq!(recorded.topics, []);
    }

    /// Fails at the first call.
    struct Broken(Link);

    impl Subscriber for Broken {
        fn receive(&mut self, _: Duration) -> Result<Option<Payload>, TransportError> {
            let (found, expected) = (INT32.to_owned(), RosString::TYPE.to_owned());
            Err(TransportError::TopicType { link: self.0.clone(), found, expected })
        }

        fn lost(&self) -> u64 {
            0
        }
    }

    #[test]
    fn a_link_that_fails_ends_the_recording_only_if_nothing_is_left() {
        for (links, is_over) in [(vec!["/broken"], true), (vec!["/broken", "/words"], false)] {
            let world = World::new();
            let mut publisher = world.publisher("/words", RosString::TYPE);
            let discovery = world.discovery(&links, TopicFilter::default());
            let search = |producer: &Producer<Event>, stop: &AtomicBool| {
                let link = Link::memory("/broken");
                let subscriber = Box::new(Broken(link.clone()));
                let topic = SeenTopic::new(link, RosString::TYPE.to_owned());
                let opened = Event::Opened(Box::new(OpenTopic { topic, subscriber }));
                assert!(producer.push_or_wait(opened, LONG).is_ok());
                discovery.run(producer, stop);
            };
            let recorded = world.record_found(&discovery, search, &world.options(), || {
                if !is_over {
                    publish(publisher.as_mut(), 2);
                }
            });
            assert_eq!(recorded.ended.len(), 1, "{:?}", recorded.ended);
            assert_eq!(recorded.outcome.is_err(), is_over, "{:?}", recorded.outcome);
            let words = recorded.topics.iter().filter(|(name, ..)| name == "/words");
            assert_eq!(
                words.map(|(_, _, messages)| messages).sum::<u64>(),
                if is_over { 0 } else { 2 }
            );
        }
    }

    #[test]
    fn another_type_of_a_recorded_topic_is_named() {
        let world = World::new();
        let discovery = world.discovery(&[], everything());
        let link = Link::memory("/words");
        let seen = |type_name: &str, hash: Option<&str>| SeenTopic {
            hash: hash.map(str::to_owned),
            ..SeenTopic::new(link.clone(), type_name.to_owned())
        };
        let known = TypeSupport::foreign(RosString::TYPE, "RIHS01_1");
        assert!(discovery.reserve(&seen(&known.name, Some(&known.hash))));
        // The same, as far as it is announced.
        assert!(!discovery.reserve(&seen(&known.name, Some(&known.hash))));
        assert!(!discovery.reserve(&seen(&known.name, None)));
        assert_eq!(discovery.not_recorded().len(), 0);
        assert!(!discovery.reserve(&seen(&known.name, Some("RIHS01_2"))));
        assert!(!discovery.reserve(&seen(INT32, None)));
        let reasons = discovery.not_recorded();
        let expected =
            "found message type std_msgs/msg/Int32, recorded is std_msgs/msg/String (RIHS01_1)";
        assert_eq!(reasons["memory:/words(std_msgs/msg/Int32)"], expected);
        assert_eq!(reasons.len(), 2, "{reasons:?}");
    }
}
