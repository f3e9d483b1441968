//! `eddy replay` as its users run it: what it publishes, when, and what the keys do.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io::Write as _,
    path::Path,
    process::{Command, Stdio},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use eddy_bag::{BagWriter, Channel, Schema, WriterOptions};
use eddy_frames::Stamp;
use eddy_messages::{
    Clock, Message, QosProfile, RosString, Time, TypeSupport, cdr,
    playback::{Paused, PlayingRate, SeekRequest, Success},
    qos::{HistoryPolicy, ReliabilityPolicy},
    services::Empty,
    type_support,
};
use eddy_transport::Subscriber;
use rustix::termios::{LocalModes, tcgetattr};

use crate::{
    client::Client,
    pty::{OnTerminal, ends, in_a_session, lines, read_to_end},
    support::{Process, World, domain, fail, latched, talking_eddy, wait_for, word},
};

const DEADLINE: Duration = Duration::from_secs(30);

/// A bag with words on `/a`, so many milliseconds after its start, each saying when.
fn write_words(path: &Path, times: &[i64]) {
    let mut bag = BagWriter::create(path, WriterOptions::default()).unwrap();
    let topic = bag.topic("/a", RosString::TYPE).unwrap();
    for time in times {
        let stamp = Stamp(1_000_000_000 + time * 1_000_000);
        bag.write(topic, stamp, stamp, &word(&time.to_string())).unwrap();
    }
    bag.finish().unwrap();
}

/// How the player is started.
trait Replaying {
    fn replay(&self, transport: &str, arguments: &[&str]) -> Command;
}

impl Replaying for World {
    fn replay(&self, transport: &str, arguments: &[&str]) -> Command {
        let mut command = talking_eddy();
        command.env("ZENOH_CONFIG_OVERRIDE", &self.overrides);
        command.env("ROS_DOMAIN_ID", self.domain.to_string());
        command.args([
            "replay",
            self.bag().to_str().unwrap(),
            "--to",
            transport,
            "--wait-for",
            "1",
        ]);
        command.args(["--remap", &format!("/a:={}/a", self.prefix)]).args(arguments);
        command
    }
}

fn next(subscriber: &mut dyn Subscriber) -> Vec<u8> {
    subscriber.receive(DEADLINE).unwrap().expect("a message comes").into_cdr()
}

/// What two subscribers receive, each waiting on a thread of its own: in shared memory, one that has not waited since the publisher came
/// gets nothing once the publisher is gone.
fn at_once<A: Send, B>(first: impl FnOnce() -> A + Send, second: impl FnOnce() -> B) -> (A, B) {
    thread::scope(|scope| {
        let first = scope.spawn(first);
        let second = second();
        (first.join().unwrap(), second)
    })
}

#[test]
fn the_clock_tells_the_recorded_time_beside_the_messages() {
    let world = World::new("replay");
    write_words(&world.bag(), &[0, 300, 600]);
    let mut words = world.subscriber("shm", "a", RosString::TYPE);
    let mut clock = world.subscriber("shm", "clock", Clock::TYPE);
    let over = AtomicBool::new(false);
    let told = thread::scope(|scope| {
        let listening = scope.spawn(|| {
            let mut told = Vec::new();
            loop {
                let is_over = over.load(Ordering::Relaxed);
                match clock.receive(Duration::from_millis(100)).unwrap() {
                    Some(payload) => {
                        let message: Clock = cdr::decode(&payload.into_cdr()).unwrap();
                        told.push(Stamp::from(message.clock).0 - 1_000_000_000);
                    }
                    None if is_over => return told,
                    None => {}
                }
            }
        });
        let remap = format!("/clock:={}/clock", world.prefix);
        let arguments = ["--clock", "50", "--rate", "0.5", "--remap", &remap];
        let mut player = Process::start(&mut world.replay("shm", &arguments));
        for time in [0, 300, 600] {
            assert_eq!(next(&mut *words), word(&time.to_string()));
        }
        assert!(player.wait().success());
        over.store(true, Ordering::Relaxed);
        listening.join().unwrap()
    });
    // 1.2 s at 50 Hz, each 10 ms of recorded time, as far as this machine keeps up.
    assert!((4..=62).contains(&told.len()), "{told:?}");
    assert!(
        told.is_sorted() && told.iter().all(|time| (0..=600_000_000).contains(time)),
        "{told:?}"
    );
    assert!(*told.last().unwrap() > 300_000_000, "{told:?}");
}

