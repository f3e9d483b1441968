//! A publisher for every planned topic of a bag, and one for the clock.

use std::{collections::HashMap, sync::Arc};

use super::{OutputOptions, PlannedTopic, PlaybackPlan};
use eddy_bag::BagMessage;
use eddy_frames::{Stamp, counted};
use eddy_messages::{Clock, Message, cdr};
use eddy_transport::{Link, Publisher, PublisherOptions, Reliability, TransportError, Transports};

/// The publisher of one topic of the bag.
pub struct PlayedTopic {
    /// What it publishes.
    pub planned: PlannedTopic,
    /// Its publisher.
    pub publisher: Box<dyn Publisher>,
    /// Whether a subscriber that reads nothing was logged.
    has_stalled: bool,
    /// Messages that could not be published.
    left_out: u64,
    /// Why the first of them could not.
    reason: String,
}

impl PlayedTopic {
    fn leave_out(&mut self, error: &TransportError) {
        if self.left_out == 0 {
            let name = self.planned.name.escape_debug();
            tracing::warn!("topic {name}: a message is not published: {error}");
            self.reason = error.to_string();
        }
        self.left_out += 1;
    }
}

/// The publishers of a player.
pub struct TopicOutputs {
    topics: Vec<PlayedTopic>,
    /// By the address of the channel that messages share, which [`PlannedTopic::channels`] keeps.
    by_channel: HashMap<usize, usize>,
    clock: Option<(Link, Box<dyn Publisher>)>,
    /// Why topics are left out, once for each.
    topics_left_out: Vec<String>,
    /// Messages published.
    pub sent: u64,
    /// Messages that were not delivered to all subscribers.
    pub undelivered: u64,
}

impl TopicOutputs {
    /// Opens a publisher for each planned topic; those that cannot be opened are left out, unless they were named.
    ///
    /// # Errors
    /// [`TransportError`] when the transport, a named topic or the clock cannot be opened.
    pub fn open(
        transports: &Transports,
        options: &OutputOptions,
        mut plan: PlaybackPlan,
    ) -> Result<Self, TransportError> {
        // A transport that does not work is one error, not one for each topic.
        transports.services(options.transport)?;
        let types = plan.topics.iter().map(|topic| topic.support.name.as_str());
        let types: Vec<_> = types.chain(plan.clock.as_ref().map(|_| Clock::TYPE)).collect();
        transports.reserve(options.transport, &types, &[])?;
        let (mut topics, mut by_channel) = (Vec::new(), HashMap::new());
        for planned in std::mem::take(&mut plan.topics) {
            let PlannedTopic { name, link, support, offered, .. } = &planned;
            let opened = transports.publisher(
                link,
                support,
                PublisherOptions { reliability: options.reliability, qos: *offered },
            );
            let publisher = match opened {
                Ok(publisher) => publisher,
                Err(error) if options.topics.contains(name) => return Err(error),
                Err(error) => {
                    plan.leave_out(format!("topic {}: {error}", name.escape_debug()));
                    continue;
                }
            };
            for channel in &planned.channels {
                by_channel.insert(Arc::as_ptr(channel).addr(), topics.len());
            }
            let (has_stalled, left_out, reason) = (false, 0, String::new());
            topics.push(PlayedTopic { planned, publisher, has_stalled, left_out, reason });
        }
        let mut clock = None;
        if let Some(link) = plan.clock {
            // Subscribers of the clock need the latest time, not every one.
            let publisher = transports.publisher(&link, Clock::TYPE, Reliability::Drop)?;
            clock = Some((link, publisher));
        }
        let topics_left_out = plan.left_out;
        Ok(Self { topics, by_channel, clock, topics_left_out, sent: 0, undelivered: 0 })
    }

    /// The topics, in the order of the bag.
    pub fn topics(&self) -> &[PlayedTopic] {
        &self.topics
    }

