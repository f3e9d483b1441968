//! `eddy record` as its users run it: which topics it finds, how it splits, what it loses.

use std::{
    fs,
    path::Path,
    process::Command,
    thread,
    time::{Duration, Instant},
};

use eddy_bag::BagReader;
use eddy_frames::clock;
use eddy_messages::{
    Message, PredictionStatus, QosProfile, RosString, TypeSupport, cdr,
    qos::{HistoryPolicy, ReliabilityPolicy},
    type_support,
};
use eddy_transport::{Publisher, PublisherOptions, Reliability};
use iceoryx2::prelude::{NodeBuilder, ipc};

use crate::support::{
    DEADLINE, Process, World, domain, eddy, fail, findings, latched, succeed, talking_eddy,
    wait_for, word,
};

/// How the recorder is started.
trait Recording {
    fn record(&self, arguments: &[&str]) -> Command;
    fn record_words(&self, arguments: &[&str]) -> Command;
}

impl Recording for World {
    fn record(&self, arguments: &[&str]) -> Command {
        let mut command = talking_eddy();
        command.env("ZENOH_CONFIG_OVERRIDE", &self.overrides);
        command.env("ROS_DOMAIN_ID", self.domain.to_string());
        command.args(["--quiet", "record", "--output", self.bag().to_str().unwrap()]);
        command.args(arguments);
        command
    }

    /// Records the words on one topic of shared memory; not an explicit link, since that is for the
    /// types that the names of topics tell.
    fn record_words(&self, arguments: &[&str]) -> Command {
        let regex = format!("^{}/words$", self.prefix);
        self.record(&[&["--regex", &regex, "--from", "shm"], arguments].concat())
    }
}

fn wait_for_a_subscriber(publisher: &dyn Publisher) {
    wait_for("the recorder listens", || (publisher.subscribers() > 0).then_some(()));
}

fn terminate(process: &Process) {
    let id = process.id().to_string();
    assert!(Command::new("kill").args(["-TERM", &id]).status().unwrap().success());
}

#[test]
fn what_was_kept_is_recorded_with_how_much_its_publisher_keeps() {
    let world = World::new("record");
    let (link, words) = (world.link("zenoh", "latched"), type_support(RosString::TYPE).unwrap());
    let latched = latched(2);
    let mut publisher = world
        .transports
        .publisher(
            &link,
            words,
            PublisherOptions { reliability: Reliability::Block, qos: Some(latched) },
        )
        .unwrap();
    for text in ["zero", "one", "two"] {
        publisher.publish_cdr(&word(text)).unwrap();
    }
    let mut recorder = Process::start(&mut world.record(&[
        "--regex",
        &format!("^{}/", world.prefix),
        "--from",
        "zenoh",
        "--max-messages",
        "2",
    ]));
    assert!(recorder.wait().success());
    let bag = BagReader::open(&world.bag()).unwrap();
    assert_eq!(bag.topics()[0].offered, [latched]);
    let recorded: Vec<_> = bag.messages().map(|message| message.unwrap().data).collect();
    assert_eq!(recorded, [word("one"), word("two")]);
}

