//! A recording: one thread per topic fills a bounded queue, this thread writes it into the bag.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use super::{
    Losses, OpenTopic, Recorder, TopicDiscovery,
    intake::{Event, FULL_QUEUE_TIMEOUT, MAX_WAIT, receive},
};
use eddy_bag::BagError;
use eddy_frames::clock::{self, Clock};
use eddy_transport::{Link, Queue, SeenTopic, TransportError};

/// When a recording ends, and where it reports to.
pub struct RecordingOptions<'a> {
    /// Links whose failure ends the recording; a failure of others is noted.
    pub required: &'a [Link],
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
    /// Called at least every 0.1 s with the number of messages written and the time since the start.
    pub on_progress: &'a dyn Fn(u64, Duration),
}

/// Why a recording ended early.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The bag cannot be written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// A required link failed.
    #[error(transparent)]
    Transport(TransportError),
}

/// Records topics until a limit, a failure or an interrupt. Returns the outcome and the losses; the caller finishes
/// `recorder` in each case.
pub fn record(
    recorder: &mut Recorder,
    inputs: Vec<OpenTopic>,
    discovery: &TopicDiscovery,
    options: &RecordingOptions<'_>,
) -> (Result<(), RecordError>, Losses) {
    let stop = AtomicBool::new(false);
    let queue = Arc::new(Queue::with_cost(usize::MAX, options.cache_bytes, Event::cost));
    thread::scope(|scope| {
        let (stop, mut receivers) = (&stop, Vec::new());
        let mut open = |recorder: &mut Recorder, opened: OpenTopic| {
            let OpenTopic { topic, support, mut subscriber } = opened;
            let id = recorder.topic_of(&topic.link.topic, &support, &topic.offered)?;
            (options.on_topic)(&topic);
            let producer = queue.producer();
            let link = topic.link;
            receivers.push(scope.spawn(move || {
                receive(&link, id, subscriber.as_mut(), &producer, FULL_QUEUE_TIMEOUT, stop)
            }));
            Ok(())
        };
        let mut opened = Ok(());
        for input in inputs {
            if opened.is_ok() {
                opened = open(recorder, input);
            }
        }
        if !discovery.is_empty() {
            let producer = queue.producer();
            scope.spawn(move || discovery.run(&producer, stop));
        }
        let outcome =
            opened.and_then(|()| write(recorder, &queue, &mut open, discovery, options, stop));
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

/// Starts to record a topic.
type Open<'a> = dyn FnMut(&mut Recorder, OpenTopic) -> Result<(), RecordError> + 'a;

/// Writes events until the recording ends, raises `stop`, then writes the messages that had already arrived.
fn write(
    recorder: &mut Recorder,
    queue: &Queue<Event>,
    open: &mut Open<'_>,
    discovery: &TopicDiscovery,
    options: &RecordingOptions<'_>,
    stop: &AtomicBool,
) -> Result<(), RecordError> {
    let clock = Clock::start();
    let limit = options.max_messages.unwrap_or(u64::MAX);
    let mut failure = None;
    loop {
        let timed_out = options.stop_after.is_some_and(|limit| clock.now() >= limit);
        let interrupted = options.interrupted.load(Ordering::Relaxed);
        if timed_out || interrupted || failure.is_some() {
            stop.store(true, Ordering::Relaxed);
        }
        match queue.pop(MAX_WAIT) {
            Some(Event::Message(topic, payload, arrived)) => {
                recorder.on_message(topic, payload, arrived).map_err(RecordError::Bag)?;
            }
            Some(Event::Opened(opened)) => {
                let link = opened.topic.link.clone();
                match open(recorder, *opened) {
                    Err(RecordError::Bag(error @ BagError::TopicType { .. })) => {
                        discovery.note_failed(&link, &error);
                    }
                    opened => opened?,
                }
            }
            // Topics of `--all` and `--regex` are recorded as far as possible.
            Some(Event::Failed(link, error)) if !options.required.contains(&link) => {
                discovery.note_ended(&link, &error);
            }
            Some(Event::Failed(_, error)) => failure = Some(RecordError::Transport(error)),
            None if queue.is_ended() => break,
            None => {}
        }
        recorder.on_tick(clock::wall()).map_err(RecordError::Bag)?;
        let messages = recorder.bag().messages();
        (options.on_progress)(messages, clock.now());
        if messages >= limit {
            break;
        }
    }
    failure.map_or(Ok(()), Err)
}

#[cfg(test)]
mod tests {
    use std::{collections::HashSet, path::Path};

    use super::*;
    use crate::recorder::TopicOpener;
    use eddy_bag::{BagReader, BagWriter, QosOverrides, TopicFilter, WriterOptions};
    use eddy_messages::{Message, RosString, cdr, topic_type};
    use eddy_transport::{
        Payload, Publisher, Reliability, Subscriber, TransportKind, TransportOptions, Transports,
    };

    const LONG: Duration = Duration::from_secs(60);

    /// A topic within this process and its publisher.
    struct Words {
        transports: Transports,
        topic: SeenTopic,
        publisher: Box<dyn Publisher>,
    }

    impl Words {
        fn new() -> Self {
            let transports = Transports::new(TransportOptions::new("record"));
            let link = Link { transport: TransportKind::Memory, topic: "/words".to_owned() };
            let publisher = transports.publisher(&link, RosString::TYPE, Reliability::Block);
            let publisher = publisher.unwrap();
            let type_name = RosString::TYPE.to_owned();
            let topic = SeenTopic::new(link, type_name);
            Self { transports, topic, publisher }
        }

        fn opener(&self) -> TopicOpener {
            TopicOpener::new(self.transports.clone(), Vec::new(), QosOverrides::new())
        }

        fn input(&self) -> OpenTopic {
            self.opener().open(self.topic.clone()).unwrap()
        }

        fn publish(&mut self, count: usize) {
            for _ in 0..count {
                let word = cdr::encode(&RosString { data: "eddy".into() });
                self.publisher.publish_cdr(&word).unwrap();
            }
        }

        /// Records into a bag; returns the number of its messages.
        fn record(
            &self,
            bag: &Path,
            inputs: Vec<OpenTopic>,
            options: &RecordingOptions<'_>,
        ) -> (u64, Result<(), RecordError>, Losses) {
            let none = (Vec::new(), TopicFilter::default(), HashSet::new());
            let discovery = TopicDiscovery::new(self.opener(), none.0, none.1, none.2);
            let writer = BagWriter::create(bag, WriterOptions::default()).unwrap();
            let mut recorder = Recorder::new(writer, clock::wall());
            let (outcome, losses) = record(&mut recorder, inputs, &discovery, options);
            (recorder.finish().unwrap().messages, outcome, losses)
        }
    }

    fn options<'a>(interrupted: &'a AtomicBool, required: &'a [Link]) -> RecordingOptions<'a> {
        RecordingOptions {
            required,
            cache_bytes: 1 << 20,
            max_messages: None,
            stop_after: Some(LONG),
            interrupted,
            on_topic: &|_| (),
            on_progress: &|_, _| (),
        }
    }

    #[test]
    fn an_interrupt_ends_a_recording_after_everything_that_has_arrived() {
        let folder = tempfile::tempdir().unwrap();
        let (mut words, interrupted) = (Words::new(), AtomicBool::new(false));
        let input = words.input();
        words.publish(5);
        interrupted.store(true, Ordering::Relaxed);
        let bag = folder.path().join("bag");
        let (messages, outcome, losses) =
            words.record(&bag, vec![input], &options(&interrupted, &[]));
        outcome.unwrap();
        assert_eq!((messages, losses.total()), (5, 0));
        assert_eq!(BagReader::open(&bag).unwrap().message_count(), 5);
    }

    #[test]
    fn limits_end_a_recording() {
        let folder = tempfile::tempdir().unwrap();
        let (mut words, interrupted) = (Words::new(), AtomicBool::new(false));
        let input = words.input();
        words.publish(5);
        let usual = options(&interrupted, &[]);
        let few = RecordingOptions { max_messages: Some(3), ..usual };
        let (messages, outcome, losses) =
            words.record(&folder.path().join("few"), vec![input], &few);
        outcome.unwrap();
        // Messages after the last one to record are not lost.
        assert_eq!((messages, losses.unwritten), (3, 0));
        let short =
            RecordingOptions { stop_after: Some(Duration::ZERO), ..options(&interrupted, &[]) };
        let input = words.input();
        let (messages, outcome, _) =
            words.record(&folder.path().join("short"), vec![input], &short);
        outcome.unwrap();
        assert_eq!(messages, 0);
    }

    /// Fails at the first call.
    struct Broken(Link);

    impl Subscriber for Broken {
        fn receive(&mut self, _: Duration) -> Result<Option<Payload>, TransportError> {
            let (found, expected) = ("a".to_owned(), topic_type(&self.0.topic).to_owned());
            Err(TransportError::TopicType { link: self.0.clone(), found, expected })
        }

        fn lost(&self) -> u64 {
            0
        }
    }

    #[test]
    fn a_required_link_that_fails_ends_the_recording_and_another_one_does_not() {
        let folder = tempfile::tempdir().unwrap();
        let (mut words, interrupted) = (Words::new(), AtomicBool::new(false));
        let broken = Link { transport: TransportKind::Memory, topic: "/broken".to_owned() };
        let required = [broken.clone()];
        let inputs = |words: &Words| {
            let topic = SeenTopic { link: broken.clone(), ..words.topic.clone() };
            let (support, subscriber) = (topic.type_support(), Box::new(Broken(broken.clone())));
            vec![OpenTopic { topic, support, subscriber }, words.input()]
        };
        let all = inputs(&words);
        let (_, outcome, _) =
            words.record(&folder.path().join("required"), all, &options(&interrupted, &required));
        assert!(matches!(outcome, Err(RecordError::Transport(_))), "{outcome:?}");

        let all = inputs(&words);
        words.publish(2);
        let two = RecordingOptions { max_messages: Some(2), ..options(&interrupted, &[]) };
        let (messages, outcome, _) = words.record(&folder.path().join("other"), all, &two);
        outcome.unwrap();
        assert_eq!(messages, 2);
    }
}
