//! DDS: what RustDDS transmits, discovery, and limits.

use std::{
    net::{IpAddr, Ipv4Addr, UdpSocket},
    time::{Duration, Instant},
};

use eddy_messages::{
    Message, ParticleFrame, QosProfile, RosString, cdr,
    qos::{DurabilityPolicy, HistoryPolicy, ReliabilityPolicy},
    type_support,
};
use eddy_transport::{
    Link, Payload, Publisher, PublisherOptions, Reliability, TransportError, TransportKind,
    TransportOptions, Transports,
};
use ros2_client::dds::rustdds::{
    DomainParticipantBuilder, QosPolicyBuilder, TopicKind, WriteOptions,
    policy::{self, History},
};

use super::{
    DEADLINE, child::Process, domain, ends, eventually, expect_frame, frame, frames_publisher,
    frames_subscriber, link, next_frame,
};

/// Options with a domain of this test.
fn options() -> TransportOptions {
    TransportOptions { domain_id: domain(), ..super::options() }
}

#[test]
fn domains_do_not_mix() {
    let (options, link) = (options(), link("dds"));
    let other = TransportOptions { domain_id: options.domain_id + 1, ..options.clone() };
    let (here, there) = (Transports::new(options.clone()), Transports::new(options));
    let elsewhere = Transports::new(other);
    let mut elsewhere = frames_subscriber(&elsewhere, &link);
    let mut same = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber of our domain is seen", || publisher.subscribers() == 1);
    publisher.publish_frame(&frame(0, 1)).unwrap();
    expect_frame(&mut *same, &frame(0, 1));
    assert_eq!(elsewhere.receive(Duration::from_millis(100)).unwrap(), None);
}

#[test]
fn subscribers_receive_from_blocking_and_from_dropping_publishers() {
    let ([here, there], link) = (ends("dds", options()), link("dds"));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut blocking = frames_publisher(&here, &link, Reliability::Block);
    let mut dropping = frames_publisher(&here, &link, Reliability::Drop);
    eventually("the subscriber is seen", || blocking.subscribers() > 0);
    eventually("the subscriber is seen again", || dropping.subscribers() > 0);
    // What is sent as best effort is lost until the subscriber's process has matched the publisher, too.
    let wait = Duration::from_millis(100);
    eventually("the publisher is seen", || {
        dropping.publish_frame(&frame(0, 3)).unwrap();
        subscriber.receive(wait).unwrap().is_some()
    });
    while subscriber.receive(wait).unwrap().is_some() {}
    for sequence in 0..10 {
        let publisher = if sequence % 2 == 0 { &mut blocking } else { &mut dropping };
        publisher.publish_frame(&frame(sequence, 2_500)).unwrap();
        expect_frame(&mut *subscriber, &frame(sequence, 2_500));
    }
    assert_eq!(subscriber.receive(wait).unwrap(), None, "each once");
    assert_eq!(subscriber.lost(), 0);
}

#[test]
fn a_message_too_large_is_rejected_with_size_limit_and_alternatives() {
    let (transports, link) = (Transports::new(options()), link("dds"));
    let mut publisher = transports.publisher(&link, RosString::TYPE, Reliability::Block).unwrap();
    let bytes = cdr::encode(&RosString { data: "e".repeat(9 << 20) });
    let error = publisher.publish_cdr(&bytes).unwrap_err();
    assert!(matches!(error, TransportError::TooLarge { .. }));
    let found = bytes.len();
    let message = error.to_string();
    assert!(message.starts_with(&format!("{link}: found a message of {found} bytes")), "{message}");
    assert!(message.ends_with("(use shm or zenoh for larger ones)"), "{message}");
    // The publisher stays usable.
    publisher.publish_cdr(&cdr::encode(&RosString { data: "e".to_owned() })).unwrap();
}

#[test]
fn messages_arrive_after_their_publisher_is_dropped() {
    let ([here, there], link) = (ends("dds", options()), link("dds"));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    for sequence in 0..100 {
        publisher.publish_frame(&frame(sequence, 2_500)).unwrap();
    }
    drop((publisher, here));
    for sequence in 0..100 {
        expect_frame(&mut *subscriber, &frame(sequence, 2_500));
    }
    assert_eq!(subscriber.lost(), 0);
}

#[test]
fn bytes_that_are_not_a_frame_are_delivered() {
    let ([here, there], link) = (ends("dds", options()), link("dds"));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    let hostile = [vec![0, 1, 0, 0], [vec![0, 1, 0, 0], vec![0xff; 1_000]].concat()];
    for bytes in &hostile {
        publisher.publish_cdr(bytes).unwrap();
        let payload = subscriber.receive(DEADLINE).unwrap().unwrap();
        assert!(matches!(&payload, Payload::Cdr(_)));
        assert!(payload.into_frame().is_err());
    }
    publisher.publish_frame(&frame(1, 3)).unwrap();
    expect_frame(&mut *subscriber, &frame(1, 3));
}

