//! Three processes, as a user starts them: `eddy replay` -> `eddy node` -> `eddy record`.

use std::{collections::BTreeMap, path::Path, process::Command, time::Duration};

use eddy_bag::BagReader;
use eddy_frames::Frame;
use eddy_messages::{
    Message, ParticleFrame,
    services::{
        Empty, GetParametersResponse, Parameter, ParameterNames, ParameterValue,
        SetParametersRequest, SetParametersResponse, TriggerResponse,
    },
};
use eddy_transport::{Reliability, TransportKind, TransportOptions, Transports};
use tempfile::TempDir;

use crate::{
    client::Client,
    support::{Process, domain, free_port, simulate, succeed, talking_eddy, unique, wait_for},
};

/// One scene, what `eddy predict` says of it, and a place in the world of its own.
struct World {
    folder: TempDir,
    transport: TransportKind,
    prefix: String,
    ports: [u16; 3],
    domain: u16,
}

/// Who listens on which of the world's Zenoh ports.
#[derive(Clone, Copy)]
enum Role {
    Node,
    Recorder,
    Player,
}

impl World {
    fn new(transport: TransportKind) -> Self {
        let mut world = Self {
            folder: tempfile::tempdir().unwrap(),
            transport,
            prefix: format!("/{}", unique("graph")),
            ports: [0; 3],
            domain: domain(),
        };
        simulate(&world.folder.path().join("truth"), 1, 1.0);
        let (truth, expected) = (world.path("truth/scene_0000"), world.path("expected"));
        succeed(["predict", "--input", &truth, "--output", &expected]);
        // Last, so that they are used at once.
        world.ports = [free_port(), free_port(), free_port()];
        world
    }

    fn path(&self, name: &str) -> String {
        self.folder.path().join(name).to_str().unwrap().to_owned()
    }

    fn link(&self, topic: &str) -> String {
        format!("{}:{}{topic}", self.transport, self.prefix)
    }

    /// The program, on Zenoh ports and in a domain of this world's own.
    fn eddy(&self, role: Role) -> Command {
        let endpoint = |port: &u16| format!("\"tcp/127.0.0.1:{port}\"");
        let listen = endpoint(&self.ports[role as usize]);
        let others = self.ports.iter().filter(|&&port| port != self.ports[role as usize]);
        let connect = others.map(endpoint).collect::<Vec<_>>().join(",");
        let mut command = talking_eddy();
        command.env("ROS_DOMAIN_ID", self.domain.to_string());
        command.env(
            "ZENOH_CONFIG_OVERRIDE",
            format!("listen/endpoints=[{listen}];connect/endpoints=[{connect}]"),
        );
        command
    }

    /// A node that listens.
    fn node(&self) -> Process {
        let (input, output) = (self.link("/particles"), self.link("/prediction"));
        let mut command = self.eddy(Role::Node);
        command.args(["node", "--reliability=block", "--input", &input, "--output", &output]);
        Process::start_until(&mut command, "predicting")
    }

    /// A recorder that listens.
    fn record(&self, bag: &str, messages: usize) -> Process {
        let mut command = self.eddy(Role::Recorder);
        command.args(["record", &self.link("/particles"), &self.link("/prediction")]);
        command.args(["--output", &self.path(bag), "--max-messages", &messages.to_string()]);
        Process::start_until(&mut command, "recording")
    }

    /// Replays the scene once node and recorder listen.
    fn replay(&self, rate: f64) -> Process {
        Process::start(self.eddy(Role::Player).args([
            "replay",
            &self.path("truth/scene_0000"),
            "--to",
            &self.transport.to_string(),
            "--remap",
            &format!("/particles:={}/particles", self.prefix),
            "--wait-for",
            "2",
            "--rate",
            &rate.to_string(),
        ]))
    }

    /// Bytes of a bag that is being recorded.
    fn recorded(&self, bag: &str) -> u64 {
        let file = format!("{bag}/{bag}_0.mcap.active");
        std::fs::metadata(self.path(&file)).map_or(0, |metadata| metadata.len())
    }

    fn frames(&self, bag: &str, topic: &str) -> Vec<Frame> {
        let reader = BagReader::open(Path::new(&self.path(bag))).unwrap();
        reader.frames(topic).unwrap().map(Result::unwrap).collect()
    }
}

fn every_frame_has_its_prediction_and_it_equals_the_offline_one(transport: TransportKind) {
    let world = World::new(transport);
    let truth = world.frames("truth/scene_0000", "/particles");
    let expected = world.frames("expected", "/prediction");
    assert!(expected.len() > truth.len() / 2);

    let mut node = world.node();
    let mut record = world.record("recorded", truth.len() + expected.len());
    assert!(world.replay(1.0).wait().success());
    assert!(record.wait().success());
    node.interrupt();
    assert!(node.wait().success());

    let topic = |name: &str| format!("{}{name}", world.prefix);
    assert_eq!(world.frames("recorded", &topic("/particles")), truth);
    assert_eq!(world.frames("recorded", &topic("/prediction")), expected);
    let stamps: BTreeMap<_, _> = truth.iter().map(|frame| (frame.sequence, frame.stamp)).collect();
    for prediction in &expected[..expected.len() - 1] {
        assert_eq!(stamps[&prediction.sequence], prediction.stamp);
    }
}

#[test]
fn on_zenoh_every_frame_has_its_prediction_and_it_equals_the_offline_one() {
    every_frame_has_its_prediction_and_it_equals_the_offline_one(TransportKind::Zenoh);
}

#[test]
fn on_shared_memory_every_frame_has_its_prediction_and_it_equals_the_offline_one() {
    every_frame_has_its_prediction_and_it_equals_the_offline_one(TransportKind::Shm);
}