#[test]
fn types_that_nobody_knows_here_pass_through_as_bytes() {
    let world = World::new("replay");
    let hash = format!("RIHS01_{}", "7".repeat(64));
    let mut bag = BagWriter::create(&world.bag(), WriterOptions::default()).unwrap();
    let foreign = TypeSupport::foreign("acme_msgs/msg/Imu", &hash);
    let foreign = TypeSupport { schema: "float64 x".to_owned(), ..foreign };
    let topic = bag.offered_topic("/a", &foreign, &[]).unwrap();
    let data = [0, 1, 0, 0, 1, 2, 3];
    for time in [5, 200_000_000] {
        bag.write(topic, Stamp(time), Stamp(time), &data).unwrap();
    }
    bag.finish().unwrap();
    for transport in ["zenoh", "shm"] {
        let link = world.link(transport, "a");
        let mut subscriber = world.transports.subscriber(&link, &foreign).unwrap();
        let mut player = Process::start(&mut world.replay(transport, &[]));
        for _ in 0..2 {
            assert_eq!(next(&mut *subscriber), data, "{transport}");
        }
        assert!(player.wait().success());
    }
}

/// A player whose keys come from a terminal.
fn on_a_terminal(inner: &Command, theirs: &File) -> Process {
    Process::start(in_a_session(inner).stdin(Stdio::from(theirs.try_clone().unwrap())))
}

fn modes(terminal: &File) -> LocalModes {
    tcgetattr(terminal).unwrap().local_modes
}

#[test]
fn keys_on_a_terminal_pause_and_step_and_the_terminal_is_as_before_afterwards() {
    let world = World::new("replay");
    // The last message comes after ten minutes, or when it is asked for.
    write_words(&world.bag(), &[0, 300_000, 600_000]);
    let mut words = world.subscriber("shm", "a", RosString::TYPE);
    let (mut ours, theirs) = ends();
    let before = modes(&ours);
    let mut player = on_a_terminal(&world.replay("shm", &["--start-paused"]), &theirs);
    assert_eq!(
        player.line("keys:"),
        "keys: space pauses or resumes, right arrow or n plays the next message,\n"
    );
    assert_eq!(
        player.line("      up and"),
        "      up and down change the rate, left arrow or b skips back 5 s, f forward 5 s\n"
    );
    assert_eq!(words.receive(Duration::from_millis(200)).unwrap(), None);
    ours.write_all(b"n").unwrap();
    assert_eq!(next(&mut *words), word("0"));
    ours.write_all(b"x\x1b[C").unwrap();
    assert_eq!(next(&mut *words), word("300000"));
    ours.write_all(b" n").unwrap();
    assert_eq!(next(&mut *words), word("600000"));
    assert!(player.wait().success());
    assert_eq!(modes(&ours), before);
    // All who could still write are gone: reading ends.
    drop(theirs);
    // Nothing of what was typed was shown.
    let shown = Mutex::default();
    read_to_end(ours, &shown);
    assert_eq!(String::from_utf8_lossy(&shown.into_inner().unwrap()), "");
}

