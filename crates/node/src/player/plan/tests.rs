use std::path::Path;

use super::*;
use crate::ros::RosArguments;
use eddy_bag::{BagWriter, Schema, WriterOptions};
use eddy_frames::Stamp;
use eddy_messages::{Clock, Message, RosString};

const INT32: &str = "std_msgs/msg/Int32";
const POINT: &str = "acme_msgs/msg/Point";

/// A channel with a definition, or with the name of its type only, and without a type hash.
fn channel(topic: &str, type_name: &str, definition: Option<&str>) -> Arc<Channel> {
    let schema = Schema {
        name: type_name.to_owned(),
        encoding: definition.map_or("", |_| "ros2msg").to_owned(),
        data: definition.unwrap_or_default().as_bytes().to_vec(),
    };
    Arc::new(Channel {
        topic: topic.to_owned(),
        schema: Some(Arc::new(schema)),
        encoding: "cdr".to_owned(),
        metadata: BTreeMap::new(),
    })
}

/// A bag with a message on each channel.
fn bag(folder: &Path, channels: &[Arc<Channel>]) -> BagReader {
    let mut bag = BagWriter::create(&folder.join("bag"), WriterOptions::default()).unwrap();
    for (channel, time) in channels.iter().zip(1..) {
        let topic = bag.channel(channel).unwrap();
        bag.write(topic, Stamp(time), Stamp(time), &[0, 1, 0, 0, 1]).unwrap();
    }
    bag.finish().unwrap();
    BagReader::open(&folder.join("bag")).unwrap()
}

fn options(transport: TransportKind) -> OutputOptions {
    OutputOptions {
        transport,
        topics: Vec::new(),
        remap: Vec::new(),
        clock: false,
        reliability: Reliability::Block,
        overrides: QosOverrides::new(),
    }
}

/// What is planned for a bag with these channels, and what is left out.
fn planned(
    channels: &[Arc<Channel>],
    options: &OutputOptions,
) -> Result<(Vec<String>, Vec<String>), PlanError> {
    let folder = tempfile::tempdir().unwrap();
    let bag = bag(folder.path(), channels);
    let plan = PlaybackPlan::new(&bag, &RosArguments::default().node("plan"), options)?;
    let shown = |topic: &PlannedTopic| format!("{} on {}", topic.support.name, topic.link);
    Ok((plan.topics.iter().map(shown).collect(), plan.left_out))
}

const ALL: [TransportKind; 4] =
    [TransportKind::Memory, TransportKind::Shm, TransportKind::Zenoh, TransportKind::Dds];

/// A clock, words, and messages of types that are not built in: with a definition, without, and without fields.
fn usual() -> [Arc<Channel>; 5] {
    [
        channel(CLOCK, Clock::TYPE, None),
        channel("/point", POINT, Some("float64 x")),
        channel("/raw", "acme_msgs/msg/Raw", None),
        channel("/tick", "acme_msgs/msg/Tick", Some("")),
        channel("/words", RosString::TYPE, Some("string data")),
    ]
}

fn links(planned: &[String]) -> Vec<&str> {
    planned.iter().map(|topic| topic.split(" on ").nth(1).unwrap()).collect()
}

#[test]
fn topics_that_cannot_be_carried_are_left_out_unless_they_were_named() {
    for transport in [TransportKind::Shm, TransportKind::Dds] {
        let (topics, left_out) = planned(&usual(), &options(transport)).unwrap();
        let all = [CLOCK, "/point", "/raw", "/tick", "/words"];
        assert_eq!(links(&topics), all.map(|topic| format!("{transport}:{topic}")));
        assert_eq!(left_out, [""; 0]);
    }
    let zenoh = options(TransportKind::Zenoh);
    let (topics, left_out) = planned(&usual(), &zenoh).unwrap();
    let all = [CLOCK, "/point", "/tick", "/words"];
    assert_eq!(links(&topics), all.map(|topic| format!("zenoh:{topic}")));
    let expected = "topic /raw: zenoh needs the type hash of acme_msgs/msg/Raw, which the bag lacks; the bag has no";
    assert!(left_out.len() == 1 && left_out[0].starts_with(expected), "{left_out:?}");
    let named = OutputOptions { topics: vec!["/raw".to_owned()], ..zenoh };
    let message = planned(&usual(), &named).unwrap_err().to_string();
    assert!(message.starts_with(expected), "{message}");
}

#[test]
fn a_type_hash_that_the_bag_lacks_is_that_of_its_definition() {
    let folder = tempfile::tempdir().unwrap();
    let bag = bag(folder.path(), &usual());
    for (name, definition) in [("/point", "float64 x"), ("/tick", "")] {
        let topic = bag.topics().iter().find(|topic| topic.name == name).unwrap();
        let support = support(topic, TransportKind::Zenoh).unwrap();
        let expected = TypeSupport::from_schema(&topic.type_name, definition).unwrap().hash;
        assert_eq!(support.hash, expected);
    }
}