#[test]
fn given_custom_data_is_in_the_bag_and_in_copies_and_shown() {
    let world = World::new("record");
    let publisher = world.publisher("zenoh", "words", RosString::TYPE);
    let mut recorder = Process::start(&mut world.record(&[
        &format!("zenoh:{}/words", world.prefix),
        "--max-messages",
        "1",
        "--custom-data",
        "eddy_stiffness=1e5",
        "robot=arm=3",
    ]));
    wait_for_a_subscriber(&*publisher);
    let mut publisher = publisher;
    publisher.publish_cdr(&word("one")).unwrap();
    assert!(recorder.wait().success());
    let recorded = world.bag();
    let shown = |bag: &Path| {
        let bag = bag.to_str().unwrap();
        let json = succeed(["bag", "info", bag, "--json"]);
        let info: serde_json::Value = serde_json::from_str(&json).unwrap();
        (succeed(["bag", "info", bag]), info["custom_data"].to_string())
    };
    let (text, entries) = shown(&recorded);
    assert!(text.contains("custom data  robot: arm=3\n"), "{text}");
    assert_eq!(entries, r#"{"eddy_stiffness":"1e5","robot":"arm=3"}"#);

    let [recorded, softer] = [recorded, world.bag().with_extension("softer")];
    let [from, to] = [&recorded, &softer].map(|bag| bag.to_str().unwrap());
    let stated = ["--custom-data", "eddy_stiffness=1e3"];
    succeed([&["bag", "cut", from, "--output", to], &stated[..]].concat());
    assert_eq!(shown(&softer).1, r#"{"eddy_stiffness":"1e3","robot":"arm=3"}"#);
    let soft = ["bag", "recover", from, "--output", "no", "--custom-data", "eddy_stiffness=soft"];
    assert!(fail(2, soft).contains("found eddy_stiffness=soft, expected a positive number"));
    let both = world.bag().with_extension("both");
    let said = succeed(["bag", "merge", from, to, "--output", both.to_str().unwrap()]);
    let expected = "not kept, since not all bags have the same: custom data eddy_stiffness\n";
    assert!(said.contains(expected), "{said}");
    assert_eq!(shown(&both).1, r#"{"robot":"arm=3"}"#);
}

#[test]
fn quality_of_service_is_recorded_as_offered_and_kept_messages_are_received() {
    let best_effort = QosProfile {
        reliability: ReliabilityPolicy::BestEffort,
        history: HistoryPolicy::KeepLast(5),
        ..QosProfile::default()
    };
    let keep_all = QosProfile { history: HistoryPolicy::KeepAll, ..QosProfile::default() };
    let profiles = [best_effort, keep_all, latched(1)];
    for transport in ["zenoh", "dds"] {
        let world = World::in_domain("record", domain());
        let words = type_support(RosString::TYPE).unwrap();
        let mut publishers =
            [("a", profiles[0]), ("b", profiles[1]), ("c", profiles[2])].map(|(name, offered)| {
                let link = world.link(transport, name);
                let block = Reliability::Block;
                world
                    .transports
                    .publisher(
                        &link,
                        words,
                        PublisherOptions { reliability: block, qos: Some(offered) },
                    )
                    .unwrap()
            });
        publishers[2].publish_cdr(&word("old")).unwrap();
        let pattern = format!("^{}/", world.prefix);
        let mut recorder = Process::start(&mut world.record(&[
            "-e",
            &pattern,
            "--from",
            transport,
            "--max-messages",
            "3",
        ]));
        for publisher in &mut publishers[..2] {
            wait_for_a_subscriber(&**publisher);
            publisher.publish_cdr(&word("new")).unwrap();
        }
        assert!(recorder.wait().success());
        let bag = BagReader::open(&world.bag()).unwrap();
        let mut recorded: Vec<_> = bag.messages().map(|message| message.unwrap().data).collect();
        recorded.sort();
        assert_eq!(recorded, [word("new"), word("new"), word("old")], "{transport}");
        let offered: Vec<_> = bag.topics().iter().map(|topic| topic.offered.clone()).collect();
        let announced = |profile: QosProfile| match transport {
            // Discovery has no history.
            "dds" => QosProfile { history: HistoryPolicy::Unknown, ..profile },
            _ => profile,
        };
        assert_eq!(offered, profiles.map(|profile| vec![announced(profile)]), "{transport}");
    }
}

#[test]
fn a_link_is_recorded_with_the_type_that_its_publisher_announces() {
    for transport in ["zenoh", "dds", "shm"] {
        let world = World::in_domain("record", domain());
        let mut publisher = world.words(transport, "speech");
        let link = world.link(transport, "speech").to_string();
        let mut recorder = Process::start(&mut world.record(&[&link, "--max-messages", "1"]));
        wait_for_a_subscriber(&*publisher);
        publisher.publish_cdr(&word("eddy")).unwrap();
        assert!(recorder.wait().success());
        let bag = BagReader::open(&world.bag()).unwrap();
        assert_eq!(bag.topics()[0].type_name, RosString::TYPE, "{transport}");
        assert_eq!(findings(&world.bag()), [""; 0]);
    }
}

#[test]
fn a_recorder_that_is_first_waits_for_the_publisher_and_has_its_type_and_quality_of_service() {
    for transport in ["zenoh", "dds", "shm"] {
        let world = World::in_domain("record", domain());
        // Its name promises nothing.
        let link = world.link(transport, "robot_description");
        let mut recorder =
            Process::start(&mut world.record(&[&link.to_string(), "--max-messages", "3"]));
        recorder.line(&format!("waiting for {link}, which is not published yet"));
        let (block, words) = (Reliability::Block, type_support(RosString::TYPE).unwrap());
        let mut publisher = world
            .transports
            .publisher(&link, words, PublisherOptions { reliability: block, qos: Some(latched(1)) })
            .unwrap();
        wait_for_a_subscriber(&*publisher);
        for text in ["one", "two", "three"] {
            publisher.publish_cdr(&word(text)).unwrap();
        }
        assert!(recorder.wait().success(), "{transport}");
        let bag = BagReader::open(&world.bag()).unwrap();
        let topic = &bag.topics()[0];
        assert_eq!((topic.type_name.as_str(), topic.message_count), (RosString::TYPE, 3));
        assert!(topic.has_definition());
        let expected = match transport {
            // Discovery has no history, and shared memory no quality of service.
            "dds" => QosProfile { history: HistoryPolicy::Unknown, ..latched(1) },
            "shm" => QosProfile::default(),
            _ => latched(1),
        };
        assert_eq!(topic.offered, [expected], "{transport}");
    }
}

#[test]
fn a_link_that_nobody_publishes_is_named_and_not_in_the_bag() {
    for transport in ["zenoh", "dds", "shm"] {
        let world = World::in_domain("record", domain());
        let mut publisher = world.words(transport, "words");
        let [nothing, words] = ["nothing", "words"].map(|name| world.link(transport, name));
        let mut recorder =
            Process::start(&mut world.record(&[&nothing.to_string(), &words.to_string()]));
        recorder.line(&format!("waiting for {nothing}, "));
        wait_for_a_subscriber(&*publisher);
        publisher.publish_cdr(&word("one")).unwrap();
        recorder.interrupt();
        assert_eq!(recorder.wait().code(), Some(1), "{transport}");
        let said = recorder.rest();
        assert!(said.contains(&format!("not recorded: {nothing}: not published\n")), "{said}");
        let bag = BagReader::open(&world.bag()).unwrap();
        let topics: Vec<_> = bag.topics().iter().map(|topic| topic.name.clone()).collect();
        assert_eq!((topics, bag.message_count()), (vec![world.topic("words")], 1));
        let metadata = fs::read_to_string(world.bag().join("metadata.yaml")).unwrap();
        let is_named = metadata.lines().any(|line| {
            line.contains("eddy_topics_not_recorded") && line.contains(&nothing.to_string())
        });
        assert!(is_named, "{metadata}");
    }
}

#[test]
fn a_search_that_finds_nothing_says_so_in_its_exit_code() {
    let world = World::new("record");
    let pattern = format!("^{}/", world.prefix);
    let log = tempfile::NamedTempFile::new().unwrap();
    let mut command = world.record(&["--regex", &pattern, "--from", "shm", "--stop-after", "0.5"]);
    command.stderr(log.reopen().unwrap());
    assert_eq!(Process::start(&mut command).wait().code(), Some(1));
    let said = fs::read_to_string(log.path()).unwrap();
    assert!(said.contains("found no topic to record on shm; --from selects"), "{said}");
}

#[test]
fn the_default_transport_is_the_one_that_is_searched() {
    let world = World::in_domain("record", domain());
    let mut publisher = world.words("dds", "words");
    let pattern = format!("^{}/", world.prefix);
    let mut command = world.record(&["--regex", &pattern, "--max-messages", "1"]);
    let mut recorder = Process::start(command.env("EDDY_TRANSPORT", "dds"));
    wait_for_a_subscriber(&*publisher);
    publisher.publish_cdr(&word("one")).unwrap();
    assert!(recorder.wait().success());
}

/// Nobody answers for the definition, which is asked for a few seconds; a subscriber of zenoh has room for 64 messages.
#[test]
fn no_message_is_lost_while_the_definition_is_looked_for() {
    let world = World::new("record");
    let foreign = TypeSupport::foreign("acme_msgs/msg/Imu", &format!("RIHS01_{}", "3".repeat(64)));
    let link = world.link("zenoh", "imu");
    let arguments = [link.to_string(), "--max-messages".to_owned(), "1000".to_owned()];
    let mut recorder = Process::start(&mut world.record(&arguments.each_ref().map(String::as_str)));
    let mut publisher = world.transports.publisher(&link, &foreign, Reliability::Drop).unwrap();
    wait_for_a_subscriber(&*publisher);
    let before = clock::wall();
    for number in 0..1_000_u16 {
        let [low, high] = number.to_le_bytes();
        publisher.publish_cdr(&[0, 1, 0, 0, low, high]).unwrap();
        thread::sleep(Duration::from_millis(1));
    }
    let after = clock::wall();
    assert_eq!(recorder.wait().code(), Some(1), "no definition was found");
    let bag = BagReader::open(&world.bag()).unwrap();
    let messages: Vec<_> = bag.messages().map(Result::unwrap).collect();
    assert_eq!(messages.len(), 1_000);
    for (number, message) in (0..1_000_u16).zip(&messages) {
        assert_eq!(message.data[4..], number.to_le_bytes());
    }
    // Times of arrival, not of the end of the search.
    let [first, last] = [&messages[0], &messages[999]].map(|message| message.log_time);
    assert!(before <= first && last.0 - first.0 >= 500_000_000, "{before:?} {first:?} {last:?}");
    assert!(last.0 - after.0 < 1_000_000_000, "{after:?} {last:?}");
}

#[test]
fn another_type_on_a_recorded_topic_is_named() {
    let world = World::new("record");
    let mut words = world.words("zenoh", "topic");
    let pattern = format!("^{}/", world.prefix);
    let log = tempfile::NamedTempFile::new().unwrap();
    let mut command = world.record(&["--regex", &pattern, "--from", "zenoh"]);
    let mut recorder = Process::start(command.stderr(log.reopen().unwrap()));
    wait_for_a_subscriber(&*words);
    words.publish_cdr(&word("one")).unwrap();
    let _numbers = world.publisher("zenoh", "topic", "std_msgs/msg/Int32");
    let warned = "), recorded is std_msgs/msg/String (RIHS01_";
    wait_for("the other type is found", || {
        fs::read_to_string(log.path()).unwrap().contains(warned).then_some(())
    });
    recorder.interrupt();
    assert_eq!(recorder.wait().code(), Some(1));
    let said = recorder.rest();
    let expected = format!("not recorded: zenoh:{}(std_msgs/msg/Int32): ", world.topic("topic"));
    assert!(said.contains(&expected), "{said}");
    assert_eq!(BagReader::open(&world.bag()).unwrap().message_count(), 1);
}

#[test]
fn a_bag_that_is_being_recorded_is_not_replaced() {
    let world = World::new("record");
    let mut publisher = world.words("shm", "words");
    let mut recorder = Process::start(&mut world.record_words(&["--force"]));
    wait_for_a_subscriber(&*publisher);
    publisher.publish_cdr(&word("one")).unwrap();
    let (bag, link) = (world.bag(), world.link("shm", "words").to_string());
    let bag = bag.to_str().unwrap();
    let message = fail(1, ["record", &link, "--output", bag, "--force"]);
    assert!(message.contains("another process is writing"), "{message}");
    // So is every other command.
    let message = fail(1, ["bag", "cut", "bags/sample", "--output", bag, "--force"]);
    assert!(message.contains("another process is writing"), "{message}");
    publisher.publish_cdr(&word("two")).unwrap();
    recorder.interrupt();
    assert!(recorder.wait().success());
    assert_eq!(BagReader::open(&world.bag()).unwrap().message_count(), 2);
    assert_eq!(findings(&world.bag()), [""; 0]);
    // That of a killed recorder is.
    let mut killed = Process::start(&mut world.record_words(&["--force"]));
    killed.line("recording shm:");
    killed.kill();
    let mut recorder = Process::start(&mut world.record_words(&["--force", "--max-messages", "1"]));
    // The publisher may still count the killed one.
    recorder.line("recording shm:");
    publisher.publish_cdr(&word("three")).unwrap();
    assert!(recorder.wait().success());
    assert_eq!(BagReader::open(&world.bag()).unwrap().message_count(), 1);
}

#[test]
fn a_type_without_a_definition_is_named_and_its_schema_has_only_its_name() {
    let world = World::new("record");
    let foreign = TypeSupport::foreign("acme_msgs/msg/Imu", "");
    let link = world.link("shm", "imu");
    let mut publisher = world.transports.publisher(&link, &foreign, Reliability::Block).unwrap();
    let pattern = format!("^{}/", world.prefix);
    let arguments = ["-e", &pattern, "--from", "shm", "--max-messages", "1"];
    let mut recorder = Process::start(&mut world.record(&arguments));
    wait_for_a_subscriber(&*publisher);
    publisher.publish_cdr(&[0, 1, 0, 0, 42]).unwrap();
    assert_eq!(recorder.wait().code(), Some(1));
    let topic = world.topic("imu");
    let expected = format!("no definition: {topic} (acme_msgs/msg/Imu)\n");
    assert!(recorder.rest().contains(&expected));
    assert!(succeed(["bag", "info", world.bag().to_str().unwrap()]).contains(&expected));
    let bag = BagReader::open(&world.bag()).unwrap();
    let schema = bag.channels()[0].schema.clone().unwrap();
    assert_eq!(schema.name, "acme_msgs/msg/Imu");
    assert_eq!((schema.encoding.as_str(), schema.data.as_slice()), ("", &[][..]));
}

#[test]
fn everything_that_is_published_is_found_also_later_and_of_types_nobody_knows_here() {
    let world = World::new("record");
    let mut early = world.words("zenoh", "early");
    let arguments = ["--all", "--exclude", "secret", "--from", "zenoh", "--max-messages", "2"];
    let mut recorder = Process::start(&mut world.record(&arguments));
    wait_for_a_subscriber(&*early);
    early.publish_cdr(&word("early")).unwrap();

    let hash = format!("RIHS01_{}", "5".repeat(64));
    let foreign = TypeSupport::foreign("acme_msgs/msg/Imu", &hash);
    let link = world.link("zenoh", "imu");
    let mut later = world.transports.publisher(&link, &foreign, Reliability::Block).unwrap();
    let secret = world.words("zenoh", "secret");
    wait_for_a_subscriber(&*later);
    later.publish_cdr(&[0, 1, 0, 0, 42]).unwrap();
    assert_eq!(secret.subscribers(), 0);
    // Nobody tells the definition.
    assert_eq!(recorder.wait().code(), Some(1));

    let bag = BagReader::open(&world.bag()).unwrap();
    let topics: Vec<_> = bag
        .topics()
        .iter()
        .map(|topic| (topic.name.strip_prefix(&world.prefix).unwrap(), topic.type_name.as_str()))
        .collect();
    assert_eq!(topics, [("/early", RosString::TYPE), ("/imu", "acme_msgs/msg/Imu")]);
    assert_eq!(bag.topics()[0].hash, Some(type_support(RosString::TYPE).unwrap().hash.clone()));
    assert_eq!(bag.topics()[1].hash, Some(hash));
    let data: Vec<_> = bag.messages().map(|message| message.unwrap().data).collect();
    assert_eq!(data, [word("early"), vec![0, 1, 0, 0, 42]]);
    assert_eq!(findings(&world.bag()), [""; 0]);
}

#[test]
fn several_transports_are_recorded_at_once_by_pattern() {
    let world = World::new("record");
    let pattern = format!("^{}/", world.prefix);
    let mut publishers = [world.words("zenoh", "a"), world.words("shm", "b")];
    let mut recorder = Process::start(&mut world.record(&["-e", &pattern, "--max-messages", "20"]));
    publishers.iter().for_each(|publisher| wait_for_a_subscriber(&**publisher));
    for number in 0..10 {
        for publisher in &mut publishers {
            publisher.publish_cdr(&word(&number.to_string())).unwrap();
        }
    }
    assert!(recorder.wait().success());
    let bag = BagReader::open(&world.bag()).unwrap();
    let counts: Vec<_> = bag.topics().iter().map(|topic| topic.message_count).collect();
    assert_eq!(counts, [10, 10]);
}

#[test]
fn a_long_recording_is_split_and_its_files_are_one_bag() {
    let world = World::new("record");
    let mut publisher = world.words("shm", "words");
    let arguments = ["--max-bag-size", "20000", "--compression", "none", "--max-messages", "100"];
    let mut recorder = Process::start(&mut world.record_words(&arguments));
    wait_for_a_subscriber(&*publisher);
    for number in 0..100 {
        publisher.publish_cdr(&word(&format!("{number:01000}"))).unwrap();
    }
    assert!(recorder.wait().success());
    let bag = BagReader::open(&world.bag()).unwrap();
    assert_eq!((bag.files().count(), bag.message_count()), (6, 100));
    assert!(bag.files().all(|file| fs::metadata(file).unwrap().len() < 25_000));
    assert_eq!(findings(&world.bag()), [""; 0]);
}

#[test]
fn a_recorder_that_is_asked_to_end_has_everything() {
    let world = World::new("record");
    let mut publisher = world.words("shm", "words");
    let mut recorder = Process::start(&mut world.record_words(&[]));
    wait_for_a_subscriber(&*publisher);
    for number in 0..300 {
        publisher.publish_cdr(&word(&number.to_string())).unwrap();
    }
    terminate(&recorder);
    assert!(recorder.wait().success());
    assert_eq!(BagReader::open(&world.bag()).unwrap().message_count(), 300);
    assert!(fs::read_to_string(world.bag().join("metadata.yaml")).unwrap().contains("version: 9"));
}

#[test]
fn a_killed_recorder_loses_at_most_a_second_and_recover_saves_the_rest() {
    let world = World::new("record");
    let mut publisher = world.words("shm", "words");
    let recorder = Process::start(&mut world.record_words(&[]));
    wait_for_a_subscriber(&*publisher);
    let start = Instant::now();
    let mut published = Vec::new();
    while start.elapsed() < Duration::from_secs(3) {
        publisher.publish_cdr(&word(&published.len().to_string())).unwrap();
        published.push(clock::wall());
        thread::sleep(Duration::from_millis(5));
    }
    let killed = clock::wall();
    recorder.kill();

    let saved = world.folder.path().join("saved");
    let output = eddy()
        .args(["bag", "recover", world.bag().to_str().unwrap(), "-o", saved.to_str().unwrap()])
        .output()
        .unwrap();
    let said = String::from_utf8_lossy(&output.stdout);
    // Lossy only if the kill cut a chunk.
    assert!(matches!(output.status.code(), Some(0 | 3)), "{said}");
    assert_eq!(findings(&saved), [""; 0]);
    let bag = BagReader::open(&saved).unwrap();
    for (number, message) in bag.messages().enumerate() {
        assert_eq!(message.unwrap().data, word(&number.to_string()));
    }
    let first_lost = published.get(bag.message_count() as usize).copied().unwrap_or(killed);
    // A machine that kept the publisher waiting may have kept the recorder waiting as well.
    let gaps = published.windows(2).map(|two| two[1].0 - two[0].0);
    let longest = gaps.max().unwrap_or(0).max(killed.0 - published.last().map_or(0, |last| last.0));
    let lost = (killed.0 - first_lost.0 - longest) as f64 / 1e9;
    assert!(lost <= 1.0, "{lost} s were lost");
}

/// The limit on the size of a file stands for a full disk: both refuse a write in its middle.
#[test]
fn a_recorder_without_room_closes_a_readable_bag_and_says_so() {
    let world = World::new("record");
    let mut publisher = world.words("shm", "words");
    let inner = world.record_words(&["--compression", "none"]);
    let mut command = Command::new("sh");
    // At most 8 MiB, or half of that, as the shell counts.
    command.args(["-c", "ulimit -f 8192; exec \"$@\" 2>&1", "sh"]).arg(inner.get_program());
    command.args(inner.get_args());
    let mut recorder = Process::start(&mut command);
    wait_for_a_subscriber(&*publisher);
    let start = Instant::now();
    let mut published = 0;
    // Until nobody takes it any more.
    while recorder.is_running() && start.elapsed() < DEADLINE {
        publisher.publish_cdr(&word(&format!("{published:010000}"))).unwrap();
        published += 1;
        thread::sleep(Duration::from_millis(2));
    }
    assert_eq!(recorder.wait().code(), Some(1));
    let said = recorder.rest();
    assert!(said.contains("disk full: the bag was closed with"), "{said}");

    assert_eq!(findings(&world.bag()), [""; 0]);
    let bag = BagReader::open(&world.bag()).unwrap();
    assert!(!bag.is_unfinished());
    let metadata = fs::read_to_string(world.bag().join("metadata.yaml")).unwrap();
    let count = format!("  message_count: {}\n", bag.message_count());
    assert_eq!(
        metadata.matches(&count).count(),
        3,
        "of the bag, the topic and the file: {metadata}"
    );
    // Three of the four mebibytes at least.
    assert!(bag.message_count() > 300, "{}", bag.message_count());
    for (number, message) in bag.messages().enumerate() {
        assert_eq!(message.unwrap().data, word(&format!("{number:010000}")));
    }
    succeed(["bag", "check", world.bag().to_str().unwrap()]);
}

/// What is in the bag and what is counted as lost make up all that was published, but for what the topic
/// itself still holds when nobody listens any more.
fn all_is_counted_on_a_full_disk(pause: Duration) {
    let world = World::new("record");
    let mut publisher = world.words("shm", "words");
    let inner = world.record_words(&["--compression", "none"]);
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -f 4096; exec \"$@\" 2>&1", "sh"]).arg(inner.get_program());
    command.args(inner.get_args());
    let mut recorder = Process::start(&mut command);
    wait_for_a_subscriber(&*publisher);
    let mut published = 0;
    while recorder.is_running() && publisher.subscribers() > 0 && published < 2_000 {
        publisher.publish_cdr(&word(&format!("{published:010000}"))).unwrap();
        published += 1;
        thread::sleep(pause);
    }
    assert_eq!(recorder.wait().code(), Some(1));
    let said = recorder.rest();
    let numbers = said.split("the bag was closed with ").nth(1).unwrap();
    let mut numbers = numbers.split(|c: char| !c.is_ascii_digit()).filter(|word| !word.is_empty());
    let mut number = || numbers.next().unwrap().parse::<u64>().unwrap();
    let (kept, lost) = (number(), number());
    assert_eq!(BagReader::open(&world.bag()).unwrap().message_count(), kept);
    let metadata = fs::read_to_string(world.bag().join("metadata.yaml")).unwrap();
    assert!(metadata.contains(&format!("eddy_messages_not_recorded: \"{lost}\"")), "{metadata}");
    // What the publisher brought after the recorder had stopped listening is not the recorder's.
    assert!(
        kept + lost <= published && kept + lost + 128 >= published,
        "{kept} {lost} {published}"
    );
}

#[test]
fn what_waits_in_the_queue_of_a_full_disk_is_counted_as_lost() {
    all_is_counted_on_a_full_disk(Duration::ZERO);
}

/// At this rate hardly anything waits: lost is what the last chunk held.
#[test]
fn what_was_in_the_last_chunk_on_a_full_disk_is_counted_as_lost() {
    all_is_counted_on_a_full_disk(Duration::from_millis(2));
}

/// Topics whose name promises a type, in a service of another layout, stand for whatever cannot be
/// subscribed to.
#[test]
fn a_topic_that_cannot_be_had_is_named_and_tried_again_while_the_others_are_recorded() {
    let world = World::new("record");
    let mut good = world.words("shm", "good");
    let node = NodeBuilder::new().create::<ipc::Service>().unwrap();
    let foreign = |name: &str| {
        let name = format!("eddy{}/{name}/status", world.prefix);
        let name = name.as_str().try_into().unwrap();
        node.service_builder(&name).publish_subscribe::<u64>().create().unwrap()
    };
    let (passing, _lasting) = (foreign("passing"), foreign("lasting"));
    let regex = format!("^{}/", world.prefix);
    let mut recorder = Process::start(&mut world.record(&["--regex", &regex, "--from", "shm"]));
    wait_for_a_subscriber(&*good);
    good.publish_cdr(&word("one")).unwrap();

    drop(passing);
    // Of the type that the recorder may have opened the topic with by now.
    let status = cdr::encode(&PredictionStatus::default());
    let mut again = world.publisher("shm", "passing/status", PredictionStatus::TYPE);
    wait_for_a_subscriber(&*again);
    again.publish_cdr(&status).unwrap();
    good.publish_cdr(&word("three")).unwrap();
    terminate(&recorder);
    assert_eq!(recorder.wait().code(), Some(1));
    let said = recorder.rest();
    let failed = format!("not recorded: shm:{}/lasting/status: ", world.prefix);
    assert_eq!(said.matches("not recorded: ").count(), 1, "{said}");
    assert!(said.contains(&failed), "{said}");
    let data: Vec<_> =
        BagReader::open(&world.bag()).unwrap().messages().map(|m| m.unwrap().data).collect();
    // Of two topics at the same moment, either may be first.
    assert_eq!(data.len(), 3);
    let expected = [word("one"), status, word("three")];
    assert!(expected.iter().all(|message| data.contains(message)));
    let metadata = fs::read_to_string(world.bag().join("metadata.yaml")).unwrap();
    assert!(metadata.contains("eddy_topics_not_recorded"), "{metadata}");
}

/// The service of another layout stands for a transport that the topic cannot be had from.
#[test]
fn a_topic_that_is_recorded_from_one_transport_is_not_named_as_missing_from_another() {
    let world = World::new("record");
    let node = NodeBuilder::new().create::<ipc::Service>().unwrap();
    let name = format!("eddy{}/status", world.prefix);
    let name = name.as_str().try_into().unwrap();
    let _foreign = node.service_builder(&name).publish_subscribe::<u64>().create().unwrap();
    let regex = format!("^{}/", world.prefix);
    let log = tempfile::NamedTempFile::new().unwrap();
    let mut command = world.record(&["--regex", &regex, "--from", "shm,zenoh"]);
    command.args(["--max-messages", "1"]).stderr(log.reopen().unwrap());
    let mut recorder = Process::start(&mut command);
    let warned = format!("shm:{}/status is not recorded", world.prefix);
    wait_for("the topic cannot be had from shared memory", || {
        fs::read_to_string(log.path()).unwrap().contains(&warned).then_some(())
    });
    let mut publisher = world.publisher("zenoh", "status", PredictionStatus::TYPE);
    wait_for_a_subscriber(&*publisher);
    publisher.publish_cdr(&cdr::encode(&PredictionStatus::default())).unwrap();
    assert!(recorder.wait().success());
    let said = recorder.rest();
    assert!(said.contains(&format!("{}/status: 1 messages", world.prefix)), "{said}");
    assert!(!said.contains("not recorded"), "{said}");
    let metadata = fs::read_to_string(world.bag().join("metadata.yaml")).unwrap();
    assert!(!metadata.contains("eddy_topics_not_recorded"), "{metadata}");
}

#[test]
fn what_makes_no_sense_is_refused_before_anything_is_written() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag").to_str().unwrap().to_owned();
    let record = |code: i32, arguments: &[&str]| {
        fail(code, [&["record", "--output", &bag], arguments].concat())
    };
    for (code, arguments, expected) in [
        (2, vec![], "LINK"),
        (2, vec!["--regex", "(", "--from", "shm"], "regex parse error"),
        (2, vec!["shm:/a", "--max-bag-size", "0"], "--max-bag-size"),
        (2, vec!["shm:/a", "--max-messages", "0"], "--max-messages"),
        (2, vec!["--all", "--from", "memory"], "memory links stay within one process"),
        (2, vec!["shm:/a", "--max-duration", "0"], "--max-bag-duration <SECONDS>"),
        (2, vec!["shm:/a", "--max-bag-duration", "0"], "expected more than 0"),
        (2, vec!["shm:/a", "--stop-after", "nan"], "expected more than 0"),
        (2, vec!["shm:/a", "--custom-data", "seven"], "expected KEY=VALUE"),
        (2, vec!["shm:/a", "--custom-data", "eddy_stiffness=soft"], "expected a positive number"),
        (
            2,
            vec!["shm:/a", "--custom-data", "run=7", "run=8"],
            "found run=8, expected each key once",
        ),
        (2, vec!["shm:/a", "--custom-data", "eddy_topics_not_recorded=/a"], "eddy writes this one"),
        (2, vec!["shm:/a", "zenoh:/a"], "found topic /a twice"),
    ] {
        let message = record(code, &arguments);
        assert!(message.contains(expected), "{message}");
        assert!(!Path::new(&bag).exists());
    }
}