#[test]
fn keys_are_answered_in_a_status_line_as_wide_as_the_terminal() {
    let world = World::new("replay");
    write_words(&world.bag(), &[0, 300_000, 600_000]);
    let _words = world.subscriber("shm", "a", RosString::TYPE);
    for (columns, counted) in [(80, true), (44, false)] {
        let mut player = OnTerminal::start(&world.replay("shm", &["--start-paused"]), columns);
        let begun = player.wait_for("paused | 0.0 of 600.0 s | rate 1.00", 0);
        player.press(b"\x1b[A");
        let faster = player.wait_for("paused | 0.0 of 600.0 s | rate 1.10", begun);
        player.press(b" ");
        let playing = player.wait_for("playing | ", faster);
        player.press(b"n");
        player.wait_for("300.", playing);
        player.press(b"\x03");
        assert!(player.wait().success());
        let shown = player.shown();
        let status: Vec<_> =
            lines(&shown).into_iter().filter(|line| line.contains(" | ")).collect();
        assert!(status.iter().all(|line| line.len() < usize::from(columns)), "{status:?}");
        assert_eq!(status.iter().any(|line| line.ends_with(" messages")), counted, "{status:?}");
    }
}

#[test]
fn a_stopped_player_gives_the_terminal_back_and_takes_it_again() {
    let world = World::new("replay");
    write_words(&world.bag(), &[0, 300_000]);
    let mut words = world.subscriber("shm", "a", RosString::TYPE);
    let (mut ours, theirs) = ends();
    let before = modes(&ours);
    let mut player = on_a_terminal(&world.replay("shm", &["--start-paused"]), &theirs);
    wait_for("the player takes the terminal", || (modes(&ours) != before).then_some(()));
    let direct = modes(&ours);
    // Ctrl-Z.
    ours.write_all(b"\x1a").unwrap();
    wait_for("the terminal is as before", || (modes(&ours) == before).then_some(()));
    let stat = format!("/proc/{}/stat", player.id());
    wait_for("the player is stopped", || {
        fs::read_to_string(&stat).unwrap().contains(") T ").then_some(())
    });
    // As `fg` does.
    assert!(
        Command::new("kill").args(["-CONT", &player.id().to_string()]).status().unwrap().success()
    );
    wait_for("the player has the terminal again", || (modes(&ours) == direct).then_some(()));
    ours.write_all(b"n").unwrap();
    assert_eq!(next(&mut *words), word("0"));
    ours.write_all(b"n").unwrap();
    assert_eq!(next(&mut *words), word("300000"));
    assert!(player.wait().success());
    assert_eq!(modes(&ours), before);
}

#[test]
fn a_player_that_is_ended_by_a_second_signal_leaves_the_terminal_as_before() {
    let world = World::new("replay");
    let times: Vec<i64> = (0..2_000).collect();
    write_words(&world.bag(), &times);
    // It reads nothing: a player that blocks waits for it, and looks at no signal meanwhile.
    let words = world.subscriber("shm", "a", RosString::TYPE);
    let (ours, theirs) = ends();
    let before = modes(&ours);
    let mut player = on_a_terminal(&world.replay("shm", &["--rate", "100"]), &theirs);
    wait_for("the player takes the terminal", || (modes(&ours) != before).then_some(()));
    // Long enough for the room of the topic to be full.
    let full = Instant::now();
    while full.elapsed() < Duration::from_millis(500) {
        assert!(player.is_running());
        thread::sleep(Duration::from_millis(20));
    }
    player.interrupt();
    wait_for("the terminal is as before", || (modes(&ours) == before).then_some(()));
    player.interrupt();
    player.wait();
    assert_eq!(modes(&ours), before);
    drop(words);
}

