//! `eddy topic`: looking at topics without ROS.

use crate::support::{Process, fail, succeed, talking_eddy, unique};

/// The sample bag in a loop, as `prefix`, on a transport.
fn replay(transport: &str, prefix: &str) -> Process {
    let mut command = talking_eddy();
    let sample = concat!(env!("CARGO_MANIFEST_DIR"), "/bags/sample");
    command.args(["replay", sample, "--loop", "--reliability", "drop", "--to", transport]);
    command.args(["--remap", &format!("/particles:=/{prefix}/particles")]);
    Process::start_until(&mut command, "publishing")
}

#[test]
fn topics_are_listed_with_their_types_and_told_about() {
    for transport in ["shm", "zenoh"] {
        let prefix = unique("topic");
        let _replay = replay(transport, &prefix);
        let link = format!("{transport}:/{prefix}/particles");
        let told = succeed(["topic", "info", &link]);
        assert!(told.starts_with("Type: eddy_msgs/msg/ParticleFrame\n"), "{told}");
        let listed = succeed(["topic", "list", "--from", transport, "--wait", "1"]);
        let line = listed.lines().find(|line| line.starts_with(&link)).unwrap();
        assert!(line.ends_with("  eddy_msgs/msg/ParticleFrame"), "{line}");
    }
}

#[test]
fn messages_are_printed_as_yaml_with_long_lists_cut() {
    for transport in ["shm", "zenoh"] {
        let prefix = unique("echo");
        let _replay = replay(transport, &prefix);
        let link = format!("{transport}:/{prefix}/particles");
        let printed = succeed(["topic", "echo", &link, "--count", "2", "--truncate", "2"]);
        assert_eq!(printed.matches("---\n").count(), 2, "{printed}");
        for expected in ["frame_id: world", "... of 5000", "... of 2500", "dt: 0.016"] {
            assert_eq!(printed.matches(expected).count() % 2, 0, "{expected}: {printed}");
            assert!(printed.contains(expected), "{expected}: {printed}");
        }
    }
}

#[test]
fn the_rate_is_that_of_the_bag() {
    let prefix = unique("hz");
    let _replay = replay("shm", &prefix);
    let link = format!("shm:/{prefix}/particles");
    let printed = succeed(["topic", "hz", &link, "--duration", "3"]);
    let last = printed.lines().rfind(|line| line.starts_with("average rate: ")).unwrap();
    let rate: f64 = last["average rate: ".len()..].parse().unwrap();
    // 62.5 Hz as recorded; a busy machine may be slower, and a loop begins anew at once.
    assert!((20.0..80.0).contains(&rate), "{rate}");
}

#[test]
fn links_within_a_process_have_nothing_to_look_at() {
    let message = fail(1, ["topic", "echo", "memory:/particles"]);
    assert!(message.contains("memory links stay within one process"), "{message}");
}
