//! Nodes of a group, each a process, that share the streams of a topic through a zenoh router.

use std::{
    collections::BTreeMap,
    fs::{self, File},
    io,
    net::{Shutdown, TcpListener, TcpStream},
    path::PathBuf,
    sync::{Arc, Mutex},
    thread,
    time::{Duration, Instant},
};

use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::checkpoint::Checkpoint;
use eddy_messages::{Message, ParticleFrame};
use eddy_transport::{
    Link, Membership, Publisher, Reliability, Subscriber, TransportOptions, Transports,
};
use tempfile::TempDir;

use crate::support::{
    DEADLINE, Process, Stalls, eddy, free_port, send, talking_eddy, unique, wait_for,
};

const STREAMS: u64 = 30;
/// Interval between two frames of a stream.
const INTERVAL: Duration = Duration::from_millis(50);
/// Streams of a dead node are predicted elsewhere within this time of their warm-up.
const HAND_OVER: Duration = Duration::from_secs(1);
/// Frames of every stream after a change of the group: more than a hand-over and a warm-up take.
const AFTER: u64 = 40;

/// A router, and this process's end of the network.
struct Network {
    folder: TempDir,
    port: u16,
    topic: String,
    transports: Transports,
    members: Box<dyn Membership>,
    _router: Process,
}

impl Network {
    /// The router is an idle node in zenoh's router mode.
    fn new() -> Self {
        let (port, topic) = (free_port(), format!("/{}", unique("group")));
        let overrides = format!(
            r#"mode="router";listen/endpoints=["tcp/127.0.0.1:{port}"];connect/endpoints=[]"#
        );
        let mut router = eddy();
        router.args(["node", "--input", &format!("zenoh:{topic}/none")]);
        router.args(["--output", &format!("zenoh:{topic}/nothing")]);
        router.env("ZENOH_CONFIG_OVERRIDE", overrides).env("ROS_DOMAIN_ID", "0");
        let router = Process::start(&mut router);
        wait_for("the router listens", || TcpStream::connect(("127.0.0.1", port)).ok());
        let mut options = TransportOptions::new("eddy_test");
        options.zenoh.overrides = client(port);
        let transports = Transports::new(options);
        let input = format!("zenoh:{topic}/particles").parse().unwrap();
        let members = transports.membership(&input, "robots", "observer").unwrap();
        Self {
            folder: tempfile::tempdir().unwrap(),
            port,
            topic,
            transports,
            members,
            _router: router,
        }
    }

    fn link(&self, name: &str) -> Link {
        format!("zenoh:{}/{name}", self.topic).parse().unwrap()
    }

    /// Starts a member of the group.
    fn node(&self, name: &str, options: &[&str]) -> Node {
        self.node_at(self.port, name, options)
    }

    /// Starts a member that connects to this port.
    fn node_at(&self, port: u16, name: &str, options: &[&str]) -> Node {
        let log = self.folder.path().join(name);
        let mut command = talking_eddy();
        command.args(["--log-level", "info", "node", "--threads", "1", "--group", "robots"]);
        command.args(["--input", &self.link("particles").to_string()]);
        command.args(["--output", &self.link("prediction").to_string()]).args(options);
        command.env("ZENOH_CONFIG_OVERRIDE", client(port)).env("ROS_DOMAIN_ID", "0");
        command.stderr(File::create(&log).unwrap());
        Node { process: Process::start(&mut command), log }
    }

    /// Starts nodes and waits until they have joined.
    fn nodes<const N: usize>(&self) -> [Node; N] {
        let nodes = std::array::from_fn(|number| self.node(&format!("node_{number}"), &[]));
        wait_for("the nodes join", || (self.members.members().len() == N).then_some(()));
        nodes
    }

    fn streams(&self) -> Streams {
        let kind = ParticleFrame::TYPE;
        let source = self.link("particles");
        Streams {
            source: self.transports.publisher(&source, kind, Reliability::Block).unwrap(),
            predictions: self.transports.subscriber(&self.link("prediction"), kind).unwrap(),
            start: Instant::now(),
            frames: 0,
            predicted: BTreeMap::new(),
            stalls: Stalls::watch(),
        }
    }
}

