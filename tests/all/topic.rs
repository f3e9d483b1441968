//! `eddy topic`: looking at topics without ROS.

use std::fs;

use eddy_bag::{BagWriter, WriterOptions};
use eddy_frames::Stamp;
use eddy_messages::{QosProfile, TypeSupport};

use crate::support::{Process, fail, succeed, talking_eddy, unique};

/// The sample bag in a loop, as `prefix`, on a transport.
fn replay(transport: &str, reliability: &str, prefix: &str) -> Process {
    let mut command = talking_eddy();
    let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/bags/sample");
    command.args(["replay", sample, "--loop", "--reliability", reliability, "--to", transport]);
    command.args(["--remap", &format!("/particles:=/{prefix}/particles")]);
    Process::start_until(&mut command, "publishing")
}

#[test]
fn topics_are_listed_with_their_types_and_told_about() {
    for transport in ["shm", "zenoh"] {
        let prefix = unique("topic");
        let _replay = replay(transport, "drop", &prefix);
        let link = format!("{transport}:/{prefix}/particles");
        let told = succeed(["topic", "info", &link]);
        assert!(told.starts_with("Type: eddy_msgs/msg/ParticleFrame\n"), "{told}");
        let memory = told.lines().find(|line| line.starts_with("Shared memory: "));
        let expected =
            (transport == "shm").then_some("Shared memory: 16.5 MB (1 publishers, 0 subscribers)");
        assert_eq!(memory, expected, "{told}");
        let listed = succeed(["topic", "list", "--from", transport, "--wait", "3"]);
        let line = listed.lines().find(|line| line.starts_with(&link));
        let line = line.unwrap_or_else(|| panic!("{link} is not in:\n{listed}"));
        assert!(line.ends_with("  eddy_msgs/msg/ParticleFrame"), "{line}");
    }
}

#[test]
fn messages_are_printed_as_yaml_with_long_lists_cut() {
    for transport in ["shm", "zenoh"] {
        let prefix = unique("echo");
        let _replay = replay(transport, "drop", &prefix);
        let link = format!("{transport}:/{prefix}/particles");
        let printed = succeed(["topic", "echo", &link, "--count", "2", "--truncate", "2"]);
        assert_eq!(printed.matches("---\n").count(), 2, "{printed}");
        let message = printed.split("---\n").next().unwrap();
        // In the order of the message's definition, as ROS has it.
        let mut rest = message;
        for expected in [
            "header:",
            "stamp:",
            "sec: 0",
            "nanosec:",
            "frame_id: world",
            "stream: 0",
            "sequence:",
            "dt: 0.016\n",
            "lower:\n- 0.0\n- 0.0\n",
            "upper:",
            "position:\n- ",
            "- ... of 5000\n",
            "velocity:\n- ",
            "- ... of 5000\n",
            "material:\n- 0\n- 0\n- ... of 2500\n",
        ] {
            let place = rest.find(expected);
            let place = place.unwrap_or_else(|| panic!("no `{expected}` in its place: {message}"));
            rest = &rest[place + expected.len()..];
        }
    }
}