    /// Where the recorded time is published, if it is.
    pub fn clock(&self) -> Option<&Link> {
        self.clock.as_ref().map(|(link, _)| link)
    }

    /// What was not published, and why: a line for each topic.
    pub fn left_out(&self) -> Vec<String> {
        let topics = self.topics.iter().filter(|topic| topic.left_out > 0);
        let messages = topics.map(|PlayedTopic { planned, left_out, reason, .. }| {
            let messages = counted(*left_out, "message");
            format!("topic {}: {messages}: {reason}", planned.name.escape_debug())
        });
        self.topics_left_out.iter().cloned().chain(messages).collect()
    }

    /// Publishes a message of the bag. One that cannot be published is counted, and named if it is the first of its topic.
    pub fn publish(&mut self, message: &BagMessage) {
        let channel = Arc::as_ptr(&message.channel).addr();
        let Some(&index) = self.by_channel.get(&channel) else { return };
        let topic = &mut self.topics[index];
        match topic.publisher.publish_cdr(&message.data) {
            Ok(()) => self.sent += 1,
            Err(error) if error.is_missed() => {
                if !std::mem::replace(&mut topic.has_stalled, true) {
                    tracing::warn!("{error}");
                }
                self.sent += 1;
                self.undelivered += 1;
            }
            Err(error) => topic.leave_out(&error),
        }
    }

    /// Waits until subscribers have everything, as far as the transport knows, and counts what they do not have.
    ///
    /// # Errors
    /// The first [`TransportError`] other than undelivered messages, after all topics.
    pub fn flush(&mut self) -> Result<(), TransportError> {
        let mut outcome = Ok(());
        for topic in &mut self.topics {
            match topic.publisher.flush() {
                Err(error @ TransportError::Undelivered { messages, .. }) => {
                    tracing::warn!("{error}");
                    self.undelivered += messages;
                }
                flushed => outcome = outcome.and(flushed),
            }
        }
        outcome
    }

    /// Publishes the recorded time, if that was asked for.
    ///
    /// # Errors
    /// [`TransportError`].
    pub fn publish_clock(&mut self, recorded: Stamp) -> Result<(), TransportError> {
        let Some((_, clock)) = &mut self.clock else { return Ok(()) };
        clock.publish_cdr(&cdr::encode(&Clock { clock: recorded.into() }))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;
    use crate::ros::RosArguments;
    use eddy_bag::{BagReader, BagWriter, QosOverrides, WriterOptions};
    use eddy_messages::{ParticleFrame, RosString};
    use eddy_transport::{Subscriber, TransportKind, TransportOptions};

    const INT32: &str = "std_msgs/msg/Int32";

    fn word() -> Vec<u8> {
        cdr::encode(&RosString { data: "eddy".into() })
    }

    /// A bag with these messages, by topic and type.
    fn bag(messages: &[(&str, &str, Vec<u8>)]) -> (tempfile::TempDir, BagReader) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("bag");
        let mut writer = BagWriter::create(&path, WriterOptions::default()).unwrap();
        for ((topic, type_name, data), time) in messages.iter().zip(1..) {
            let topic = writer.topic(topic, type_name).unwrap();
            writer.write(topic, Stamp(time), Stamp(time), data).unwrap();
        }
        writer.finish().unwrap();
        (folder, BagReader::open(&path).unwrap())
    }

    fn options() -> OutputOptions {
        OutputOptions {
            transport: TransportKind::Memory,
            topics: Vec::new(),
            remap: Vec::new(),
            clock: false,
            reliability: Reliability::Block,
            overrides: QosOverrides::new(),
        }
    }

    fn open(transports: &Transports, bag: &BagReader, options: &OutputOptions) -> TopicOutputs {
        let plan = PlaybackPlan::new(bag, &RosArguments::default().node("outputs"), options);
        TopicOutputs::open(transports, options, plan.unwrap()).unwrap()
    }