#[test]
fn big_endian_cdr_is_not_sent_as_little_endian() {
    let (transports, link) = (Transports::new(options()), link("dds"));
    let mut publisher = frames_publisher(&transports, &link, Reliability::Block);
    let message = publisher.publish_cdr(&[0, 0, 0, 0, 7]).unwrap_err().to_string();
    assert!(message.contains("expected plain little-endian CDR"), "{message}");
}

fn word(word: &str) -> Vec<u8> {
    cdr::encode(&RosString { data: word.to_owned() })
}

/// A publisher of strings.
fn offering(transports: &Transports, link: &Link, offered: QosProfile) -> Box<dyn Publisher> {
    let words = type_support(RosString::TYPE).unwrap();
    transports
        .publisher(
            link,
            words,
            PublisherOptions { reliability: Reliability::Block, qos: Some(offered) },
        )
        .unwrap()
}

/// History is not announced on DDS.
fn announced(reliability: ReliabilityPolicy, durability: DurabilityPolicy) -> QosProfile {
    QosProfile { reliability, durability, history: HistoryPolicy::Unknown }
}

#[test]
fn late_subscribers_receive_what_publishers_keep_and_every_message_once() {
    let ([here, there], link) = (ends("dds", options()), link("dds"));
    let latched = QosProfile {
        durability: DurabilityPolicy::TransientLocal,
        history: HistoryPolicy::KeepLast(2),
        ..QosProfile::default()
    };
    // It waits since before there are publishers, and reads all of them.
    let mut early = there.subscriber(&link, RosString::TYPE).unwrap();
    let (mut first, mut second) =
        (offering(&here, &link, latched), offering(&here, &link, latched));
    first.publish_cdr(&word("one")).unwrap();
    second.publish_cdr(&word("two")).unwrap();
    let mut late = there.subscriber(&link, RosString::TYPE).unwrap();
    let mut plain = offering(&here, &link, QosProfile::default());
    eventually("the plain publisher is seen", || plain.subscribers() == 2);
    plain.publish_cdr(&word("six")).unwrap();
    for subscriber in [&mut early, &mut late] {
        let mut received: Vec<_> =
            (0..3).map(|_| subscriber.receive(DEADLINE).unwrap().unwrap().into_cdr()).collect();
        received.sort();
        let mut expected = ["one", "two", "six"].map(word);
        expected.sort();
        assert_eq!(received, expected);
        assert_eq!(subscriber.receive(Duration::from_millis(300)).unwrap(), None, "each once");
    }
}

#[test]
fn what_publishers_offer_is_seen() {
    let ([here, there], link) = (ends("dds", options()), link("dds"));
    let offered = [
        announced(ReliabilityPolicy::Reliable, DurabilityPolicy::Volatile),
        announced(ReliabilityPolicy::Reliable, DurabilityPolicy::TransientLocal),
        announced(ReliabilityPolicy::BestEffort, DurabilityPolicy::Volatile),
    ];
    let _publishers = offered.map(|offered| offering(&here, &link, offered));
    eventually("all are seen", || {
        let topics = there.topics(TransportKind::Dds).unwrap();
        let topic = topics.into_iter().find(|topic| topic.link == link);
        topic.is_some_and(|topic| topic.type_name == RosString::TYPE && topic.offered == offered)
    });
}

/// Requests that exceed what a publisher offers are reported as errors by ROS.
#[test]
fn a_best_effort_publisher_meets_no_reliable_subscriber() {
    let (options, link) = (options(), link("dds"));
    let [here, there] = [(); 2].map(|()| Transports::new(options.clone()));
    let best_effort = announced(ReliabilityPolicy::BestEffort, DurabilityPolicy::Volatile);
    let mut publisher = offering(&here, &link, best_effort);
    let seen = || {
        let topics = there.topics(TransportKind::Dds).unwrap();
        topics.into_iter().any(|topic| topic.link == link)
    };
    eventually("the publisher is seen", seen);
    let mut subscriber = there.subscriber(&link, RosString::TYPE).unwrap();
    let watcher = DomainParticipantBuilder::new(options.domain_id)
        .with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)])
        .build()
        .unwrap();
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    let of_topic = || {
        let mut readers = watcher.discovered_readers();
        let name = format!("rt{}", link.topic);
        readers.retain(|reader| *reader.subscription_topic_data.topic_name() == name);
        readers
    };
    eventually("the watcher sees it", || !of_topic().is_empty());
    eventually("a message arrives", || {
        publisher.publish_cdr(&word("one")).unwrap();
        subscriber.receive(Duration::from_millis(100)).unwrap().is_some()
    });
    let readers = of_topic();
    assert_eq!(readers.len(), 1);
    let reliability = readers[0].subscription_topic_data.qos().reliability();
    assert_eq!(reliability, Some(policy::Reliability::BestEffort));
}

