//! A node among programs that send what they should not: counted, named in `/diagnostics`, and the rest goes
//! on.

use std::{
    collections::BTreeMap,
    fs,
    process::Command,
    sync::{
        LazyLock,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use eddy_frames::{Frame, Material, Stamp};
use eddy_inference::checkpoint::{Checkpoint, Description};
use eddy_messages::{DiagnosticArray, Message, ParticleFrame, RosString, cdr};
use eddy_transport::{Link, Publisher, Reliability, Subscriber};

use crate::support::{DEADLINE, Process, World, simulate, talking_eddy, unique, wait_for, word};

/// Particles of a frame: enough for a flood to be too much.
const PARTICLES: usize = 2_500;

/// A node with its input on one transport; its predictions and its state are read over Zenoh.
struct Scene {
    world: World,
    input: Link,
    node: Process,
    predictions: Box<dyn Subscriber>,
    diagnostics: Box<dyn Subscriber>,
}

impl Scene {
    fn new(transport: &str) -> Self {
        let world = World::new("hostile");
        let (input, output) =
            (world.link(transport, "particles"), world.link("zenoh", "prediction"));
        let subscribe = |link: &Link, of: &str| world.transports.subscriber(link, of).unwrap();
        let predictions = subscribe(&output, ParticleFrame::TYPE);
        let diagnostics = subscribe(&output.with_topic("/diagnostics"), DiagnosticArray::TYPE);
        let mut command = talking_eddy();
        command.env("ZENOH_CONFIG_OVERRIDE", &world.overrides);
        command.args(["node", "--input", &input.to_string(), "--output", &output.to_string()]);
        let node = Process::start_until(&mut command, "predicting");
        Self { world, input, node, predictions, diagnostics }
    }

    fn publisher(&self, reliability: Reliability) -> Box<dyn Publisher> {
        let publisher =
            self.world.transports.publisher(&self.input, ParticleFrame::TYPE, reliability).unwrap();
        wait_for("the node listens", || (publisher.subscribers() > 0).then_some(()));
        publisher
    }

    /// Publishes a new stream slowly until there is a prediction of it.
    fn predicts(&mut self, publisher: &mut dyn Publisher, stream: u64) {
        let start = Instant::now();
        for sequence in 0.. {
            publisher.publish_frame(&frame(stream, sequence, 50)).unwrap();
            let next = self.predictions.receive(Duration::from_millis(50)).unwrap();
            let predicted = next.and_then(|payload| payload.into_frame().ok());
            if predicted.is_some_and(|frame| frame.stream == stream) {
                return;
            }
            assert!(start.elapsed() < DEADLINE, "no prediction of stream {stream}");
        }
    }

    /// Waits until the node reports so: its counters by name, and its message.
    fn reports(&mut self, mut so: impl FnMut(&BTreeMap<String, String>, &str) -> bool) {
        let mut last = String::new();
        let start = Instant::now();
        while start.elapsed() < DEADLINE {
            let next = self.diagnostics.receive(Duration::from_millis(200)).unwrap();
            let Some(payload) = next else { continue };
            let report: DiagnosticArray = cdr::decode(&payload.into_cdr()).unwrap();
            let status = &report.status[0];
            let values = status.values.iter().map(|v| (v.key.clone(), v.value.clone())).collect();
            if so(&values, &status.message) {
                return;
            }
            last = format!("{}: {values:?}", status.message);
        }
        panic!("the node reports: {last}");
    }

    fn end(mut self) {
        assert!(self.node.is_running());
        self.node.interrupt();
        assert!(self.node.wait().success());
    }
}

/// A frame that the shipped model takes: a block of water at rest.
fn frame(stream: u64, sequence: u64, particles: usize) -> Frame {
    static DESCRIPTION: LazyLock<Description> =
        LazyLock::new(|| Checkpoint::shipped().unwrap().description);
    let description = &*DESCRIPTION;
    let place = |n: usize| [0.2 + 0.007 * (n % 50) as f32, 0.1 + 0.007 * (n / 50) as f32];
    Frame {
        stream,
        sequence,
        stamp: Stamp(0).advance(description.dt, sequence as u32),
        dt: description.dt,
        domain: description.domain,
        position: (0..particles).map(place).collect(),
        velocity: vec![[0.0; 2]; particles],
        material: vec![Material::Liquid; particles],
    }
}

fn count(values: &BTreeMap<String, String>, key: &str) -> u64 {
    values[key].parse().unwrap()
}

fn what_is_no_frame_is_counted_and_named(transport: &str) {
    let mut scene = Scene::new(transport);
    let mut publisher = scene.publisher(Reliability::Block);
    scene.predicts(&mut *publisher, 1);
    let mut expected = vec![("not_finite", 5), ("wrong_interval", 5)];
    for sequence in 0..5 {
        let mut bad = frame(2, sequence, 50);
        bad.position[7] = [f32::NAN, 0.5];
        publisher.publish_frame(&bad).unwrap();
        let other = Frame { dt: 0.5, ..frame(3, sequence, 50) };
        publisher.publish_frame(&other).unwrap();
        if transport == "zenoh" {
            // Bytes under our key and of our type, by their own account.
            publisher.publish_cdr(&[0, 1, 0, 0, 255, 255, 255, 255, 1]).unwrap();
        }
    }
    if transport == "zenoh" {
        expected.push(("undecodable", 5));
        // Another type is another key: it does not reach the node at all.
        let link = &scene.input;
        let transports = &scene.world.transports;
        let mut words = transports.publisher(link, RosString::TYPE, Reliability::Drop).unwrap();
        words.publish_cdr(&word("hello")).unwrap();
    }
    let mut refusal = String::new();
    scene.reports(|values, message| {
        if message.starts_with("frame rejected: ") {
            message.clone_into(&mut refusal);
        }
        expected.iter().all(|(key, number)| count(values, key) == *number)
    });
    assert!(refusal.contains("found") || refusal.contains("CDR body"), "{refusal}");
    scene.predicts(&mut *publisher, 4);
    scene.reports(|_, message| message == "predicting");
    scene.end();
}

#[test]
fn on_zenoh_what_is_no_frame_is_counted_and_named() {
    what_is_no_frame_is_counted_and_named("zenoh");
}

#[test]
fn on_shared_memory_what_is_no_frame_is_counted_and_named() {
    what_is_no_frame_is_counted_and_named("shm");
}

/// As many large frames as a publisher that waits for nobody can send: far more than ten times as many as
/// the node can predict from. A slow stream has its predictions meanwhile.
fn a_flood_is_counted_and_the_rest_goes_on(transport: &str) {
    let mut scene = Scene::new(transport);
    let mut slow = scene.publisher(Reliability::Block);
    scene.predicts(&mut *slow, 1);
    let mut flood = scene.publisher(Reliability::Drop);
    let frames: Vec<Frame> = (0..200).map(|sequence| frame(2, sequence, PARTICLES)).collect();
    let over = AtomicBool::new(false);
    thread::scope(|scope| {
        let sending = scope.spawn(|| {
            let mut sent = 0_u64;
            while !over.load(Ordering::Relaxed) {
                for frame in &frames {
                    flood.publish_frame(frame).unwrap();
                    sent += 1;
                }
            }
            sent
        });
        let outcome = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| {
            scene.reports(|values, message| {
                let lost = ["lost_in_queue", "lost_in_transport", "lost_in_gaps", "late"];
                let lost: u64 = lost.iter().map(|key| count(values, key)).sum();
                lost > 10 && message != "predicting"
            });
            scene.predicts(&mut *slow, 3);
        }));
        over.store(true, Ordering::Relaxed);
        assert!(sending.join().unwrap() > 0);
        outcome.unwrap();
    });
    scene.predicts(&mut *slow, 4);
    scene.reports(|_, message| message == "predicting");
    scene.end();
}

