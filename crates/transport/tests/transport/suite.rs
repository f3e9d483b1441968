//! Guarantees of every transport.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use eddy_messages::{
    DiagnosticArray, FrameCdr as _, Message, ParticleFrame, RosString, TypeSupport, cdr,
    type_descriptions::{
        GET_TYPE_DESCRIPTION, SERVICE_NAME, TypeDescriptionRequest, TypeDescriptionResponse,
    },
    type_support,
};
use eddy_transport::{Link, Reliability, SeenTopic, TransportError, Transports};

use super::{
    DEADLINE, child::Process, ends, eventually, expect_frame, frame, frames_publisher,
    frames_subscriber, in_space, is_frame, link, next_frame, next_in_space, options,
};

const PARTICLES: usize = 2_500;

/// One module with all tests for each transport.
macro_rules! every_transport {
    ($($transport:ident)*) => {$(
        mod $transport {
            const NAME: &str = stringify!($transport);

            #[test]
            fn frames_arrive_bit_by_bit_and_in_order() {
                super::frames_arrive_bit_by_bit_and_in_order(NAME);
            }
            #[test]
            fn every_subscriber_gets_every_frame() {
                super::every_subscriber_gets_every_frame(NAME);
            }
            #[test]
            fn other_messages_travel_as_cdr() {
                super::other_messages_travel_as_cdr(NAME);
            }
            #[test]
            fn frames_given_as_bytes_arrive_as_frames() {
                super::frames_given_as_bytes_arrive_as_frames(NAME);
            }
            #[test]
            fn a_slow_subscriber_loses_nothing_under_block() {
                super::a_slow_subscriber_loses_nothing_under_block(NAME);
            }
            #[test]
            fn a_subscriber_that_receives_nothing_never_blocks_a_dropping_publisher() {
                super::a_subscriber_that_receives_nothing_never_blocks_a_dropping_publisher(NAME);
            }
            #[test]
            fn a_later_subscriber_gets_the_later_frames() {
                super::a_later_subscriber_gets_the_later_frames(NAME);
            }
            #[test]
            fn a_dropped_subscriber_is_not_counted_and_does_not_block() {
                super::a_dropped_subscriber_is_not_counted_and_does_not_block(NAME);
            }
            #[test]
            fn nothing_within_the_timeout_is_none() {
                super::nothing_within_the_timeout_is_none(NAME);
            }
            #[test]
            fn frames_of_any_size_share_a_topic() {
                super::frames_of_any_size_share_a_topic(NAME);
            }
            #[test]
            fn frames_of_either_dimension_share_a_topic() {
                super::frames_of_either_dimension_share_a_topic(NAME);
            }
            #[test]
            fn publishers_and_subscribers_outlive_their_transports() {
                super::publishers_and_subscribers_outlive_their_transports(NAME);
            }
            #[test]
            fn only_topics_of_frames_accept_frames() {
                super::only_topics_of_frames_accept_frames(NAME);
            }
            #[test]
            fn an_unknown_type_is_rejected() {
                super::an_unknown_type_is_rejected(NAME);
            }
        }
    )*};
}

every_transport! { memory shm zenoh dds }

fn frames_arrive_bit_by_bit_and_in_order(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    for sequence in 0..20 {
        publisher.publish_frame(&frame(sequence, PARTICLES)).unwrap();
    }
    for sequence in 0..20 {
        expect_frame(&mut *subscriber, &frame(sequence, PARTICLES));
    }
    assert_eq!(subscriber.lost(), 0);
}

fn every_subscriber_gets_every_frame(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut subscribers = [(); 2].map(|()| frames_subscriber(&there, &link));
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("both are seen", || publisher.subscribers() == 2);
    for sequence in 0..5 {
        publisher.publish_frame(&frame(sequence, 10)).unwrap();
    }
    for subscriber in &mut subscribers {
        for sequence in 0..5 {
            expect_frame(&mut **subscriber, &frame(sequence, 10));
        }
    }
}

