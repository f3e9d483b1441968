//! Zenoh: the wire format, and discovery.

use std::{
    net::TcpListener,
    time::{Duration, Instant},
};

use eddy_messages::{
    FrameCdr, Message, ParticleFrame, QosProfile, RosString, cdr,
    qos::{DurabilityPolicy, HistoryPolicy},
    service_hash, type_support,
};
use eddy_transport::{
    Link, Payload, Publisher, PublisherOptions, Reliability, Subscriber, TransportKind,
    TransportOptions, Transports,
};
use zenoh::{
    Session, Wait,
    query::{ConsolidationMode, ReplyKeyExpr},
};

use super::{
    DEADLINE, child::Process, ends, eventually, expect_frame, frame, frames_publisher,
    frames_subscriber, link, next_frame, options,
};
use crate::client::Client;

/// A plain Zenoh session in `mode` with these endpoints (JSON5).
fn plain_session(mode: &str, listen: &str, connect: &str) -> Session {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", mode),
        ("listen/endpoints", listen),
        ("connect/endpoints", connect),
        ("scouting/multicast/enabled", "false"),
    ] {
        config.insert_json5(key, value).unwrap();
    }
    zenoh::open(config).wait().unwrap()
}

/// A plain session connected to the process on the first port of `options`.
fn plain_peer(options: &TransportOptions) -> Session {
    let connect = format!(r#"["tcp/127.0.0.1:{}"]"#, options.zenoh.ports.start());
    plain_session(r#""peer""#, r#"["tcp/127.0.0.1:0"]"#, &connect)
}

/// A router on any free port, and its endpoint.
fn router() -> (Session, String) {
    let free = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let endpoint = format!("tcp/{free}");
    (plain_session(r#""router""#, &format!(r#"["{endpoint}"]"#), "[]"), endpoint)
}

fn topic_key(link: &Link) -> String {
    let hash = &type_support(ParticleFrame::TYPE).unwrap().hash;
    format!("0{}/eddy_msgs::msg::dds_::ParticleFrame_/{hash}", link.topic)
}

#[test]
fn others_see_the_keys_attachments_and_tokens_of_rmw_zenoh() {
    let (options, link) = (options(), link("zenoh"));
    let transports = Transports::new(options.clone());
    let mut publisher = frames_publisher(&transports, &link, Reliability::Block);
    let _subscriber = frames_subscriber(&transports, &link.with_topic("/elsewhere"));

    let peer = plain_peer(&options);
    let samples = peer.declare_subscriber("**").wait().unwrap();
    eventually("the peer is seen", || publisher.subscribers() >= 1);
    let sent = frame(4, 3);
    publisher.publish_frame(&sent).unwrap();
    publisher.publish_frame(&sent).unwrap();

    let first = samples.recv_timeout(DEADLINE).unwrap().unwrap();
    assert_eq!(first.key_expr().as_str(), topic_key(&link));
    let payload = first.payload().to_bytes();
    assert_eq!(payload[..4], [0, 1, 0, 0]);
    assert!(Payload::Cdr(payload.into_owned()).into_frame().unwrap() == sent);
    let second = samples.recv_timeout(DEADLINE).unwrap().unwrap();
    let [first, second] =
        [first, second].map(|sample| sample.attachment().unwrap().to_bytes().into_owned());
    assert_eq!((first.len(), second.len()), (33, 33));
    assert_eq!(first[..8], 1i64.to_le_bytes());
    assert_eq!(second[..8], 2i64.to_le_bytes());
    assert_eq!(first[16], 16);
    let times = [&first, &second].map(|a| i64::from_le_bytes(a[8..16].try_into().unwrap()));
    assert!(times[0] > 1_700_000_000_000_000_000 && times[0] <= times[1], "{times:?}");

    let tokens = peer.liveliness().get("@ros2_lv/**").wait().unwrap();
    let mut tokens: Vec<_> =
        tokens.iter().map(|reply| reply.result().unwrap().key_expr().to_string()).collect();
    tokens.sort();
    let hash = &type_support(ParticleFrame::TYPE).unwrap().hash;
    let zid = tokens[0].split('/').nth(2).unwrap().to_owned();
    let topic = link.topic.replace('/', "%");
    let name = "eddy_msgs::msg::dds_::ParticleFrame_";
    let expected = [
        format!("@ros2_lv/0/{zid}/0/0/NN/%/%/eddy_test"),
        format!("@ros2_lv/0/{zid}/0/1/MP/%/%/eddy_test/{topic}/{name}/{hash}/::2,:,:,:,,"),
        format!("@ros2_lv/0/{zid}/0/2/MS/%/%/eddy_test/%elsewhere/{name}/{hash}/2::,64:,:,:,,"),
    ];
    assert_eq!(tokens, expected);
    let gid = xxhash_rust::xxh3::xxh3_128(expected[1].as_bytes()).to_le_bytes();
    assert_eq!(first[17..], gid);
}

#[test]
fn a_service_answers_each_request_under_its_sequence_and_gid() {
    const TRIGGER: &str = "std_srvs/srv/Trigger";
    let (options, link) = (options(), link("zenoh"));
    let transports = Transports::new(options.clone());
    let double = |request: &[u8]| match request {
        [0, 1, 0, 0, number] => Some(vec![0, 1, 0, 0, 2 * number]),
        _ => None,
    };
    let service = transports.serve(&link, TRIGGER, Box::new(double)).unwrap().unwrap();
    let client = Client::of(*options.zenoh.ports.start(), 0);
    let request = |number| client.request(&link.topic, TRIGGER, vec![0, 1, 0, 0, number]);
    eventually("the service is there", || request(1).is_some());
    for number in 0..20 {
        assert_eq!(request(number), Some(Ok(vec![0, 1, 0, 0, 2 * number])));
    }
    let rejected = client.request(&link.topic, TRIGGER, vec![9]);
    assert_eq!(
        rejected,
        Some(Err("no response: the payload is not a request of this service, or the node is busy"
            .to_owned()))
    );
    assert_eq!(request(21), Some(Ok(vec![0, 1, 0, 0, 42])));

    let tokens = client.services();
    let zid = tokens[0].split('/').nth(2).unwrap();
    let (topic, hash) = (link.topic.replace('/', "%"), service_hash(TRIGGER).unwrap());
    let expected = format!(
        "@ros2_lv/0/{zid}/0/1/SS/%/%/eddy_test/{topic}/std_srvs::srv::dds_::Trigger_/{hash}/::,10:,:,:,,"
    );
    assert_eq!(tokens, [expected]);

    drop(service);
    eventually("the service is gone", || request(1).is_none());
    eventually("its token is gone", || client.services().is_empty());
}

fn latched(kept: usize) -> QosProfile {
    let (durability, history) = (DurabilityPolicy::TransientLocal, HistoryPolicy::KeepLast(kept));
    QosProfile { durability, history, ..QosProfile::default() }
}

/// A publisher of strings that keeps the last `kept`.
fn keeping(transports: &Transports, link: &Link, kept: usize) -> Box<dyn Publisher> {
    let words = type_support(RosString::TYPE).unwrap();
    let offered = Some(latched(kept));
    transports
        .publisher(link, words, PublisherOptions { reliability: Reliability::Block, qos: offered })
        .unwrap()
}

fn word(word: &str) -> Vec<u8> {
    cdr::encode(&RosString { data: word.to_owned() })
}

fn next_word(subscriber: &mut dyn Subscriber) -> Vec<u8> {
    subscriber.receive(DEADLINE).unwrap().expect("a word comes").into_cdr()
}

#[test]
fn a_late_subscriber_receives_the_kept_messages_and_every_message_once() {
    let (options, link) = (options(), link("zenoh"));
    let (here, there) = (Transports::new(options.clone()), Transports::new(options));
    let mut publisher = keeping(&here, &link, 3);
    for number in 0..5 {
        publisher.publish_cdr(&word(&number.to_string())).unwrap();
    }
    let mut subscriber = there.subscriber(&link, RosString::TYPE).unwrap();
    for number in 2..5 {
        assert_eq!(next_word(&mut *subscriber), word(&number.to_string()));
    }
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    publisher.publish_cdr(&word("5")).unwrap();
    assert_eq!(next_word(&mut *subscriber), word("5"));
    // A subscriber that joins even later.
    let mut another = there.subscriber(&link, RosString::TYPE).unwrap();
    for number in 3..6 {
        assert_eq!(next_word(&mut *another), word(&number.to_string()));
    }
    for subscriber in [&mut subscriber, &mut another] {
        assert_eq!(subscriber.receive(Duration::from_millis(200)).unwrap(), None);
        assert_eq!(subscriber.lost(), 0);
    }
    // The first subscriber receives every message once.
    let elsewhere = link.with_topic(&format!("{}/later", link.topic));
    let mut early = there.subscriber(&elsewhere, RosString::TYPE).unwrap();
    let mut publisher = keeping(&here, &elsewhere, 1);
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    for number in 0..3 {
        publisher.publish_cdr(&word(&number.to_string())).unwrap();
        assert_eq!(next_word(&mut *early), word(&number.to_string()));
    }
    assert_eq!(early.receive(Duration::from_millis(200)).unwrap(), None);
}

#[test]
fn what_each_publisher_offers_is_seen() {
    let (options, link) = (options(), link("zenoh"));
    let (here, there) = (Transports::new(options.clone()), Transports::new(options));
    let offered = || {
        let topics = there.topics(TransportKind::Zenoh).unwrap();
        topics.into_iter().find(|topic| topic.link == link).map(|topic| topic.offered)
    };
    let _first = keeping(&here, &link, 2);
    eventually("the first is seen", || offered() == Some(vec![latched(2)]));
    let _second = keeping(&here, &link, 1);
    eventually("the second is seen", || offered() == Some(vec![latched(1), latched(2)]));
    let _third = here.publisher(&link, RosString::TYPE, Reliability::Block).unwrap();
    let blocking = QosProfile { history: HistoryPolicy::KeepAll, ..QosProfile::default() };
    let all = vec![blocking, latched(1), latched(2)];
    eventually("the third is seen", || offered() == Some(all.clone()));
}

/// ROS 2 Lyrical appends a chunk to its tokens (rmw_zenoh, pull request 930).
#[test]
fn endpoints_with_tokens_of_more_chunks_than_known_are_seen() {
    let (options, link) = (options(), link("zenoh"));
    let transports = Transports::new(options.clone());
    let publisher = frames_publisher(&transports, &link, Reliability::Block);
    let peer = plain_peer(&options);
    let (zid, topic) = (peer.zid(), link.topic.replace('/', "%"));
    let token = |entity: &str, topic: &str, name: &str, hash: &str| {
        let token = format!(
            "@ros2_lv/0/{zid}/{entity}/%/%/camera/{topic}/{name}/{hash}/::,5:,:,:,,/backends:cpu/x"
        );
        peer.liveliness().declare_token(token).wait().unwrap()
    };
    let frames = &type_support(ParticleFrame::TYPE).unwrap().hash;
    let name = "eddy_msgs::msg::dds_::ParticleFrame_";
    let image = format!("{topic}%image");
    let trigger = service_hash("std_srvs/srv/Trigger").unwrap();
    let _tokens = [
        token("0/1/MP", &image, name, frames),
        token("0/2/MS", &topic, name, frames),
        token("0/3/MS", &topic, name, frames),
        token("0/4/SS", &image, "std_srvs::srv::dds_::Trigger_", trigger),
    ];
    let _samples = peer.declare_subscriber(topic_key(&link)).wait().unwrap();
    eventually("both subscribers are counted", || publisher.subscribers() == 2);
    let image = link.with_topic(&format!("{}/image", link.topic));
    let depth = || {
        let topics = transports.topics(TransportKind::Zenoh).unwrap();
        let seen = topics.into_iter().find(|topic| topic.link == image)?;
        Some((seen.type_name, seen.offered[0].history))
    };
    let expected = Some((ParticleFrame::TYPE.to_owned(), HistoryPolicy::KeepLast(5)));
    eventually("the publisher is seen", || depth() == expected);
    eventually("the service is seen", || {
        let services = transports.services(TransportKind::Zenoh).unwrap();
        services.iter().any(|service| service.link == image)
    });
}

#[test]
fn a_subscriber_that_requests_volatile_receives_no_kept_messages() {
    let (options, link) = (options(), link("zenoh"));
    let (here, there) = (Transports::new(options.clone()), Transports::new(options));
    let mut publisher = keeping(&here, &link, 1);
    publisher.publish_cdr(&word("kept")).unwrap();
    let words = type_support(RosString::TYPE).unwrap();
    let volatile = Some(QosProfile::default());
    let mut subscriber = there.requesting_subscriber(&link, words, volatile).unwrap();
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    publisher.publish_cdr(&word("new")).unwrap();
    assert_eq!(next_word(&mut *subscriber), word("new"));
}

/// Queries like those of `AdvancedSubscriber` in zenoh-ext.
#[test]
fn kept_messages_are_found_and_returned_as_in_zenoh_ext() {
    let (options, link) = (options(), link("zenoh"));
    let transports = Transports::new(options.clone());
    let mut publisher = keeping(&transports, &link, 2);
    for text in ["one", "two", "three"] {
        publisher.publish_cdr(&word(text)).unwrap();
    }
    let peer = plain_peer(&options);
    let hash = &type_support(RosString::TYPE).unwrap().hash;
    let key = format!("0{}/std_msgs::msg::dds_::String_/{hash}", link.topic);
    let find = || {
        let tokens = peer.liveliness().get(format!("{key}/@adv/pub/**")).wait().unwrap();
        tokens.recv().ok().map(|reply| reply.result().unwrap().key_expr().to_string())
    };
    eventually("the publisher is found", || find().is_some());
    let place = find().unwrap();
    let zid = place.split('/').rev().nth(2).unwrap();
    assert_eq!(place, format!("{key}/@adv/pub/{zid}/uhlc/_"));
    let ask = |selector: String| {
        let asked = peer.get(selector).accept_replies(ReplyKeyExpr::Any);
        let replies = asked.consolidation(ConsolidationMode::None).wait().unwrap();
        let samples = replies.iter().map(|reply| reply.into_result().unwrap());
        samples.collect::<Vec<_>>()
    };
    let mut all = Vec::new();
    // A peer that has just connected may know the token before the queryable.
    eventually("kept messages are returned", || {
        all = ask(format!("{key}/@adv/**"));
        !all.is_empty()
    });
    let words: Vec<_> = all.iter().map(|sample| sample.payload().to_bytes().into_owned()).collect();
    assert_eq!(words, [word("two"), word("three")]);
    let numbers = all.iter().map(|sample| sample.attachment().unwrap().to_bytes()[0]);
    assert_eq!(numbers.collect::<Vec<_>>(), [2, 3]);
    assert!(all.iter().all(|sample| sample.key_expr().as_str() == key));
    assert!(all[0].timestamp().unwrap() < all[1].timestamp().unwrap());
    let newest = ask(format!("{key}/@adv/pub/**?_max=1"));
    assert_eq!(newest.len(), 1);
    assert_eq!(newest[0].payload().to_bytes(), word("three"));
}

#[test]
fn a_service_of_a_type_without_a_hash_is_rejected() {
    let transports = Transports::new(options());
    let served = transports.serve(&link("zenoh"), "acme/srv/Fill", Box::new(|_: &[u8]| None));
    let message = served.err().unwrap().to_string();
    assert!(message.starts_with("service type: found acme/srv/Fill"), "{message}");
}

#[test]
fn messages_with_any_attachment_arrive_and_gaps_are_counted() {
    let (options, link) = (options(), link("zenoh"));
    let transports = Transports::new(options.clone());
    let mut subscriber = frames_subscriber(&transports, &link);
    let peer = plain_peer(&options);
    let publisher = peer.declare_publisher(topic_key(&link)).wait().unwrap();
    eventually("the subscriber is seen", || publisher.matching_status().wait().unwrap().matching());
    let attachment = |sequence: i64| {
        [&sequence.to_le_bytes()[..], &0i64.to_le_bytes(), &[16], &[7; 16]].concat()
    };
    let attachments =
        [Some(vec![]), Some(vec![1; 32]), None, Some(attachment(3)), Some(attachment(6))];
    for (sequence, attachment) in (0..).zip(attachments) {
        publisher.put(frame(sequence, 2).to_cdr()).attachment(attachment).wait().unwrap();
        expect_frame(&mut *subscriber, &frame(sequence, 2));
    }
    assert_eq!(subscriber.lost(), 2, "messages 4 and 5 of one publisher");
}

#[test]
fn a_topic_of_another_type_is_a_warning_with_both_types() {
    let (options, link) = (options(), link("zenoh"));
    let transports = Transports::new(options.clone());
    let _publisher = frames_publisher(&transports, &link, Reliability::Drop);
    let strings = Process::start("strings", &link, &options);
    let warning = strings.says("found message type");
    assert!(
        warning
            .contains(&format!("{link}: found message type eddy_msgs/msg/ParticleFrame (RIHS01_")),
        "{warning}"
    );
    assert!(warning.contains("expected std_msgs/msg/String (RIHS01_df668c74"), "{warning}");
}

#[test]
fn a_busy_port_is_reported() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port();
    let (mut options, link) = (options(), link("zenoh"));
    options.zenoh.overrides = format!(r#"listen/endpoints=["tcp/127.0.0.1:{port}"]"#);
    let message =
        Transports::new(options).subscriber(&link, ParticleFrame::TYPE).err().unwrap().to_string();
    assert!(message.starts_with(&format!("{link}: open the zenoh session")), "{message}");
    assert!(message.contains(&port.to_string()), "{message}");
}

#[test]
fn domains_do_not_mix() {
    let (options, link) = (options(), link("zenoh"));
    let mut other = options.clone();
    other.domain_id = 1;
    let (here, there) = (Transports::new(options), Transports::new(other));
    let mut same = frames_subscriber(&here, &link);
    let mut elsewhere = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("the subscriber of our domain is seen", || publisher.subscribers() == 1);
    publisher.publish_frame(&frame(0, 1)).unwrap();
    expect_frame(&mut *same, &frame(0, 1));
    assert_eq!(elsewhere.receive(Duration::from_millis(100)).unwrap(), None);
}

/// Each frame exactly once, in order, and nothing after the last.
fn exactly_once(publisher: &mut dyn Publisher, subscriber: &mut dyn Subscriber) {
    eventually("the subscriber is seen", || publisher.subscribers() == 1);
    for sequence in 0..50 {
        publisher.publish_frame(&frame(sequence, 2_500)).unwrap();
    }
    for sequence in 0..50 {
        assert_eq!(next_frame(subscriber).sequence, sequence);
    }
    assert_eq!(subscriber.receive(Duration::from_millis(200)).unwrap(), None);
    assert_eq!(subscriber.lost(), 0);
}

#[test]
fn frames_come_once_when_peers_meet_directly_and_through_a_router() {
    let (router, endpoint) = router();
    let (mut options, link) = (options(), link("zenoh"));
    options.zenoh.router = endpoint;
    let (here, there) = (Transports::new(options.clone()), Transports::new(options.clone()));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    eventually("both know the router", || router.info().peers_zid().wait().count() == 2);
    exactly_once(&mut *publisher, &mut *subscriber);
    // The router may disappear and return.
    router.close().wait().unwrap();
    publisher.publish_frame(&frame(50, 1)).unwrap();
    expect_frame(&mut *subscriber, &frame(50, 1));
}

#[test]
fn peers_that_know_only_a_router_exchange_frames_once() {
    let (_router, endpoint) = router();
    let (mut options, link) = (options(), link("zenoh"));
    // Like a ROS node with the settings of rmw_zenoh.
    options.zenoh.overrides = format!(r#"connect/endpoints=["{endpoint}"]"#);
    let (here, there) = (Transports::new(options.clone()), Transports::new(options));
    let mut subscriber = frames_subscriber(&there, &link);
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    exactly_once(&mut *publisher, &mut *subscriber);
}

#[test]
fn processes_beyond_the_port_range_find_each_other() {
    let (mut options, link) = (options(), link("zenoh"));
    let only = *options.zenoh.ports.start();
    options.zenoh.ports = only..=only;
    let [first, second, third] = [(); 3].map(|()| Transports::new(options.clone()));
    let _holds_the_port = frames_subscriber(&first, &link.with_topic("/elsewhere"));
    let mut subscriber = frames_subscriber(&second, &link);
    let mut publisher = frames_publisher(&third, &link, Reliability::Block);
    exactly_once(&mut *publisher, &mut *subscriber);
}

/// Prints with `--nocapture` the time from the start of a process to its first frame.
#[test]
fn processes_find_each_other_without_a_router_in_any_order_and_again_after_a_kill() {
    let (options, link) = (options(), link("zenoh"));
    // The publisher starts first and takes the first port; this process takes the second and connects to it.
    let publisher = Process::start("publish", &link, &options);
    publisher.says("ready");
    let transports = Transports::new(options.clone());
    let start = Instant::now();
    let mut subscriber = frames_subscriber(&transports, &link);
    next_frame(&mut *subscriber);
    println!("a subscriber that starts later: {:?}", start.elapsed());
    publisher.kill();
    // Restarted, it takes the same port, to which this process keeps connecting.
    for _ in 0..3 {
        while subscriber.receive(Duration::ZERO).unwrap().is_some() {}
        let start = Instant::now();
        let publisher = Process::start("publish", &link, &options);
        next_frame(&mut *subscriber);
        let found = start.elapsed();
        println!("a publisher that was killed and started again: {found:?}");
        assert!(found < Duration::from_secs(10), "{found:?}");
        publisher.kill();
    }
}

#[test]
fn a_stopped_subscriber_is_disconnected_and_the_others_go_on() {
    const FRAMES: u64 = 1_000;
    let (mut options, link) = (options(), link("zenoh"));
    options.patience = Duration::from_secs(1);
    let [here, there] = ends("zenoh", options.clone());
    let mut publisher = frames_publisher(&here, &link, Reliability::Block);
    let mut reader = frames_subscriber(&there, &link);
    let stopped = Process::start("stall", &link, &options);
    stopped.says("ready");
    eventually("both are seen", || publisher.subscribers() == 2);
    publisher.publish_frame(&frame(0, 2_500)).unwrap();
    stopped.says("frame 0");
    stopped.pause();
    let start = Instant::now();
    let (mut missed, mut next, mut lost) = (Vec::new(), 0, Vec::new());
    for sequence in 1..FRAMES {
        missed.extend(publisher.publish_frame(&frame(sequence, 2_500)).err());
        // The publisher is ahead by the messages in its queue at most.
        while next + 8 <= sequence {
            let found = next_frame(&mut *reader).sequence;
            lost.extend(next..found);
            next = found + 1;
        }
    }
    // The message at which Zenoh closes the connection does not always reach the other peers.
    assert!(lost.len() <= 1, "{lost:?}");
    // Waited for once; a second message may meet the connection while it is being closed.
    assert!((1..=2).contains(&missed.len()), "{missed:?}");
    let message = missed[0].to_string();
    assert!(
        message.starts_with(&format!("{link}: a subscriber has read nothing for 1 s")),
        "{message}"
    );
    assert!(start.elapsed() < DEADLINE, "{:?}", start.elapsed());
}
