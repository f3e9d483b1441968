//! A subscriber that reads nothing, and programs that are asked to end beside it.

use std::{
    fs::{self, File},
    path::{Path, PathBuf},
    process::Command,
    time::{Duration, Instant},
};

use eddy_messages::{Message, ParticleFrame, QosProfile, type_support};
use eddy_transport::{Link, Subscriber, TransportOptions, Transports};
use tempfile::TempDir;

use crate::support::{
    DEADLINE, Process, domain, eddy, free_port, send, simulate, talking_eddy, unique,
};

/// Programs on one transport, and this process's end of it.
struct Network {
    folder: TempDir,
    kind: &'static str,
    transports: Transports,
    domain: u16,
    /// For the programs (`ZENOH_CONFIG_OVERRIDE`): they connect to this process and find each other by gossip.
    overrides: String,
}

impl Network {
    fn on(kind: &'static str) -> Self {
        let (port, domain) = (free_port(), if kind == "dds" { domain() } else { 0 });
        let endpoints = |listen: u16, connect: &str| {
            format!(r#"listen/endpoints=["tcp/127.0.0.1:{listen}"];connect/endpoints=[{connect}]"#)
        };
        let mut options = TransportOptions::new("eddy_test");
        options.domain_id = domain;
        options.zenoh.overrides = endpoints(port, "");
        Self {
            folder: tempfile::tempdir().unwrap(),
            kind,
            transports: Transports::new(options),
            domain,
            overrides: endpoints(0, &format!(r#""tcp/127.0.0.1:{port}""#)),
        }
    }

    fn link(&self, name: &str) -> Link {
        format!("{}:/{}", self.kind, unique(name)).parse().unwrap()
    }

    fn program(&self, mut command: Command) -> Command {
        command.env("ROS_DOMAIN_ID", self.domain.to_string());
        command.env("ZENOH_CONFIG_OVERRIDE", &self.overrides);
        command
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// A recorder of `link` that has received nothing yet.
    fn recorder(&self, link: &Link) -> Process {
        let mut record = self.program(talking_eddy());
        record.args(["record", &link.to_string(), "--output"]).arg(self.path("recorded"));
        Process::start_until(&mut record, "recording")
    }

    fn reader(&self, link: &Link) -> Box<dyn Subscriber> {
        self.transports.subscriber(link, ParticleFrame::TYPE).unwrap()
    }

    fn bag(&self) -> PathBuf {
        simulate(&self.path("truth"), 1, 2.0);
        self.path("truth/scene_0000")
    }
}

/// A process ends within a second; those that wait for their subscribers take ten and more.
const AT_ONCE: Duration = Duration::from_secs(5);

/// Reads until `count` frames have arrived.
fn read(reader: &mut dyn Subscriber, count: usize) {
    let start = Instant::now();
    let mut read = 0;
    while read < count {
        read += usize::from(reader.receive(Duration::from_millis(100)).unwrap().is_some());
        assert!(start.elapsed() < DEADLINE, "{read} of {count} frames");
    }
}

/// Reads until nothing has arrived for a second.
fn read_until_silent(reader: &mut dyn Subscriber) {
    let start = Instant::now();
    while reader.receive(Duration::from_secs(1)).unwrap().is_some() {
        assert!(start.elapsed() < DEADLINE, "the publisher never waits");
    }
}

/// Stops the recorder of a publisher, waits until the publisher is stuck, and asks it to end with `signal`. Returns its exit
/// code and what it said.
fn end_beside_a_stopped_recorder(
    network: &Network,
    link: &Link,
    mut command: Command,
    signal: &str,
) -> (Option<i32>, String) {
    let said = network.path("said");
    command.stderr(File::create(&said).unwrap());
    let mut reader = network.reader(link);
    let recorder = network.recorder(link);
    let mut publisher = Process::start(&mut command);
    // Half a second or more, in which the recorder connects: in shared memory nobody waits for one that has not.
    let start = Instant::now();
    read(reader.as_mut(), 20);
    while start.elapsed() < Duration::from_millis(500) {
        read(reader.as_mut(), 1);
    }
    send("-STOP", &recorder);
    read_until_silent(reader.as_mut());
    let start = Instant::now();
    send(signal, &publisher);
    let status = publisher.wait();
    let took = start.elapsed();
    let said = fs::read_to_string(said).unwrap();
    assert!(took < AT_ONCE, "{link}: {signal} took {took:?}: {said}");
    recorder.kill();
    (status.code(), said)
}

/// Replays a bag to `link` once it has so many subscribers.
fn replay(network: &Network, bag: &Path, link: &Link, subscribers: &str) -> Command {
    let remap = format!("/particles:={}", link.topic);
    let mut command = network.program(eddy());
    command.arg("replay").arg(bag).args(["--loop", "--rate", "20", "--topics", "/particles"]);
    command.args(["--to", network.kind, "--wait-for", subscribers, "--remap", &remap]);
    command
}

#[test]
fn a_replay_ends_beside_a_stopped_recorder_and_says_what_was_lost() {
    for (kind, signal) in [("shm", "-INT"), ("zenoh", "-TERM"), ("dds", "-INT")] {
        let network = Network::on(kind);
        let (bag, link) = (network.bag(), network.link("stuck"));
        let command = replay(&network, &bag, &link, "2");
        let (code, said) = end_beside_a_stopped_recorder(&network, &link, command, signal);
        assert_eq!(code, Some(1), "{said}");
        assert!(said.contains(&link.to_string()), "{said}");
        assert!(said.contains("messages were not delivered to all subscribers"), "{said}");
        assert!(!said.contains("InternalError"), "{said}");
    }
}

#[test]
fn a_node_ends_beside_a_stopped_recorder_and_says_what_was_lost() {
    for (kind, signal) in [("shm", "-TERM"), ("zenoh", "-INT"), ("dds", "-TERM")] {
        let network = Network::on(kind);
        let (bag, [input, output]) = (network.bag(), ["input", "output"].map(|n| network.link(n)));
        let mut source = replay(&network, &bag, &input, "1");
        source.args(["--reliability", "drop"]);
        let _source = Process::start(&mut source);
        let mut command = network.program(eddy());
        command.args(["node", "--reliability", "block", "--input", &input.to_string()]);
        command.args(["--output", &output.to_string()]);
        let (code, said) = end_beside_a_stopped_recorder(&network, &output, command, signal);
        assert_eq!(code, Some(0), "{said}");
        assert!(said.contains(&output.to_string()), "{said}");
        assert!(said.contains("messages were not delivered to all subscribers"), "{said}");
    }
}

#[test]
fn a_simulation_ends_beside_a_stopped_recorder_and_says_what_was_lost() {
    let network = Network::on("shm");
    let link = network.link("stuck");
    let mut command = network.program(eddy());
    command.args(["simulate", "--publish", &link.to_string(), "--duration", "600", "--rate", "20"]);
    command.args(["--particles", "500", "--wait-for", "2"]);
    let (code, said) = end_beside_a_stopped_recorder(&network, &link, command, "-TERM");
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("the subscriber in process"), "{said}");
    assert!(said.contains("frames were not delivered to all subscribers"), "{said}");
}

/// Zenoh waits for 10 s to close the connection to a peer that reads nothing.
#[test]
fn a_dropping_publisher_ends_at_once_beside_a_stopped_recorder() {
    let network = Network::on("zenoh");
    let (bag, link) = (network.bag(), network.link("stuck"));
    let said = network.path("said");
    let mut command = replay(&network, &bag, &link, "2");
    command.args(["--reliability", "drop"]).stderr(File::create(&said).unwrap());
    let mut reader = network.reader(&link);
    let recorder = network.recorder(&link);
    let mut publisher = Process::start(&mut command);
    read(reader.as_mut(), 20);
    send("-STOP", &recorder);
    // More than the buffers of a connection take.
    read(reader.as_mut(), 2_000);
    let start = Instant::now();
    publisher.interrupt();
    assert!(publisher.wait().success(), "{}", fs::read_to_string(said).unwrap());
    assert!(start.elapsed() < AT_ONCE, "{:?}", start.elapsed());
    recorder.kill();
}

/// A ROS subscriber is reliable unless it says otherwise, and gets nothing from a publisher that is not.
#[test]
fn a_reliable_subscriber_of_a_best_effort_topic_is_named_in_the_log() {
    let network = Network::on("dds");
    let [input, output] = ["input", "output"].map(|name| network.link(name));
    let said = network.path("said");
    let mut command = network.program(eddy());
    command.args(["node", "--input", &input.to_string(), "--output", &output.to_string()]);
    command.stderr(File::create(&said).unwrap());
    let _node = Process::start(&mut command);
    let support = type_support(ParticleFrame::TYPE).unwrap();
    let requested = Some(QosProfile::default());
    let _reader = network.transports.requesting_subscriber(&output, support, requested).unwrap();
    let line = crate::support::wait_for("the node names the subscription", || {
        let said = fs::read_to_string(&said).unwrap();
        said.lines().find(|line| line.contains("incompatible QoS")).map(str::to_owned)
    });
    assert!(line.contains(&output.to_string()) && line.contains("RELIABILITY"), "{line}");
}