fn other_messages_travel_as_cdr(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut subscriber = there.subscriber(&link, RosString::TYPE).unwrap();
    let mut publisher = here.publisher(&link, RosString::TYPE, Reliability::Block).unwrap();
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    // From empty to larger than the first buffer of any transport.
    let longest = if transport == "dds" { 200_000 } else { 300_000 };
    for length in [0, 1, 2_000, longest] {
        let bytes = cdr::encode(&RosString { data: "e".repeat(length) });
        publisher.publish_cdr(&bytes).unwrap();
        let found = subscriber.receive(DEADLINE).unwrap().unwrap().into_cdr();
        // DDS pads messages to a multiple of 4 bytes.
        let (message, filling) = found.split_at(bytes.len());
        assert!(message == bytes, "{length} letters differ");
        assert!(filling.len() < 4 && (transport == "dds" || filling.is_empty()), "{filling:?}");
    }
}

fn frames_given_as_bytes_arrive_as_frames(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    let mut elsewhere = ParticleFrame::from(&frame(3, 10));
    elsewhere.header.frame_id = "map".to_owned();
    for message in [ParticleFrame::from(&frame(2, 10)), elsewhere] {
        publisher.publish_cdr(&cdr::encode(&message)).unwrap();
    }
    expect_frame(&mut *subscriber, &frame(2, 10));
    expect_frame(&mut *subscriber, &frame(3, 10));
}

fn a_slow_subscriber_loses_nothing_under_block(transport: &str) {
    const FRAMES: u64 = 500;
    // RustDDS acknowledges a message before the subscriber's thread takes it, and keeps 256 of them: if the system gives
    // that thread no time for longer, the oldest are lost.
    let most_ahead = if transport == "dds" { 200 } else { FRAMES };
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    let read = Arc::<AtomicU64>::default();
    let progress = Arc::clone(&read);
    let publishing = thread::spawn(move || {
        for sequence in 0..FRAMES {
            eventually("the subscriber follows", || {
                sequence < progress.load(Ordering::Relaxed) + most_ahead
            });
            publisher.publish_frame(&frame(sequence, PARTICLES)).unwrap();
        }
        publisher
    });
    for sequence in 0..FRAMES {
        assert_eq!(next_frame(&mut *subscriber).sequence, sequence);
        read.store(sequence + 1, Ordering::Relaxed);
        if sequence % 10 == 0 {
            // Slow, so that the publisher fills every buffer.
            thread::sleep(Duration::from_millis(10));
        }
    }
    assert_eq!(subscriber.lost(), 0);
    drop(publishing.join().unwrap());
}

fn a_subscriber_that_receives_nothing_never_blocks_a_dropping_publisher(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Drop);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    let start = Instant::now();
    for sequence in 0..500 {
        publisher.publish_frame(&frame(sequence, PARTICLES)).unwrap();
    }
    let patience = options().patience;
    assert!(start.elapsed() < patience, "waited {:?}", start.elapsed());
    // The frames that arrive are in order, with gaps.
    let first = next_frame(&mut *subscriber).sequence;
    let second = next_frame(&mut *subscriber).sequence;
    assert!(first < second, "{first} then {second}");
}

fn a_later_subscriber_gets_the_later_frames(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    assert_eq!(publisher.subscribers(), 0);
    publisher.publish_frame(&frame(0, 10)).unwrap();
    let mut subscriber = frames_subscriber(&there, &link);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    publisher.publish_frame(&frame(1, 10)).unwrap();
    expect_frame(&mut *subscriber, &frame(1, 10));
}

fn a_dropped_subscriber_is_not_counted_and_does_not_block(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    drop(subscriber);
    eventually("it is gone", || publisher.subscribers() == 0);
    let start = Instant::now();
    for sequence in 0..200 {
        publisher.publish_frame(&frame(sequence, 10)).unwrap();
    }
    let patience = options().patience;
    assert!(start.elapsed() < patience, "waited {:?}", start.elapsed());
}

