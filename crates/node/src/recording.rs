//! A recording: topics that are subscribed to, a queue of bounded size, and the loop that writes into the bag.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use super::{
    cache::{Cache, Taken},
    discovery::TopicSearch,
    intake::{Losses, ROOM_PATIENCE, Received, receive},
    recorder::Recorder,
};
use eddy_bag::BagError;
use eddy_frames::clock::{self, Clock};
use eddy_transport::{Link, SeenTopic, Subscriber, TransportError};

/// How long a wait may last before the end of the recording is looked for.
pub(super) const PATIENCE: Duration = Duration::from_millis(100);

/// When a recording ends, and the callbacks it reports to.
pub struct RecordingTerms<'a> {
    /// Links that must not fail: the recording ends when one does. Others are recorded as long as they can be.
    pub required: &'a [Link],
    /// Memory for messages that wait to be written (bytes).
    pub cache_bytes: usize,
    /// Ends after so many messages.
    pub max_messages: Option<u64>,
    /// Ends after such a time.
    pub stop_after: Option<Duration>,
    /// Ends when this is raised.
    pub interrupted: &'a AtomicBool,
    /// Told about each topic that is recorded from now on.
    pub on_topic: &'a dyn Fn(&SeenTopic),
    /// Told at least every 0.1 s how many messages were written, and since when.
    pub on_progress: &'a dyn Fn(u64, Duration),
}