#[test]
fn on_dds_every_frame_has_its_prediction_and_it_equals_the_offline_one() {
    every_frame_has_its_prediction_and_it_equals_the_offline_one(TransportKind::Dds);
}

#[test]
fn on_dds_bytes_that_are_no_frame_are_counted_and_the_node_goes_on() {
    let world = World::new(TransportKind::Dds);
    let mut node = world.node();
    let mut options = TransportOptions::new("eddy_test");
    options.domain_id = world.domain;
    let transports = Transports::new(options);
    let [input, output] = ["/particles", "/prediction"].map(|t| world.link(t).parse().unwrap());
    let mut predictions = transports.subscriber(&output, ParticleFrame::TYPE).unwrap();
    let mut publisher =
        transports.publisher(&input, ParticleFrame::TYPE, Reliability::Block).unwrap();
    wait_for("the node listens", || (publisher.subscribers() == 1).then_some(()));
    let endless = [&[0, 1, 0, 0], [0xff; 5_000].as_slice()].concat();
    for hostile in [&[0, 1, 0, 0], endless.as_slice(), &endless[..7]] {
        publisher.publish_cdr(hostile).unwrap();
    }
    for frame in world.frames("truth/scene_0000", "/particles").iter().take(20) {
        publisher.publish_frame(frame).unwrap();
    }
    let prediction = wait_for("a prediction", || predictions.receive(Duration::ZERO).unwrap());
    assert!(prediction.into_frame().is_ok());
    node.interrupt();
    let said = node.rest();
    assert!(node.wait().success());
    assert!(said.contains("3 undecodable"), "{said}");
}

#[test]
fn on_zenoh_a_node_is_asked_for_its_parameters_set_and_reset() {
    const NODE: &str = "/eddy_node";
    let world = World::new(TransportKind::Zenoh);
    let mut node = world.node();
    let client = Client::of(world.ports[Role::Node as usize], world.domain);
    let horizon = || {
        let names = ParameterNames { names: vec!["horizon".to_owned(), "none".to_owned()] };
        let (name, kind) = (format!("{NODE}/get_parameters"), "rcl_interfaces/srv/GetParameters");
        let response: GetParametersResponse = client.ask(&name, kind, &names);
        assert_eq!(response.values[1], ParameterValue::default());
        response.values[0].integer_value
    };
    let set_horizon = |value| {
        let (name, value) = ("horizon".to_owned(), ParameterValue::integer(value));
        let request = SetParametersRequest { parameters: vec![Parameter { name, value }] };
        let (name, kind) = (format!("{NODE}/set_parameters"), "rcl_interfaces/srv/SetParameters");
        let response: SetParametersResponse = client.ask(&name, kind, &request);
        response.results[0].clone()
    };
    assert_eq!(horizon(), 1);
    assert!(set_horizon(20).successful);
    let refused = set_horizon(20_000);
    assert!(refused.reason.contains("expected 1 to 10000"), "{}", refused.reason);
    assert_eq!(horizon(), 20);
    let name = format!("{NODE}/reset");
    let reset: TriggerResponse = client.ask(&name, "std_srvs/srv/Trigger", &Empty::default());
    assert!(reset.success, "{}", reset.message);
    assert!(client.services().iter().any(|token| token.contains("%eddy_node%list_parameters")));
    node.interrupt();
    assert!(node.wait().success());
}

fn a_killed_process_leaves_the_others_running_and_works_again(transport: TransportKind) {
    let world = World::new(transport);
    let (truth, expected) = (
        world.frames("truth/scene_0000", "/particles").len(),
        world.frames("expected", "/prediction").len(),
    );

    // The node dies in the middle of a replay: player and recorder go on.
    let mut record = world.record("second_try", usize::MAX >> 1);
    let node = world.node();
    let mut replay = world.replay(0.25);
    wait_for("frames are recorded", || (world.recorded("second_try") > 100_000).then_some(()));
    node.kill();
    assert!(replay.wait().success(), "a replay goes on without its node");
    assert!(record.is_running());

    // The player dies: the new node and the recorder go on.
    let mut node = world.node();
    let replay = world.replay(0.25);
    // More than what the recorder still held of the first replay, which is one second at most.
    let before = world.recorded("second_try") + 3_000_000;
    wait_for("more is recorded", || (world.recorded("second_try") > before).then_some(()));
    replay.kill();
    assert!(node.is_running() && record.is_running());
    record.interrupt();
    assert!(record.wait().success());

    // The recorder dies: what it flushed is readable, and the node serves the next recorder.
    let record = world.record("killed", usize::MAX >> 1);
    let mut replay = world.replay(0.25);
    wait_for("frames are recorded", || (world.recorded("killed") > 100_000).then_some(()));
    record.kill();
    assert!(replay.wait().success(), "a replay goes on without its recorder");
    // The kill may have cut a chunk: then what is whole comes first, and an error after it.
    let killed = BagReader::open(Path::new(&world.path("killed"))).unwrap();
    let frames = killed.frames(&format!("{}/particles", world.prefix)).unwrap();
    assert!(frames.take_while(Result::is_ok).count() > 0);

    let mut record = world.record("third_try", truth + expected);
    assert!(world.replay(1.0).wait().success());
    assert!(record.wait().success());
    assert_eq!(
        world.frames("third_try", &format!("{}/prediction", world.prefix)),
        world.frames("expected", "/prediction")
    );
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn on_zenoh_a_killed_process_leaves_the_others_running_and_works_again() {
    a_killed_process_leaves_the_others_running_and_works_again(TransportKind::Zenoh);
}

#[test]
fn on_shared_memory_a_killed_process_leaves_the_others_running_and_works_again() {
    a_killed_process_leaves_the_others_running_and_works_again(TransportKind::Shm);
}