#[test]
fn on_zenoh_a_flood_is_counted_and_a_slow_stream_beside_it_goes_on() {
    a_flood_is_counted_and_the_rest_goes_on("zenoh");
}

#[test]
fn on_shared_memory_a_flood_is_counted_and_a_slow_stream_beside_it_goes_on() {
    a_flood_is_counted_and_the_rest_goes_on("shm");
}

/// Players that are killed while they publish, each at another moment.
fn publishers_that_die_leave_the_node_running(transport: &str) {
    let mut scene = Scene::new(transport);
    let truth = scene.world.folder.path().join("truth");
    simulate(&truth, 1, 0.5);
    let bag = fs::read_dir(&truth).unwrap().map(|entry| entry.unwrap().path());
    let bag = bag.filter(|path| path.is_dir()).min().unwrap();
    let remap = format!("/particles:={}/particles", scene.world.prefix);
    // One port for all of them: each is gone when the next one starts.
    let [ours, theirs] = [&scene.world.overrides, "connect/endpoints="];
    let listening = ours.split(theirs).next().unwrap().replace("listen", "connect");
    for turn in 0..12 {
        let mut command: Command = talking_eddy();
        command.env("ZENOH_CONFIG_OVERRIDE", format!("listen/endpoints=[];{listening}"));
        command.arg("replay").arg(&bag).args(["--to", transport, "--loop", "--rate", "20"]);
        command.args(["--remap", &remap, "--wait-for", "1"]);
        let player = Process::start_until(&mut command, "publishing");
        let before = count_of(&mut scene, "received");
        wait_for("frames arrive", || (count_of(&mut scene, "received") > before).then_some(()));
        thread::sleep(Duration::from_millis(turn * 7));
        player.kill();
        assert!(scene.node.is_running());
    }
    let mut publisher = scene.publisher(Reliability::Block);
    scene.predicts(&mut *publisher, 77);
    scene.end();
}