    fn transports() -> Transports {
        Transports::new(TransportOptions::new("outputs"))
    }

    fn receive(subscriber: &mut dyn Subscriber) -> Vec<u8> {
        subscriber.receive(Duration::from_secs(60)).unwrap().unwrap().into_cdr()
    }

    #[test]
    fn messages_and_the_clock_are_published_under_their_new_names() {
        let clock = cdr::encode(&Clock::default());
        let (_folder, bag) =
            bag(&[("/words", RosString::TYPE, word()), ("/clock", Clock::TYPE, clock)]);
        let transports = transports();
        let remap = ["/words:=/renamed", "/clock:=/time"].map(str::to_owned).to_vec();
        let options = OutputOptions { clock: true, remap, ..options() };
        let mut words = transports.subscriber(&Link::memory("/renamed"), RosString::TYPE).unwrap();
        let mut time = transports.subscriber(&Link::memory("/time"), Clock::TYPE).unwrap();
        let mut outputs = open(&transports, &bag, &options);
        bag.messages().for_each(|message| outputs.publish(&message.unwrap()));
        outputs.publish_clock(Stamp(7)).unwrap();
        // Not the recorded clock.
        assert_eq!((outputs.sent, outputs.left_out().len()), (1, 0));
        assert_eq!(receive(words.as_mut()), word());
        let clock: Clock = cdr::decode(&receive(time.as_mut())).unwrap();
        assert_eq!(Stamp::from(clock.clock), Stamp(7));
    }

    #[test]
    fn a_topic_that_cannot_be_opened_is_left_out_and_named_while_the_others_are_published() {
        let (_folder, bag) =
            bag(&[("/taken", RosString::TYPE, word()), ("/words", RosString::TYPE, word())]);
        let transports = transports();
        // Another program uses the topic with another type.
        let _taken = transports.subscriber(&Link::memory("/taken"), INT32).unwrap();
        let mut words = transports.subscriber(&Link::memory("/words"), RosString::TYPE).unwrap();
        let mut outputs = open(&transports, &bag, &options());
        bag.messages().for_each(|message| outputs.publish(&message.unwrap()));
        assert_eq!(receive(words.as_mut()), word());
        assert_eq!(outputs.sent, 1);
        let expected = "topic /taken: memory:/taken: found message type std_msgs/msg/Int32";
        let left_out = outputs.left_out();
        assert!(left_out.len() == 1 && left_out[0].starts_with(expected), "{left_out:?}");

        let named = OutputOptions { topics: vec!["/taken".to_owned()], ..options() };
        let ros = RosArguments::default().node("outputs");
        let plan = PlaybackPlan::new(&bag, &ros, &named).unwrap();
        assert!(TopicOutputs::open(&transports, &named, plan).is_err());
    }

    /// Shared memory carries frames in its own form.
    #[test]
    fn messages_that_cannot_be_published_are_counted_and_named_while_the_others_are() {
        let topic = format!("/outputs_{}", std::process::id());
        let mut messages = vec![(topic.as_str(), ParticleFrame::TYPE, word()); 3];
        let other = format!("{topic}_words");
        messages.insert(1, (other.as_str(), RosString::TYPE, word()));
        let (_folder, bag) = bag(&messages);
        let transports = transports();
        let mut words = transports.subscriber(&Link::shm(&other), RosString::TYPE).unwrap();
        let options = OutputOptions { transport: TransportKind::Shm, ..options() };
        let mut outputs = open(&transports, &bag, &options);
        bag.messages().for_each(|message| outputs.publish(&message.unwrap()));
        assert_eq!(receive(words.as_mut()), word());
        assert_eq!(outputs.sent, 1);
        let left_out = outputs.left_out();
        assert_eq!(left_out.len(), 1, "{left_out:?}");
        assert!(left_out[0].starts_with(&format!("topic {topic}: 3 messages: shm:{topic}: ")));
    }
}