#[test]
fn a_topic_with_two_types_is_played_with_the_one_that_can_be_had() {
    let world = World::new("replay");
    let mut bag = BagWriter::create(&world.bag(), WriterOptions::default()).unwrap();
    let channel = |name: &str| {
        Arc::new(Channel {
            topic: "/a".to_owned(),
            schema: Some(Arc::new(Schema {
                name: name.to_owned(),
                encoding: String::new(),
                data: Vec::new(),
            })),
            encoding: "cdr".to_owned(),
            metadata: BTreeMap::new(),
        })
    };
    // Nobody on Zenoh would find a type without its hash.
    let topics =
        [RosString::TYPE, "acme_msgs/msg/Imu"].map(|name| bag.channel(&channel(name)).unwrap());
    for (time, topic) in topics.into_iter().enumerate() {
        let stamp = Stamp(time as i64);
        bag.write(topic, stamp, stamp, &word("here")).unwrap();
    }
    bag.finish().unwrap();
    let mut words = world.subscriber("zenoh", "a", RosString::TYPE);
    let mut player = Process::start(&mut world.replay("zenoh", &[]));
    assert_eq!(next(&mut *words), word("here"));
    assert_eq!(player.wait().code(), Some(1));
    let expected = "not published: topic /a: zenoh needs the type hash of acme_msgs/msg/Imu";
    let said = player.rest();
    assert_eq!(said.matches(expected).count(), 1, "{said}");
}

/// A channel without a type hash.
fn channel(topic: &str, type_name: &str, definition: &str) -> Arc<Channel> {
    let schema = Schema {
        name: type_name.to_owned(),
        encoding: "ros2msg".to_owned(),
        data: definition.as_bytes().to_vec(),
    };
    Arc::new(Channel {
        topic: topic.to_owned(),
        schema: Some(Arc::new(schema)),
        encoding: "cdr".to_owned(),
        metadata: BTreeMap::new(),
    })
}

/// A bag with these messages, a millisecond apart.
fn write_messages(path: &Path, messages: &[(&Arc<Channel>, Vec<u8>)]) {
    let mut bag = BagWriter::create(path, WriterOptions::default()).unwrap();
    for ((channel, data), time) in messages.iter().zip(1..) {
        let (topic, stamp) = (bag.channel(channel).unwrap(), Stamp(time * 1_000_000));
        bag.write(topic, stamp, stamp, data).unwrap();
    }
    bag.finish().unwrap();
}

#[test]
fn a_name_that_ros_does_not_allow_is_changed_and_the_others_are_published() {
    for transport in ["zenoh", "dds", "shm"] {
        let world = World::in_domain("replay", domain());
        let words = |topic: &str| channel(topic, RosString::TYPE, "string data");
        let [usual, odd] = [words("/a"), words(&world.topic("front-camera/9"))];
        write_messages(
            &world.bag(),
            &[(&usual, word("000")), (&odd, word("odd")), (&usual, word("001"))],
        );
        let mut usual = world.subscriber(transport, "a", RosString::TYPE);
        let mut odd = world.subscriber(transport, "front_camera/_9", RosString::TYPE);
        let mut player = Process::start(&mut world.replay(transport, &[]));
        let both = || [next(&mut *usual), next(&mut *usual)];
        let (both, odd) = at_once(both, || next(&mut *odd));
        assert_eq!((both, odd), (["000", "001"].map(word), word("odd")));
        assert!(player.wait().success());
        let link = world.link(transport, "front_camera/_9");
        assert!(player.rest().contains(&format!("/front-camera/9 on {link} ")));
    }
}

#[test]
fn messages_that_dds_cannot_carry_are_left_out_and_named_once() {
    let world = World::in_domain("replay", domain());
    let words = channel("/a", RosString::TYPE, "string data");
    let big_endian = [&[0, 0, 0, 0, 0, 0, 0, 4][..], b"000\0"].concat();
    let messages =
        [word("000"), big_endian.clone(), vec![0, 1, 0], Vec::new(), word("001"), big_endian];
    let messages: Vec<_> = messages.into_iter().map(|data| (&words, data)).collect();
    write_messages(&world.bag(), &messages);
    let mut subscriber = world.subscriber("dds", "a", RosString::TYPE);
    let log = tempfile::NamedTempFile::new().unwrap();
    let mut player = Process::start(world.replay("dds", &[]).stderr(log.reopen().unwrap()));
    assert_eq!(next(&mut *subscriber), word("000"));
    // A message without bytes has no body.
    assert_eq!(next(&mut *subscriber), [0, 1, 0, 0]);
    assert_eq!(next(&mut *subscriber), word("001"));
    assert_eq!(player.wait().code(), Some(1));
    let said = player.rest();
    assert!(said.contains("not published: topic /a: 3 messages: "), "{said}");
    assert!(said.contains(": 3 messages in "), "{said}");
    let logged = fs::read_to_string(log.path()).unwrap();
    assert_eq!(logged.matches("a message is not published").count(), 1, "{logged}");
    assert!(logged.contains("1 topic not published, or not completely"), "{logged}");
}