/// Fast DDS needs the key hash, without which it keeps the node in the ROS graph until its lease ends.
#[test]
fn a_participant_says_farewell_with_its_key_hash() {
    const PID_KEY_HASH: [u8; 4] = [0x70, 0, 16, 0];
    let options = options();
    // The discovery port of the last participant of the domain.
    let port = 7_400 + 250 * options.domain_id + 10 + 2 * 119;
    let socket = UdpSocket::bind((Ipv4Addr::LOCALHOST, port)).unwrap();
    socket.set_read_timeout(Some(DEADLINE)).unwrap();
    let transports = Transports::new(options.clone());
    let watcher = DomainParticipantBuilder::new(options.domain_id)
        .with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)])
        .build()
        .unwrap();
    let publisher = frames_publisher(&transports, &link("dds"), Reliability::Drop);
    let writer = || watcher.discovered_writers().first().map(|w| w.writer_proxy.remote_writer_guid);
    eventually("the publisher is seen", || writer().is_some());
    let prefix = writer().unwrap().to_bytes()[..12].to_vec();
    drop((publisher, transports));
    let mut farewell = [0; 256];
    let (length, _) = socket.recv_from(&mut farewell).unwrap();
    let farewell = &farewell[..length];
    assert_eq!((&farewell[..4], &farewell[8..20]), (&b"RTPS"[..], &prefix[..]));
    let at = farewell.windows(4).position(|bytes| bytes == PID_KEY_HASH).unwrap();
    assert_eq!(farewell[at + 4..at + 16], prefix);
}

/// The client uses RustDDS directly, with the names and identities of a ROS client.
#[test]
fn a_service_answers_each_request_under_its_identity() {
    let (options, link) = (options(), link("dds"));
    let transports = Transports::new(options.clone());
    let double = |request: &[u8]| Some([&request[..4], &[2 * request[4]]].concat());
    let service = transports.serve(&link, "std_srvs/srv/Trigger", Box::new(double)).unwrap();
    assert!(service.is_some());

    let participant = DomainParticipantBuilder::new(options.domain_id)
        .with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)])
        .build()
        .unwrap();
    let qos = QosPolicyBuilder::new()
        .reliable(Duration::from_secs(1).into())
        .history(History::KeepLast { depth: 10 })
        .build();
    let topic = |name: String, part: &str| {
        let kind = format!("std_srvs::srv::dds_::Trigger_{part}_");
        participant.create_topic(name, kind, &qos, TopicKind::NoKey).unwrap()
    };
    let responses = topic(format!("rr{}Reply", link.topic), "Response");
    let subscriber = participant.create_subscriber(&qos).unwrap();
    let mut responses = subscriber.create_datareader_no_key_cdr::<u8>(&responses, None).unwrap();
    let requests = topic(format!("rq{}Request", link.topic), "Request");
    let publisher = participant.create_publisher(&qos).unwrap();
    let requests = publisher.create_datawriter_no_key_cdr::<u8>(&requests, None).unwrap();

    let mut asked = Vec::new();
    eventually("a response", || {
        let identity = requests.write_with_options(21, WriteOptions::default()).unwrap();
        asked.push(identity);
        responses.take_next_sample().unwrap().is_some_and(|response| {
            assert_eq!(*response.value(), 42);
            let answered = response.sample_info().related_sample_identity().unwrap();
            asked.contains(&answered)
        })
    });
}

#[test]
fn other_transports_have_no_services() {
    let transports = Transports::new(super::options());
    for transport in ["memory", "shm"] {
        let handler = Box::new(|_: &[u8]| None);
        let served = transports.serve(&link(transport), "std_srvs/srv/Trigger", handler);
        assert!(served.unwrap().is_none(), "{transport}");
    }
}

#[test]
fn a_killed_publisher_leaves_its_subscriber_running_and_works_again_when_restarted() {
    let (options, link) = (options(), link("dds"));
    let transports = Transports::new(options.clone());
    let mut subscriber = transports.subscriber(&link, ParticleFrame::TYPE).unwrap();
    for _ in 0..3 {
        let publisher = Process::start("publish", &link, &options);
        publisher.says("ready");
        let start = Instant::now();
        next_frame(&mut *subscriber);
        println!("a publisher that was started again is heard after {:?}", start.elapsed());
        publisher.kill();
        while subscriber.receive(Duration::from_millis(50)).unwrap().is_some() {}
    }
}

#[test]
fn what_a_stopped_subscriber_has_not_acknowledged_is_counted() {
    let (mut options, link) = (options(), link("dds"));
    options.patience = Duration::from_millis(500);
    let transports = Transports::new(options.clone());
    let mut publisher = frames_publisher(&transports, &link, Reliability::Block);
    let stopped = Process::start("stall", &link, &options);
    stopped.says("ready");
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    publisher.publish_frame(&frame(0, 10)).unwrap();
    stopped.says("frame 0");
    publisher.flush().unwrap();
    stopped.pause();
    for sequence in 1..=3 {
        publisher.publish_frame(&frame(sequence, 10)).unwrap();
    }
    let message = publisher.flush().unwrap_err().to_string();
    let expected = format!("{link}: up to 3 messages were not delivered to the subscriber");
    assert!(message.starts_with(&expected), "{message}");
    publisher.flush().unwrap(); // counted once
}