#[test]
fn a_new_clock_replaces_the_recorded_one() {
    let with_clock = OutputOptions { clock: true, ..options(TransportKind::Memory) };
    let (topics, left_out) = planned(&usual(), &with_clock).unwrap();
    assert!(!links(&topics).contains(&"memory:/clock"), "{topics:?}");
    assert_eq!((topics.len(), left_out.len()), (4, 0));
}

#[test]
fn rules_that_cannot_be_applied_are_named() {
    for (rule, expected) in [
        ("/words", "--remap: found `/words`, expected FROM:=TO"),
        (
            "/word:=/a",
            "--remap: found topic `/word`, expected one of /clock, /point, /raw, /tick, /words",
        ),
        ("/words:=/a b", "link topic: found `/a b`"),
    ] {
        let options =
            OutputOptions { remap: vec![rule.to_owned()], ..options(TransportKind::Memory) };
        let message = planned(&usual(), &options).unwrap_err().to_string();
        assert!(message.starts_with(expected), "{message}");
    }
}

#[test]
fn names_that_ros_does_not_allow_are_changed_to_similar_ones() {
    for (name, expected) in [
        ("/camera-front/image", "/camera_front/image"),
        ("/9lives", "/_9lives"),
        ("particles", "/particles"),
        ("/a//b/", "/a/b"),
        ("/caf\u{e9} \u{1b}[31m", "/caf____31m"),
        ("", "/unnamed"),
        ("/", "/unnamed"),
    ] {
        assert_eq!(allowed_name(name), expected);
        assert!(is_absolute_name(expected), "{expected}");
        let channels = [channel(name, RosString::TYPE, None), channel("/other", INT32, None)];
        for transport in ALL {
            let (topics, left_out) = planned(&channels, &options(transport)).unwrap();
            let link = format!("{transport}:{expected}");
            assert!(links(&topics).contains(&link.as_str()), "{topics:?}");
            assert_eq!((topics.len(), left_out.len()), (2, 0));
        }
    }
    let rule = "/a-b:=/c".to_owned();
    let renamed = OutputOptions { remap: vec![rule], ..options(TransportKind::Shm) };
    let (topics, _) = planned(&[channel("/a-b", INT32, None)], &renamed).unwrap();
    assert_eq!(links(&topics), ["shm:/c"]);
}

#[test]
fn a_topic_whose_changed_name_another_one_has_is_left_out() {
    let odd = |name| channel(name, RosString::TYPE, None);
    for transport in ALL {
        let link = format!("{transport}:/a_b");
        let allowed = channel("/a_b", INT32, None);
        for (channels, expected) in [
            ([odd("/a-b"), allowed.clone()], format!("{INT32} on {link}")),
            ([odd("/a_b/"), allowed], format!("{INT32} on {link}")),
            ([odd("/a+b"), odd("/a-b")], format!("{} on {link}", RosString::TYPE)),
        ] {
            let (topics, left_out) = planned(&channels, &options(transport)).unwrap();
            assert_eq!(topics, [expected], "{left_out:?}");
            assert!(left_out.len() == 1 && left_out[0].contains("expected a free name"));
        }
    }
}

#[test]
fn two_types_on_a_topic_are_published_apart_where_a_topic_has_one_type() {
    let channels = [channel("/t", RosString::TYPE, None), channel("/t", INT32, None)];
    for transport in ALL {
        let (topics, left_out) = planned(&channels, &options(transport)).unwrap();
        let beside = if transport.is_of_ros() { "/t" } else { "/t/std_msgs/String" };
        let expected = ["/t", beside].map(|topic| format!("{transport}:{topic}"));
        assert_eq!(links(&topics), expected, "{topics:?}");
        assert_eq!(left_out, [""; 0]);
    }
    let taken = [channels.as_slice(), &[channel("/t/std_msgs/String", INT32, None)]].concat();
    let (topics, left_out) = planned(&taken, &options(TransportKind::Shm)).unwrap();
    assert_eq!(links(&topics), ["shm:/t", "shm:/t/std_msgs/String"]);
    assert_eq!(left_out.len(), 1, "{left_out:?}");
}

#[test]
fn versions_of_a_type_are_published_apart_where_they_are_told_apart() {
    let channels = ["float64 x", "float64 x\nfloat64 y", "float64 x # (m)"]
        .map(|definition| channel("/p", POINT, Some(definition)));
    let folder = tempfile::tempdir().unwrap();
    let bag = bag(folder.path(), &channels);
    let ros = RosArguments::default().node("plan");
    for transport in ALL {
        let plan = PlaybackPlan::new(&bag, &ros, &options(transport)).unwrap();
        let apart = transport == TransportKind::Zenoh;
        assert_eq!(plan.topics.len(), if apart { 2 } else { 1 }, "{transport}");
        let channels: usize = plan.topics.iter().map(|topic| topic.channels.len()).sum();
        assert_eq!(channels, 3, "a comment makes no version");
        if apart {
            let hashes: Vec<_> = plan.topics.iter().map(|topic| &topic.support.hash).collect();
            assert_ne!(hashes[0], hashes[1]);
        }
    }
}