#[test]
fn two_types_on_one_topic_are_published_apart_in_shared_memory() {
    let world = World::new("replay");
    let [words, numbers] =
        [("std_msgs/msg/String", "string data"), ("std_msgs/msg/Int32", "int32 data")]
            .map(|(name, definition)| channel("/a", name, definition));
    let number = vec![0, 1, 0, 0, 7, 0, 0, 0];
    write_messages(&world.bag(), &[(&words, word("one")), (&numbers, number.clone())]);
    let mut int32 = world.subscriber("shm", "a", "std_msgs/msg/Int32");
    let mut string = world.subscriber("shm", "a/std_msgs/String", RosString::TYPE);
    let mut player = Process::start(&mut world.replay("shm", &[]));
    let received = at_once(|| next(&mut *string), || next(&mut *int32));
    assert_eq!(received, (word("one"), number));
    assert!(player.wait().success());
}

#[test]
fn versions_of_a_type_are_published_apart_on_zenoh() {
    const NAME: &str = "acme_msgs/msg/Point";
    let world = World::new("replay");
    let definitions = ["float32 x", "float32 x\nfloat32 y"];
    let [old, new] = definitions.map(|definition| channel("/a", NAME, definition));
    let data = |numbers: u8| [&[0, 1, 0, 0][..], &vec![numbers; 4 * usize::from(numbers)]].concat();
    write_messages(&world.bag(), &[(&old, data(1)), (&new, data(2)), (&old, data(1))]);
    let link = world.link("zenoh", "a");
    let mut subscribers = definitions.map(|definition| {
        let support = TypeSupport::from_schema(NAME, definition).unwrap();
        world.transports.subscriber(&link, &support).unwrap()
    });
    let mut player = Process::start(&mut world.replay("zenoh", &[]));
    assert_eq!([next(&mut *subscribers[0]), next(&mut *subscribers[0])], [data(1), data(1)]);
    assert_eq!(next(&mut *subscribers[1]), data(2));
    assert!(player.wait().success());
    assert_eq!(player.rest().matches("publishing /a on ").count(), 2);
}

#[test]
fn a_type_without_fields_is_published() {
    let world = World::new("replay");
    let tick = channel("/a", "acme_msgs/msg/Tick", "");
    write_messages(&world.bag(), &[(&tick, vec![0, 1, 0, 0, 0])]);
    let support = TypeSupport::from_schema("acme_msgs/msg/Tick", "# Nothing.\n").unwrap();
    let mut ticks = world.transports.subscriber(&world.link("zenoh", "a"), &support).unwrap();
    let mut player = Process::start(&mut world.replay("zenoh", &[]));
    assert_eq!(next(&mut *ticks), [0, 1, 0, 0, 0]);
    assert!(player.wait().success());
}

#[test]
fn playback_from_an_offset_begins_with_what_publishers_had_kept() {
    for transport in ["zenoh", "dds", "shm"] {
        let world = World::in_domain("replay", domain());
        write_pause(&world.bag(), latched(1));
        let mut subscriber = world.subscriber(transport, "a", RosString::TYPE);
        let offset = ["--start-offset", "599.9"];
        let mut player = Process::start(&mut world.replay(transport, &offset));
        assert_eq!(next(&mut *subscriber), word("000"), "{transport}");
        assert_eq!(next(&mut *subscriber), word("600"), "{transport}");
        assert!(player.wait().success());
    }
}