fn nothing_within_the_timeout_is_none(transport: &str) {
    let ([_, there], link) = (ends(transport, options()), link(transport));
    let mut subscriber = frames_subscriber(&there, &link);
    for timeout in [Duration::ZERO, Duration::from_millis(1), Duration::from_millis(250)] {
        let start = Instant::now();
        assert_eq!(subscriber.receive(timeout).unwrap(), None);
        let waited = start.elapsed();
        assert!(waited >= timeout && waited < DEADLINE, "waited {waited:?} for {timeout:?}");
    }
}

fn frames_of_any_size_share_a_topic(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    // The limit of DDS depends on the machine: at least 12,500 particles.
    let largest = if transport == "dds" { 12_000 } else { 20_000 };
    let sizes = [1, 2_500, 3, 6_000, 1, largest, 100];
    // All are sent before the first is received; but not on shared memory, where a frame that needs more memory
    // overtakes those sent before the subscriber has connected.
    let together = if transport == "shm" { 1 } else { sizes.len() };
    let frames: Vec<_> = (0..).zip(sizes).map(|(sequence, size)| frame(sequence, size)).collect();
    for frames in frames.chunks(together) {
        frames.iter().for_each(|frame| publisher.publish_frame(frame).unwrap());
        frames.iter().for_each(|frame| expect_frame(&mut *subscriber, frame));
    }
}

fn frames_of_either_dimension_share_a_topic(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    for sequence in 0..6 {
        let (plane, space) = (frame(2 * sequence, 50), in_space(2 * sequence + 1, 500));
        publisher.publish_cdr(&space.to_cdr()).unwrap();
        assert_eq!(next_in_space(&mut *subscriber), space);
        publisher.publish_frame(&plane).unwrap();
        expect_frame(&mut *subscriber, &plane);
    }
    assert_eq!(subscriber.lost(), 0);
}

fn publishers_and_subscribers_outlive_their_transports(transport: &str) {
    let ([here, there], link) = (ends(transport, options()), link(transport));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    drop((here, there));
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    publisher.publish_frame(&frame(0, 1)).unwrap();
    expect_frame(&mut *subscriber, &frame(0, 1));
}

fn only_topics_of_frames_accept_frames(transport: &str) {
    let ([here, _], link) = (ends(transport, options()), link(transport));
    let mut publisher = here.publisher(&link, DiagnosticArray::TYPE, Reliability::Drop).unwrap();
    let message = publisher.publish_frame(&frame(0, 1)).unwrap_err().to_string();
    let expected = "found message type eddy_msgs/msg/ParticleFrame, expected diagnostic_msgs/msg/DiagnosticArray";
    assert_eq!(message, format!("{link}: {expected}"));
}

fn an_unknown_type_is_rejected(transport: &str) {
    let error = Transports::new(options())
        .subscriber(&link(transport), "std_msgs/msg/Nothing")
        .err()
        .unwrap();
    assert!(matches!(error, TransportError::Type(_)), "{error}");
    assert!(error.to_string().contains("found std_msgs/msg/Nothing"), "{error}");
}

/// Memory and shared memory know the type of a topic. Zenoh has the type in the key; RustDDS ignores the type.
#[test]
fn a_topic_of_another_type_is_rejected_with_both_types() {
    for transport in ["memory", "shm"] {
        let ([here, there], link) = (ends(transport, options()), link(transport));
        let _strings = there.subscriber(&link, RosString::TYPE).unwrap();
        let error = here.publisher(&link, DiagnosticArray::TYPE, Reliability::Drop).err().unwrap();
        let expected =
            "found message type std_msgs/msg/String, expected diagnostic_msgs/msg/DiagnosticArray";
        assert_eq!(error.to_string(), format!("{link}: {expected}"));
    }
}