/// The configuration of a process that is connected to the router only.
fn client(port: u16) -> String {
    format!(r#"mode="client";connect/endpoints=["tcp/127.0.0.1:{port}"]"#)
}

/// A port that leads to the router, and whose connections can be cut.
struct Cable {
    port: u16,
    connections: Arc<Mutex<Vec<TcpStream>>>,
}

impl Cable {
    fn to(router: u16) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").unwrap();
        let port = listener.local_addr().unwrap().port();
        let connections = Arc::<Mutex<Vec<TcpStream>>>::default();
        let kept = Arc::clone(&connections);
        // Ends with the tests' process.
        thread::spawn(move || {
            for near in listener.incoming().map(Result::unwrap) {
                let far = TcpStream::connect(("127.0.0.1", router)).unwrap();
                for (from, to) in [(&near, &far), (&far, &near)] {
                    let (mut from, mut to) = (from.try_clone().unwrap(), to.try_clone().unwrap());
                    thread::spawn(move || {
                        let _ = io::copy(&mut from, &mut to); // ends with an error when it is cut
                        let _ = to.shutdown(Shutdown::Both);
                    });
                }
                kept.lock().unwrap().extend([near, far]);
            }
        });
        Self { port, connections }
    }

    fn cut(&self) {
        for connection in self.connections.lock().unwrap().drain(..) {
            let _ = connection.shutdown(Shutdown::Both); // the other side may have ended it
        }
    }
}

struct Node {
    process: Process,
    log: PathBuf,
}

impl Node {
    /// What it warns of in its group; its model has much to say about the frames of this test.
    fn warnings(&self) -> Vec<String> {
        self.lines("WARN eddy_node::surrogate::group")
    }

    /// The lines of its log that contain a text.
    fn lines(&self, text: &str) -> Vec<String> {
        let log = fs::read_to_string(&self.log).unwrap();
        log.lines().filter(|line| line.contains(text)).map(str::to_owned).collect()
    }
}

/// The streams, and what has been predicted of them.
struct Streams {
    source: Box<dyn Publisher>,
    predictions: Box<dyn Subscriber>,
    start: Instant,
    /// Published frames of each stream.
    frames: u64,
    /// When the predictions of a stream's frame arrived.
    predicted: BTreeMap<(u64, u64), Vec<Instant>>,
    stalls: Stalls,
}

impl Streams {
    /// Publishes the next frame of every stream, and receives until the one after it is due.
    fn advance(&mut self) {
        for stream in 0..STREAMS {
            self.source.publish_frame(&frame(stream, self.frames)).unwrap();
        }
        self.frames += 1;
        let next = self.start + INTERVAL * u32::try_from(self.frames).unwrap();
        // Behind time, what has arrived is received all the same.
        while self.receive(next.saturating_duration_since(Instant::now())) {}
    }

    fn receive(&mut self, timeout: Duration) -> bool {
        let Some(payload) = self.predictions.receive(timeout).unwrap() else { return false };
        let prediction = payload.into_frame().unwrap();
        // The node's horizon is one frame.
        let frame = (prediction.stream, prediction.sequence - 1);
        self.predicted.entry(frame).or_default().push(Instant::now());
        true
    }

    fn advance_by(&mut self, frames: u64) {
        (0..frames).for_each(|_| self.advance());
    }

    /// Advances until something has happened.
    fn advance_until(&mut self, what: &str, mut happened: impl FnMut(&Self) -> bool) {
        let start = Instant::now();
        while !happened(self) {
            assert!(start.elapsed() < DEADLINE, "waited {DEADLINE:?} until {what}");
            self.advance();
        }
    }

    /// Continues with the next frame now.
    fn resume(&mut self) {
        self.start = Instant::now() - INTERVAL * u32::try_from(self.frames).unwrap();
    }

    /// Advances until every stream is predicted.
    fn start(&mut self) {
        self.resume();
        self.advance_until("every stream is predicted", |streams| {
            (0..STREAMS).all(|stream| streams.of(stream).next().is_some())
        });
    }