#[test]
fn a_long_pause_is_said_when_it_begins_with_what_to_do() {
    let world = World::new("replay");
    // 54 years.
    write_words(&world.bag(), &[0, 1_700_000_000_000]);
    let mut words = world.subscriber("shm", "a", RosString::TYPE);
    let log = tempfile::NamedTempFile::new().unwrap();
    let mut player = Process::start(world.replay("shm", &[]).stderr(log.reopen().unwrap()));
    assert_eq!(next(&mut *words), word("0"));
    let expected = "the next message follows in 54 years; --start-offset 1700000000 begins with it";
    wait_for("the pause is said", || {
        fs::read_to_string(log.path()).unwrap().contains(expected).then_some(())
    });
    player.interrupt();
    player.wait();
    let mut player = Process::start(&mut world.replay("shm", &["--start-offset", "1700000000"]));
    assert_eq!(next(&mut *words), word("1700000000000"));
    assert!(player.wait().success());
}

#[test]
fn on_zenoh_the_player_does_what_its_services_are_asked() {
    let world = World::new("replay");
    // The last message comes after ten minutes, or when somebody goes there.
    write_words(&world.bag(), &[0, 100, 300_000, 600_000]);
    let mut words = world.subscriber("zenoh", "a", RosString::TYPE);
    let mut player = Process::start(&mut world.replay("zenoh", &["--start-paused"]));
    let client = Client::of(world.port, 0);
    let name = |service: &str| format!("/eddy_replay/{service}");
    let kind = |service: &str| format!("rosbag2_interfaces/srv/{service}");
    let is_paused =
        || client.ask::<_, Paused>(&name("is_paused"), &kind("IsPaused"), &Empty::default()).paused;
    let tell = |service: &str, type_name: &str| {
        client.ask::<_, Empty>(&name(service), &kind(type_name), &Empty::default());
    };
    let play_next = || {
        let done: Success = client.ask(&name("play_next"), &kind("PlayNext"), &Empty::default());
        done.success
    };
    let seek = |sec| {
        let request = SeekRequest { time: Time { sec, nanosec: 0 } };
        client.ask::<_, Success>(&name("seek"), &kind("Seek"), &request).success
    };
    let set_rate = |rate| {
        client.ask::<_, Success>(&name("set_rate"), &kind("SetRate"), &PlayingRate { rate }).success
    };

    assert!(is_paused());
    assert!(play_next());
    assert_eq!(next(&mut *words), word("0"));
    assert!(set_rate(4.0) && !set_rate(-1.0));
    let rate: PlayingRate = client.ask(&name("get_rate"), &kind("GetRate"), &Empty::default());
    assert_eq!(rate.rate, 4.0);
    tell("resume", "Resume");
    assert!(!is_paused() && !play_next(), "only a player that pauses steps");
    assert_eq!(next(&mut *words), word("100"));
    tell("toggle_paused", "TogglePaused");
    assert!(is_paused());
    tell("pause", "Pause");
    assert!(is_paused());
    // The bag begins one second after zero.
    assert!(seek(301) && play_next());
    assert_eq!(next(&mut *words), word("300000"));
    assert!(seek(0) && play_next(), "before the bag is at its beginning");
    assert_eq!(next(&mut *words), word("0"));
    assert!(!seek(602), "nothing comes after the last message");
    assert!(seek(600));
    tell("resume", "Resume");
    assert_eq!(next(&mut *words), word("600000"));
    assert!(player.wait().success());
}

#[test]
fn what_was_kept_when_it_was_recorded_is_kept_when_it_is_replayed() {
    for transport in ["zenoh", "dds"] {
        let world = World::in_domain("replay", domain());
        write_pause(&world.bag(), latched(1));
        let mut first = world.subscriber(transport, "a", RosString::TYPE);
        let player = Process::start(&mut world.replay(transport, &[]));
        assert_eq!(next(&mut *first), word("000"));
        let mut second = world.subscriber(transport, "a", RosString::TYPE);
        assert_eq!(next(&mut *second), word("000"), "{transport}");
        assert_eq!(offered(&world, transport), [announced(latched(1), transport)]);
        player.kill();
    }
}