#[test]
fn definitions_of_printed_types_are_found_in_installations_as_for_recordings() {
    let folder = tempfile::tempdir().unwrap();
    let msg = folder.path().join("share/acme_msgs/msg");
    fs::create_dir_all(&msg).unwrap();
    fs::write(msg.join("Probe.msg"), "float64 depth\n").unwrap();
    let bag = folder.path().join("bag");
    let probe = TypeSupport::from_schema("acme_msgs/msg/Probe", "float64 depth\n").unwrap();
    let mut writer = BagWriter::create(&bag, WriterOptions::default()).unwrap();
    let topic = writer.offered_topic("/probe", &probe, &[QosProfile::default()]).unwrap();
    let message = [&[0, 1, 0, 0][..], &1.5_f64.to_le_bytes()].concat();
    for time in 0..20 {
        let time = Stamp(time * 50_000_000);
        writer.write(topic, time, time, &message).unwrap();
    }
    writer.finish().unwrap();
    let link = format!("/{}/probe", unique("probe"));
    let mut command = talking_eddy();
    command.args(["replay", bag.to_str().unwrap(), "--loop", "--reliability", "drop"]);
    command.args(["--to", "shm", "--remap", &format!("/probe:={link}")]);
    let _replay = Process::start_until(&mut command, "publishing");
    let echo = |prefix: &str| {
        let arguments = ["topic", "echo", &format!("shm:{link}"), "--once"];
        let output =
            talking_eddy().args(arguments).env("AMENT_PREFIX_PATH", prefix).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    assert_eq!(echo(folder.path().to_str().unwrap()), "depth: 1.5\n---\n");
    assert_eq!(echo("/nowhere"), "# 12 bytes of acme_msgs/msg/Probe\n---\n");
}

#[test]
fn the_rate_is_that_of_the_bag() {
    let prefix = unique("hz");
    let _replay = replay("shm", "drop", &prefix);
    let link = format!("shm:/{prefix}/particles");
    let printed = succeed(["topic", "hz", &link, "--duration", "3"]);
    let last = printed.lines().rfind(|line| line.starts_with("average rate: ")).unwrap();
    let rate: f64 = last["average rate: ".len()..].parse().unwrap();
    // 62.5 Hz as recorded; a busy machine may be slower, and a loop begins anew at once.
    assert!((20.0..80.0).contains(&rate), "{rate}");
}

#[test]
fn links_within_a_process_have_nothing_to_look_at() {
    let message = fail(2, ["topic", "echo", "memory:/particles"]);
    assert!(message.contains("memory links stay within one process"), "{message}");
}

#[test]
fn who_looks_and_does_not_read_holds_nobody_back() {
    let prefix = unique("unread");
    let link = format!("shm:/{prefix}/particles");
    let _replay = replay("shm", "block", &prefix);
    // 12,500 numbers a frame soon fill the pipe that nobody reads.
    let arguments = ["topic", "echo", &link, "--truncate", "0"];
    let _echo = Process::start_until(talking_eddy().args(arguments), "header:");
    let printed = succeed(["topic", "hz", &link, "--duration", "5"]);
    let last = printed.trim_end().lines().last().unwrap();
    assert!(last.starts_with("\tmin: "), "{printed}");
}

#[test]
fn a_topic_that_has_fallen_silent_is_said_to_be() {
    let prefix = unique("silent");
    let link = format!("shm:/{prefix}/particles");
    let replay = replay("shm", "drop", &prefix);
    let mut hz = Process::start_until(talking_eddy().args(["topic", "hz", &link]), "average rate");
    replay.kill();
    hz.line("no new messages");
}

#[test]
fn a_topic_that_nobody_publishes_is_said_at_once_with_those_that_are_there() {
    let prefix = unique("unpublished");
    let _replay = replay("shm", "drop", &prefix);
    let start = std::time::Instant::now();
    let link = format!("shm:/{prefix}/nothing");
    let output = talking_eddy().args(["topic", "hz", &link, "--duration", "2"]).output().unwrap();
    // The time counts from the start; an earlier version waited for thirty seconds first.
    assert!(start.elapsed().as_secs() < 15);
    let logged = String::from_utf8(output.stderr).unwrap();
    assert!(logged.contains("not published yet, waiting up to 2 s; available topics on shm: "));
    assert!(logged.contains(&format!("/{prefix}/particles")), "{logged}");
    assert!(logged.contains("no publisher appeared within 2 s"), "{logged}");
    assert_eq!(output.status.code(), Some(1));
}

#[test]
fn ros_users_find_what_they_type() {
    let prefix = unique("reflex");
    let _replay = replay("shm", "drop", &prefix);
    let topic = format!("/{prefix}/particles");
    let on_shm = |arguments: &[&str]| {
        let output = talking_eddy().args(arguments).env("EDDY_TRANSPORT", "shm").output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let printed = on_shm(&["topic", "echo", &topic, "--once", "--truncate", "1"]);
    assert_eq!(printed.matches("---\n").count(), 1, "{printed}");
    let listed = on_shm(&["topic", "list", "-t", "--from", "shm"]);
    assert!(listed.contains(&topic), "{listed}");
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    let bag = bag.to_str().unwrap();
    let said = on_shm(&["bag", "record", &topic, "-o", bag, "--max-messages", "2"]);
    assert!(said.contains(&format!("recording shm:{topic}")), "{said}");
    let said = on_shm(&["bag", "play", bag, "-r", "10"]);
    assert!(said.contains(&format!("publishing {topic} on shm:{topic}")), "{said}");
    let wrong =
        talking_eddy().args(["topic", "info", &topic]).env("EDDY_TRANSPORT", "shn").output();
    let wrong = wrong.unwrap();
    assert_eq!(wrong.status.code(), Some(2));
    assert!(String::from_utf8_lossy(&wrong.stderr).contains("did you mean shm?"));
}

#[test]
fn a_transport_that_fails_is_named_after_the_topics_of_the_others() {
    let prefix = unique("failing");
    let _replay = replay("shm", "drop", &prefix);
    for (from, expected) in [("shm,dds", 1), ("dds,shm", 1), ("shm", 0)] {
        let mut command = talking_eddy();
        command.args(["topic", "list", "--from", from, "--wait", "0.1"]);
        // DDS links are rejected.
        let output = command.env("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF").output().unwrap();
        let listed = String::from_utf8(output.stdout).unwrap();
        assert!(listed.contains(&format!("shm:/{prefix}/particles")), "{listed}");
        let logged = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(expected), "{logged}");
        assert_eq!(logged.contains("cannot search dds: "), expected == 1, "{logged}");
    }
}

#[test]
fn the_default_transport_is_the_one_that_is_listed() {
    let prefix = unique("default");
    let _replay = replay("shm", "drop", &prefix);
    let link = format!("shm:/{prefix}/particles");
    for (default, is_listed) in [("shm", true), ("zenoh", false), ("", true)] {
        let mut command = talking_eddy();
        command.args(["topic", "list", "--wait", "0.1"]).env("EDDY_TRANSPORT", default);
        let output = command.output().unwrap();
        let listed = String::from_utf8(output.stdout).unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        assert_eq!(listed.contains(&link), is_listed, "{default}: {listed}");
    }
}

#[test]
fn who_looks_on_another_transport_is_told_where_the_topics_are() {
    let prefix = unique("elsewhere");
    let _replay = replay("shm", "drop", &prefix);
    let link = format!("zenoh:/{prefix}/particles");
    let message = fail(1, ["topic", "hz", &link, "--duration", "1"]);
    let (_, others) = message.rsplit_once("available topics on zenoh: ").unwrap();
    let (_, on_shm) = others.split_once("; on shm: ").unwrap_or_else(|| panic!("{message}"));
    assert!(on_shm.contains(&format!("/{prefix}/particles")), "{message}");
}