    /// Receives until the last frame of every stream has been predicted.
    fn finish(&mut self) {
        let (start, last) = (Instant::now(), self.frames - 1);
        while (0..STREAMS).any(|stream| !self.predicted.contains_key(&(stream, last))) {
            assert!(start.elapsed() < DEADLINE, "the last frames were not predicted");
            self.receive(INTERVAL);
        }
        // One that comes twice comes at about the same time.
        while self.receive(2 * INTERVAL) {}
    }

    /// The predicted frames of a stream, in order.
    fn of(&self, stream: u64) -> impl Iterator<Item = (u64, Instant)> {
        let range = (stream, 0)..(stream + 1, 0);
        self.predicted.range(range).map(|(&(_, frame), arrived)| (frame, arrived[0]))
    }

    /// How many frames of a stream were not predicted, from its first prediction on.
    fn missing(&self, stream: u64) -> u64 {
        let first = self.of(stream).next().unwrap().0;
        self.frames - first - self.of(stream).count() as u64
    }

    fn missing_of_all(&self) -> Vec<u64> {
        (0..STREAMS).map(|stream| self.missing(stream)).collect()
    }

    /// How many streams have missed frames since [`Self::missing_of_all`].
    fn missed_more_than(&self, before: &[u64]) -> usize {
        let now = self.missing_of_all();
        now.iter().zip(before).filter(|(now, before)| now > before).count()
    }

    fn nothing_was_predicted_twice(&self) {
        let twice: Vec<_> =
            self.predicted.iter().filter(|(_, arrived)| arrived.len() > 1).collect();
        assert!(twice.is_empty(), "predicted more than once: {twice:?}");
    }

    /// The longest time between two predictions of a stream is that of a hand-over, a warm-up and an interval, on a machine that runs
    /// every thread when it is due.
    fn no_stream_was_silent_for_long(&self) {
        let warm_up = Checkpoint::shipped().unwrap().description.warm_up;
        for stream in 0..STREAMS {
            let arrivals: Vec<_> = self.of(stream).collect();
            for pair in arrivals.windows(2) {
                let [(before, from), (after, to)] = [pair[0], pair[1]];
                let silence = to.saturating_duration_since(from);
                assert!(
                    silence <= HAND_OVER + (warm_up + 1) * INTERVAL + self.stalls.delay(),
                    "stream {stream} was silent for {silence:?}, between frames {before} and {after}"
                );
            }
        }
    }
}

/// A body at rest.
fn frame(stream: u64, sequence: u64) -> Frame {
    Frame {
        stream,
        sequence,
        stamp: Stamp(0).advance(0.016, u32::try_from(sequence).unwrap()),
        dt: 0.016,
        domain: Domain::UNIT,
        position: (0..16_u8).map(|n| [0.3 + 0.02 * f32::from(n), 0.3]).collect(),
        velocity: vec![[0.0, 0.0]; 16],
        material: vec![Material::Jelly; 16],
    }
}

#[test]
fn every_frame_is_predicted_once_and_streams_of_a_killed_node_by_the_others_within_a_second() {
    let network = Network::new();
    let [killed, _others @ ..] = network.nodes::<3>();
    let mut streams = network.streams();
    streams.start();
    streams.advance_by(20);
    streams.finish();
    streams.nothing_was_predicted_twice();
    let before = streams.missing_of_all();
    assert!(streams.stalls.are_long() || before.iter().all(|missing| *missing == 0), "{before:?}");

    streams.resume();
    streams.advance();
    killed.process.kill();
    streams.advance_by(AFTER);
    streams.finish();
    streams.nothing_was_predicted_twice();
    streams.no_stream_was_silent_for_long();
    assert_eq!(network.members.members().len(), 2);
    let moved = streams.missed_more_than(&before);
    assert!((1..STREAMS as usize).contains(&moved), "{moved} of {STREAMS} streams missed frames");
}