#[test]
fn quality_of_service_is_what_was_recorded_or_what_the_file_says() {
    let best_effort = QosProfile {
        reliability: ReliabilityPolicy::BestEffort,
        history: HistoryPolicy::KeepLast(5),
        ..QosProfile::default()
    };
    for transport in ["zenoh", "dds"] {
        for (overridden, expected) in [(false, best_effort), (true, latched(2))] {
            // On DDS, a killed player is seen for a while: each has its domain.
            let world = World::in_domain("replay", domain());
            write_pause(&world.bag(), best_effort);
            let file = world.folder.path().join("qos.yaml");
            fs::write(&file, "/a: {durability: transient_local, depth: 2}\n/b: {depth: 1}\n")
                .unwrap();
            let options = ["--qos-profile-overrides-path", file.to_str().unwrap()];
            let options = if overridden { &options[..] } else { &[] };
            let mut subscriber = world.subscriber(transport, "a", RosString::TYPE);
            let player = Process::start(&mut world.replay(transport, options));
            assert_eq!(next(&mut *subscriber), word("000"));
            assert_eq!(offered(&world, transport), [announced(expected, transport)]);
            player.kill();
        }
    }
}

#[test]
fn a_file_of_qos_profiles_that_cannot_be_used_is_named() {
    let world = World::new("replay");
    write_words(&world.bag(), &[0]);
    let file = world.folder.path().join("qos.yaml");
    fs::write(&file, "/a: {reliability: sometimes}\n").unwrap();
    let (bag, file) = (world.bag(), file.to_str().unwrap());
    let arguments =
        ["replay", bag.to_str().unwrap(), "--to", "shm", "--qos-profile-overrides-path", file];
    let message = fail(1, arguments);
    let expected = "reliability: found sometimes for /a, expected reliable or best_effort";
    assert!(message.contains("--qos-profile-overrides-path"), "{message}");
    assert!(message.contains(expected), "{message}");
}

/// A bag with words on `/a` at its start and ten minutes later.
fn write_pause(path: &Path, offered: QosProfile) {
    let mut bag = BagWriter::create(path, WriterOptions::default()).unwrap();
    let words = type_support(RosString::TYPE).unwrap();
    let topic = bag.offered_topic("/a", words, &[offered]).unwrap();
    for seconds in [0, 600] {
        let stamp = Stamp(seconds * 1_000_000_000);
        // Without the padding that DDS would add.
        bag.write(topic, stamp, stamp, &word(&format!("{seconds:03}"))).unwrap();
    }
    bag.finish().unwrap();
}

/// What the publishers of the topic `a` offer now.
fn offered(world: &World, transport: &str) -> Vec<QosProfile> {
    let link = world.link(transport, "a");
    let topics = world.transports.topics(link.transport).unwrap();
    topics.into_iter().find(|topic| topic.link == link).unwrap().offered
}

/// A profile as others see it: DDS does not announce the history.
fn announced(profile: QosProfile, transport: &str) -> QosProfile {
    match transport {
        "dds" => QosProfile { history: HistoryPolicy::Unknown, ..profile },
        _ => profile,
    }
}

#[test]
fn without_a_terminal_nobody_could_end_the_pause() {
    let world = World::new("replay");
    write_words(&world.bag(), &[0]);
    let bag = world.bag();
    let remap = format!("/a:={}/a", world.prefix);
    let arguments = ["replay", bag.to_str().unwrap(), "--to", "shm", "--remap", &remap, "-p"];
    let message = fail(1, arguments);
    assert!(message.contains("--start-paused: nothing can resume playback"), "{message}");
}