#[test]
fn published_topics_are_listed_with_their_types() {
    for transport in ["shm", "zenoh"] {
        let [here, there] = ends(transport, options());
        let (frames, words) = (link(transport), link(transport));
        let _frames = frames_publisher(&here, &frames, Reliability::Drop);
        let publisher = here.publisher(&words, RosString::TYPE, Reliability::Drop).unwrap();
        let listed = |link: &Link| {
            let topics = there.topics(link.transport).unwrap();
            topics.into_iter().find(|topic| topic.link == *link)
        };
        eventually("both are seen", || listed(&frames).is_some() && listed(&words).is_some());
        for (link, type_name) in [(&frames, ParticleFrame::TYPE), (&words, RosString::TYPE)] {
            let topic = listed(link).unwrap();
            assert_eq!(topic.type_name, type_name);
            assert_eq!(topic.type_support().hash, type_support(type_name).unwrap().hash);
            assert_eq!(topic.hash.is_some(), transport == "zenoh");
        }
        drop(publisher);
        eventually("one is gone", || listed(&words).is_none() && listed(&frames).is_some());
    }
}

#[test]
fn publishers_are_asked_for_the_definition_of_their_type() {
    const NAME: &str = "acme_msgs/msg/Probe";
    let known = TypeSupport::from_schema(NAME, "std_msgs/Header header\nfloat64 x\n").unwrap();
    for transport in ["zenoh", "dds"] {
        let (options, link) = (options(), link(transport));
        let node = options.node_name.clone();
        let [here, there] = ends(transport, options);
        let _publisher = here.publisher(&link, &known, Reliability::Block).unwrap();
        let seen = || {
            let topics = there.topics(link.transport).unwrap();
            topics.into_iter().find(|topic| topic.link == link)
        };
        eventually("the topic is seen", || seen().is_some());
        let topic = SeenTopic { hash: Some(known.hash.clone()), ..seen().unwrap() };
        let short = Duration::from_millis(50);
        assert!(there.described_type(&topic, short).unwrap().is_none(), "nobody answers");

        let description = known.description.clone();
        let answer = move |request: &[u8]| {
            let request: TypeDescriptionRequest = cdr::decode(request).unwrap();
            assert!(request.include_type_sources && request.type_hash.starts_with("RIHS01_"));
            Some(cdr::encode(&TypeDescriptionResponse {
                successful: request.type_name == NAME,
                failure_reason: String::new(),
                type_description: description.clone(),
                type_sources: Vec::new(),
                extra_information: Vec::new(),
            }))
        };
        let service: Link = format!("{transport}:/{node}/{SERVICE_NAME}").parse().unwrap();
        let _service = here.serve(&service, GET_TYPE_DESCRIPTION, Box::new(answer)).unwrap();
        let mut described = None;
        eventually("the definition is received", || {
            described = there.described_type(&topic, Duration::from_secs(5)).unwrap();
            described.is_some()
        });
        let described = described.unwrap();
        assert_eq!((described.name, described.hash), (NAME.to_owned(), known.hash.clone()));
        assert_eq!(described.schema, known.schema);
        if transport == "dds" {
            let hash = Some(format!("RIHS01_{}", "0".repeat(64)));
            let other = SeenTopic { hash, ..topic };
            let error = there.described_type(&other, Duration::from_secs(5)).unwrap_err();
            let expected = format!("{link}: definition of {NAME}: found type hash {}", known.hash);
            assert!(error.to_string().starts_with(&expected), "{error}");
        }
    }
}

#[test]
fn a_blocking_publisher_fails_after_its_patience_with_a_stalled_subscriber() {
    for transport in ["memory", "shm"] {
        let mut options = options();
        options.patience = Duration::from_millis(100);
        let ([here, there], link) = (ends(transport, options), link(transport));
        let mut subscriber = frames_subscriber(&there, &link);
        let mut publisher = frames_publisher(&here, &link, Reliability::Block);
        let stalled = (0..).map(|n| publisher.publish_frame(&frame(n, 10))).find_map(Result::err);
        let message = stalled.unwrap().to_string();
        let subscriber_name = match transport {
            "shm" => format!("the subscriber in process {}", std::process::id()),
            _ => "a subscriber".to_owned(),
        };
        let expected = format!("{link}: {subscriber_name} has read nothing for 0.1 s");
        assert!(message.starts_with(&expected), "{message}");
        // The publisher stays usable.
        assert!(is_frame(&subscriber.receive(DEADLINE).unwrap().unwrap()));
        publisher.publish_frame(&frame(99, 10)).unwrap();
    }
}