#[test]
fn streams_move_to_a_node_that_joins_and_from_those_that_end_and_no_frame_is_predicted_twice() {
    let network = Network::new();
    let mut nodes = network.nodes::<2>();
    let mut streams = network.streams();
    streams.start();
    let before = streams.missing_of_all();
    let mut joining = network.node("joining", &[]);
    streams.advance_until("the node joins", |_| network.members.members().len() == 3);
    streams.advance_by(AFTER);
    streams.nothing_was_predicted_twice();
    streams.no_stream_was_silent_for_long();
    let moved = streams.missed_more_than(&before);
    assert!((1..STREAMS as usize).contains(&moved), "{moved} of {STREAMS} streams missed frames");

    nodes.iter().for_each(|node| node.process.interrupt());
    streams.advance_until("both leave", |_| network.members.members().len() == 1);
    streams.advance_by(AFTER);
    streams.finish();
    streams.nothing_was_predicted_twice();
    streams.no_stream_was_silent_for_long();
    nodes.iter_mut().for_each(|node| assert!(node.process.wait().success()));
    assert!(joining.process.is_running());
    assert_eq!(joining.lines("joined, 3 members").len(), 1);
    assert_eq!(joining.warnings(), [""; 0]);
}

#[test]
fn a_node_that_was_paused_says_so_once_and_joins_again_and_nothing_is_published_twice() {
    let network = Network::new();
    let [paused, mut other] = network.nodes::<2>();
    let members = || network.members.members();
    let (before, mut streams) = (members(), network.streams());
    streams.start();
    send("-STOP", &paused.process);
    streams.advance_until("the lease ends", |_| members().len() == 1);
    streams.advance_by(AFTER);
    streams.no_stream_was_silent_for_long();
    let kept = members();
    assert!(kept.is_subset(&before), "{kept:?} of {before:?}");

    send("-CONT", &paused.process);
    streams.advance_until("it joins again", |_| members().len() == 2);
    assert_eq!(members().intersection(&before).cloned().collect::<Vec<_>>(), Vec::from_iter(kept));
    streams.advance_by(AFTER);
    streams.finish();
    streams.nothing_was_predicted_twice();
    streams.no_stream_was_silent_for_long();
    let said = paused.lines("stood still for");
    assert_eq!(said.len(), 1, "{said:?}");
    assert!(said[0].contains("it resets them and joins again"), "{said:?}");
    assert_eq!(paused.warnings(), said);
    assert_eq!(other.warnings(), [""; 0]);
    assert!(other.process.is_running());
}

/// It connects again at once, and with it comes the token of the id that the others took for dead.
#[test]
fn a_node_whose_connection_breaks_joins_again_under_another_id_and_nothing_is_published_twice() {
    let network = Network::new();
    let cable = Cable::to(network.port);
    let cut = network.node_at(cable.port, "cut", &[]);
    let others = [network.node("one", &[]), network.node("two", &[])];
    let members = || network.members.members();
    wait_for("the nodes join", || (members().len() == 3).then_some(()));
    let (before, mut streams) = (members(), network.streams());
    streams.start();
    cable.cut();
    streams.advance_until("it leaves", |_| !before.is_subset(&members()));
    streams.advance_until("it joins again", |_| members().len() == 3 && members() != before);
    streams.advance_by(AFTER);
    streams.finish();
    streams.nothing_was_predicted_twice();
    streams.no_stream_was_silent_for_long();
    assert_eq!(members().intersection(&before).count(), 2);
    assert_eq!(cut.lines("lost all connections").len(), 1, "{:?}", cut.lines(""));
    others.iter().for_each(|other| assert_eq!(other.warnings(), [""; 0]));
}

#[test]
fn a_member_that_starts_with_other_settings_is_named_in_the_log_of_the_others() {
    let network = Network::new();
    let nodes = [network.node("one", &[]), network.node("two", &["--horizon", "2"])];
    for node in &nodes {
        let line = wait_for("it names the other", || node.warnings().pop());
        assert!(line.contains("group robots: 1 member started with another checkpoint"), "{line}");
    }
}

#[test]
fn a_group_needs_an_input_on_zenoh() {
    let arguments = ["node", "--group", "robots", "--input", "shm:/a", "--output", "shm:/b"];
    let said = crate::support::fail(2, arguments);
    assert!(said.contains("group: found the input shm:/a, expected one on zenoh"), "{said}");
}