/// A counter, as the node reports it next.
fn count_of(scene: &mut Scene, key: &str) -> u64 {
    let mut found = 0;
    scene.reports(|values, _| {
        found = count(values, key);
        true
    });
    found
}

#[test]
fn on_zenoh_publishers_that_die_leave_the_node_running() {
    publishers_that_die_leave_the_node_running("zenoh");
}

#[test]
fn on_shared_memory_publishers_that_die_leave_the_node_running() {
    publishers_that_die_leave_the_node_running("shm");
}

/// The addresses of the sockets of a process in one of the system's tables, as the table writes them, where
/// `state` is what its fourth column says.
#[cfg(target_os = "linux")]
fn addresses(process: u32, table: &str, state: &str) -> Vec<String> {
    let links = fs::read_dir(format!("/proc/{process}/fd")).unwrap();
    let sockets: Vec<String> = links
        .filter_map(|entry| fs::read_link(entry.unwrap().path()).ok())
        .filter_map(|link| {
            let link = link.to_str()?.to_owned();
            Some(link.strip_prefix("socket:[")?.strip_suffix(']')?.to_owned())
        })
        .collect();
    let table = fs::read_to_string(format!("/proc/net/{table}")).unwrap_or_default();
    let rows = table.lines().skip(1).map(|row| row.split_whitespace().collect::<Vec<_>>());
    rows.filter(|row| row[3] == state && sockets.iter().any(|socket| socket == row[9]))
        .map(|row| row[1].to_owned())
        .collect()
}

#[cfg(target_os = "linux")]
#[test]
fn nothing_listens_beyond_this_machine_unless_it_is_told_to() {
    let prefix = unique("loopback");
    let mut command = talking_eddy();
    command.args(["node", "--input", &format!("zenoh:/{prefix}/in")]);
    command.args(["--output", &format!("zenoh:/{prefix}/out")]);
    command.env_remove("ZENOH_CONFIG_OVERRIDE").env_remove("ZENOH_SESSION_CONFIG_URI");
    let node = Process::start_until(&mut command, "predicting");
    const LISTEN: &str = "0A";
    let found: Vec<String> =
        ["tcp", "tcp6"].iter().flat_map(|table| addresses(node.id(), table, LISTEN)).collect();
    // 127.0.0.1 and ::1 as the tables write them.
    let loopback = ["0100007F:", "00000000000000000000000001000000:"];
    assert!(!found.is_empty());
    assert!(
        found.iter().all(|address| loopback.iter().any(|start| address.starts_with(start))),
        "{found:?}"
    );
    // Neither does it look for others there.
    let beyond: Vec<String> =
        ["udp", "udp6"].iter().flat_map(|table| addresses(node.id(), table, "07")).collect();
    assert_eq!(beyond, [""; 0]);
}