#[test]
fn others_go_on_beside_a_subscriber_that_reads_nothing() {
    for transport in ["memory", "shm"] {
        let mut options = options();
        options.patience = Duration::from_millis(500);
        let patience = options.patience;
        let ([here, there], link) = (ends(transport, options), link(transport));
        let mut stuck = frames_subscriber(&there, &link);
        let mut reader = frames_subscriber(&there, &link);
        let mut publisher = frames_publisher(&here, &link, Reliability::Block);
        eventually("both are seen", || publisher.subscribers() == 2);
        // Connects it.
        assert_eq!(stuck.receive(Duration::ZERO).unwrap(), None);
        let start = Instant::now();
        let mut missed = 0;
        for sequence in 0..300 {
            match publisher.publish_frame(&frame(sequence, 10)) {
                Ok(()) => {}
                Err(error @ TransportError::Stalled { .. }) => {
                    missed += 1;
                    assert!(error.to_string().contains("has read nothing for 0.5 s"), "{error}");
                }
                Err(error) => panic!("{error}"),
            }
            assert_eq!(next_frame(&mut *reader).sequence, sequence);
        }
        // Waited for once, not for each message.
        assert!(start.elapsed() < 4 * patience, "{transport}: {:?}", start.elapsed());
        assert!(missed > 200, "{transport}: {missed}");
        // It is waited for again once it reads.
        while stuck.receive(Duration::ZERO).unwrap().is_some() {}
        publisher.publish_frame(&frame(300, 10)).unwrap();
        assert_eq!(next_frame(&mut *stuck).sequence, 300);
    }
}

/// A peer process that is stopped, or reads nothing, must not keep a program that was asked to end.
#[test]
fn a_stop_ends_a_publisher_that_waits() {
    for transport in ["memory", "shm", "zenoh", "dds"] {
        let (mut options, link) = (options(), link(transport));
        options.domain_id = if transport == "dds" { super::domain() } else { 0 };
        let stop = Arc::<AtomicBool>::default();
        let here = Transports::stopped_by(Arc::clone(&stop), options.clone());
        let is_within = transport == "memory";
        let _within = is_within.then(|| frames_subscriber(&here, &link));
        let process = (!is_within).then(|| Process::start("stall", &link, &options));
        process.iter().for_each(|process| {
            process.says("ready");
        });
        let mut publisher = frames_publisher(&here, &link, Reliability::Block);
        eventually("the subscriber is seen", || publisher.subscribers() == 1);
        publisher.publish_frame(&frame(0, PARTICLES)).unwrap();
        process.iter().for_each(|process| {
            process.says("frame 0");
            process.pause();
        });
        let published = Arc::<AtomicU64>::default();
        let (count, stopping) = (Arc::clone(&published), Arc::clone(&stop));
        let publishing = thread::spawn(move || {
            let outcome = (1..).find_map(|n| {
                count.store(n, Ordering::Relaxed);
                let ended = stopping.load(Ordering::Relaxed).then_some(Ok(()));
                publisher.publish_frame(&frame(n, PARTICLES)).err().map(Err).or(ended)
            });
            (publisher, outcome.unwrap())
        });
        // It waits once the number no longer changes.
        let mut before = 0;
        eventually("the publisher waits", || {
            thread::sleep(Duration::from_millis(500));
            let now = published.load(Ordering::Relaxed);
            now > 1 && std::mem::replace(&mut before, now) == now
        });
        let start = Instant::now();
        stop.store(true, Ordering::Relaxed);
        let (mut publisher, outcome) = publishing.join().unwrap();
        let message = match outcome {
            Ok(()) => publisher.flush().unwrap_err().to_string(),
            Err(error) => error.to_string(),
        };
        assert!(message.starts_with(&format!("{link}: ")), "{message}");
        drop((publisher, here));
        assert!(start.elapsed() < Duration::from_secs(5), "{transport}: {:?}", start.elapsed());
    }
}