/// Why a recording ended that should have gone on.
#[derive(Debug, thiserror::Error)]
pub enum RecordError {
    /// The bag cannot be written.
    #[error(transparent)]
    Bag(#[from] BagError),
    /// A required link failed.
    #[error(transparent)]
    Transport(TransportError),
}

/// Records topics until a limit, a failure or an interrupt: subscribers bring what they receive to a queue of
/// bounded size, this thread writes it. Returns the outcome, and what is not in the bag; `recorder` is to be finished
/// in each case.
pub fn record(
    recorder: &mut Recorder,
    inputs: Vec<(SeenTopic, Box<dyn Subscriber>)>,
    search: &TopicSearch,
    terms: &RecordingTerms<'_>,
) -> (Result<(), RecordError>, Losses) {
    let stop = AtomicBool::new(false);
    let cache = Cache::new(terms.cache_bytes);
    thread::scope(|scope| {
        let (stop, mut receivers) = (&stop, Vec::new());
        let mut open =
            |recorder: &mut Recorder, topic: SeenTopic, mut subscriber: Box<dyn Subscriber>| {
                let id = recorder.topic_of(&topic.link.topic, &topic.type_support(), topic.kept)?;
                (terms.on_topic)(&topic);
                let producer = cache.producer();
                let link = topic.link;
                receivers.push(scope.spawn(move || {
                    receive(&link, id, subscriber.as_mut(), &producer, ROOM_PATIENCE, stop)
                }));
                Ok(())
            };
        let mut begun = Ok(());
        for (topic, subscriber) in inputs {
            if begun.is_ok() {
                begun = open(recorder, topic, subscriber);
            }
        }
        if !search.is_empty() {
            let producer = cache.producer();
            scope.spawn(move || search.run(&producer, stop));
        }
        let outcome = begun.and_then(|()| write(recorder, &cache, &mut open, search, terms, stop));
        stop.store(true, Ordering::Relaxed);
        let waited = cache.close().into_iter();
        let waited = waited.filter(|item| matches!(item, Received::Message(..))).count() as u64;
        let losses = receivers.into_iter().map(|receiver| match receiver.join() {
            Ok(losses) => losses,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        let mut losses: Losses = losses.sum();
        losses.unwritten += waited;
        if outcome.is_ok() {
            // What came after the last message that was wanted is no loss.
            losses.unwritten = 0;
        }
        (outcome, losses)
    })
}

/// Begins to record a topic.
type Open<'a> =
    dyn FnMut(&mut Recorder, SeenTopic, Box<dyn Subscriber>) -> Result<(), RecordError> + 'a;

/// The writing loop. Raises `stop` when the recording is to end, then writes what has arrived.
fn write(
    recorder: &mut Recorder,
    cache: &Cache<Received>,
    open: &mut Open<'_>,
    search: &TopicSearch,
    terms: &RecordingTerms<'_>,
    stop: &AtomicBool,
) -> Result<(), RecordError> {
    let clock = Clock::start();
    let limit = terms.max_messages.unwrap_or(u64::MAX);
    let mut failure = None;
    loop {
        let timed_out = terms.stop_after.is_some_and(|limit| clock.now() >= limit);
        let interrupted = terms.interrupted.load(Ordering::Relaxed);
        if timed_out || interrupted || failure.is_some() {
            stop.store(true, Ordering::Relaxed);
        }
        match cache.take(PATIENCE) {
            Taken::Item(Received::Message(topic, payload, arrived)) => {
                recorder.on_message(topic, payload, arrived).map_err(RecordError::Bag)?;
            }
            Taken::Item(Received::Opened(topic, subscriber)) => {
                let link = topic.link.clone();
                match open(recorder, topic, subscriber) {
                    Err(RecordError::Bag(error @ BagError::TopicType { .. })) => {
                        search.fails(&link, &error);
                    }
                    opened => opened?,
                }
            }
            // A topic named by its link is required; of `--all` topics, those that can be opened.
            Taken::Item(Received::Failed(link, error)) if !terms.required.contains(&link) => {
                search.ends(&link, &error);
            }
            Taken::Item(Received::Failed(_, error)) => {
                failure = Some(RecordError::Transport(error))
            }
            Taken::Nothing => {}
            Taken::Ended => break,
        }
        recorder.on_tick(clock::wall()).map_err(RecordError::Bag)?;
        let messages = recorder.bag().messages();
        (terms.on_progress)(messages, clock.now());
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
    use eddy_bag::{BagReader, BagWriter, TopicFilter, WriterOptions};
    use eddy_messages::{Message, RosString, cdr, topic_type};
    use eddy_transport::{
        Payload, Publisher, Reliability, TransportKind, TransportOptions, Transports,
    };

    const LONG: Duration = Duration::from_secs(60);

    /// A topic in this process, and what is published on it.
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
            let topic = SeenTopic { link, type_name, hash: None, kept: 0 };
            Self { transports, topic, publisher }
        }

        fn input(&self) -> (SeenTopic, Box<dyn Subscriber>) {
            let topic = self.topic.clone();
            let subscriber = self.transports.subscriber_of(&topic.link, &topic.type_support());
            (topic, subscriber.unwrap())
        }

        fn publish(&mut self, count: usize) {
            for _ in 0..count {
                let word = cdr::encode(&RosString { data: "eddy".into() });
                self.publisher.publish_cdr(&word).unwrap();
            }
        }

        /// Records what is published into a bag; returns how many messages it has.
        fn record(
            &self,
            bag: &Path,
            inputs: Vec<(SeenTopic, Box<dyn Subscriber>)>,
            terms: &RecordingTerms<'_>,
        ) -> (u64, Result<(), RecordError>, Losses) {
            let none = (Vec::new(), TopicFilter::default(), HashSet::new());
            let search = TopicSearch::new(self.transports.clone(), none.0, none.1, none.2);
            let writer = BagWriter::create(bag, WriterOptions::default()).unwrap();
            let mut recorder = Recorder::new(writer, clock::wall());
            let (outcome, losses) = record(&mut recorder, inputs, &search, terms);
            (recorder.finish().unwrap().messages, outcome, losses)
        }
    }

    fn terms<'a>(interrupted: &'a AtomicBool, required: &'a [Link]) -> RecordingTerms<'a> {
        RecordingTerms {
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
    fn an_interrupt_ends_a_recording_with_everything_that_has_arrived() {
        let folder = tempfile::tempdir().unwrap();
        let (mut words, interrupted) = (Words::new(), AtomicBool::new(false));
        let input = words.input();
        words.publish(5);
        interrupted.store(true, Ordering::Relaxed);
        let bag = folder.path().join("bag");
        let (messages, outcome, losses) =
            words.record(&bag, vec![input], &terms(&interrupted, &[]));
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
        let usual = terms(&interrupted, &[]);
        let few = RecordingTerms { max_messages: Some(3), ..usual };
        let (messages, outcome, losses) =
            words.record(&folder.path().join("few"), vec![input], &few);
        outcome.unwrap();
        // What came after the last message that was wanted is no loss.
        assert_eq!((messages, losses.unwritten), (3, 0));
        let short = RecordingTerms { stop_after: Some(Duration::ZERO), ..terms(&interrupted, &[]) };
        let input = words.input();
        let (messages, outcome, _) =
            words.record(&folder.path().join("short"), vec![input], &short);
        outcome.unwrap();
        assert_eq!(messages, 0);
    }

    /// Fails at once.
    struct Broken(Link);

    impl Subscriber for Broken {
        fn receive(&mut self, _: Duration) -> Result<Option<Payload>, TransportError> {
            let (found, expected) = ("a".to_owned(), topic_type(&self.0.topic).to_owned());
            Err(TransportError::TopicType { link: self.0.clone(), found, expected })
        }

        fn refused(&self) -> u64 {
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
            let broken: Box<dyn Subscriber> = Box::new(Broken(broken.clone()));
            vec![(topic, broken), words.input()]
        };
        let all = inputs(&words);
        let (_, outcome, _) =
            words.record(&folder.path().join("required"), all, &terms(&interrupted, &required));
        assert!(matches!(outcome, Err(RecordError::Transport(_))), "{outcome:?}");

        let all = inputs(&words);
        words.publish(2);
        let two = RecordingTerms { max_messages: Some(2), ..terms(&interrupted, &[]) };
        let (messages, outcome, _) = words.record(&folder.path().join("other"), all, &two);
        outcome.unwrap();
        assert_eq!(messages, 2);
    }
}
