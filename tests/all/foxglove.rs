//! A node as Foxglove's application sees it: its WebSocket protocol (`foxglove.sdk.v1`), spoken here from the outside.

use std::{
    collections::BTreeMap,
    net::{TcpListener, TcpStream},
    sync::atomic::{AtomicBool, AtomicU32, Ordering},
    thread,
    time::Instant,
};

use eddy_messages::{
    DiagnosticArray, Message as _, PointCloud2, PredictionStatus, cdr, cloud::point_step,
};
use eddy_transport::{FoxgloveServer, ListenAddress};
use serde_json::{Value, json};
use tungstenite::{HandshakeError, Message, WebSocket, client::IntoClientRequest as _};

use crate::support::{DEADLINE, Process, World, eddy, fail, simulate, wait_for};

/// A viewer.
struct Viewer(WebSocket<TcpStream>);

impl Viewer {
    fn connect(address: &str) -> Self {
        Self::of_page(address, None).unwrap()
    }

    /// A viewer in a page of `origin`, or the status of the response if it is refused.
    fn of_page(address: &str, origin: Option<&str>) -> Result<Self, Option<u16>> {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(DEADLINE)).unwrap();
        let mut request = format!("ws://{address}").into_client_request().unwrap();
        let protocol = "foxglove.sdk.v1".parse().unwrap();
        request.headers_mut().insert("Sec-WebSocket-Protocol", protocol);
        if let Some(origin) = origin {
            request.headers_mut().insert("Origin", origin.parse().unwrap());
        }
        match tungstenite::client(request, stream) {
            Ok((socket, _)) => Ok(Self(socket)),
            Err(HandshakeError::Failure(tungstenite::Error::Http(answer))) => {
                Err(Some(answer.status().as_u16()))
            }
            Err(_) => Err(None),
        }
    }

    /// What the server says in words, until it says `op`.
    fn said(&mut self, op: &str) -> Value {
        loop {
            if let Message::Text(text) = self.0.read().unwrap() {
                let said: Value = serde_json::from_str(&text).unwrap();
                if said["op"] == op {
                    return said;
                }
            }
        }
    }

    /// The channels by topic, once there are `count`.
    fn channels(&mut self, count: usize) -> BTreeMap<String, Value> {
        let mut channels = BTreeMap::new();
        while channels.len() < count {
            for channel in self.said("advertise")["channels"].as_array().unwrap() {
                channels.insert(channel["topic"].as_str().unwrap().to_owned(), channel.clone());
            }
        }
        channels
    }

    /// Shows a channel, its data as that of subscription `id`.
    fn subscribe(&mut self, id: u32, channel: &Value) {
        let subscription = json!({ "id": id, "channelId": channel["id"] });
        let words = json!({ "op": "subscribe", "subscriptions": [subscription] });
        self.0.send(Message::text(words.to_string())).unwrap();
    }

    /// The next message: its subscription, its bytes.
    fn message(&mut self) -> (u32, Vec<u8>) {
        const HEAD: usize = 1 + 4 + 8;
        let deadline = Instant::now() + DEADLINE;
        while Instant::now() < deadline {
            match self.0.read().unwrap() {
                Message::Binary(bytes) if bytes.first() == Some(&1) => {
                    let id = u32::from_le_bytes(bytes[1..5].try_into().unwrap());
                    return (id, bytes[HEAD..].to_vec());
                }
                _ => {}
            }
        }
        panic!("no message within {DEADLINE:?}");
    }

    /// The number that the next message begins with.
    fn number(&mut self) -> u32 {
        u32::from_le_bytes(self.message().1[..4].try_into().unwrap())
    }
}

#[test]
#[expect(clippy::too_many_lines, reason = "one story: a node, a client, what it is shown")]
fn clouds_status_and_diagnostics_of_a_node_are_shown() {
    let world = World::new("foxglove");
    simulate(world.folder.path().join("truth").as_path(), 1, 2.0);
    let bag = world.folder.path().join("truth/scene_0000");
    let [input, output] = ["particles", "prediction"].map(|name| world.link("shm", name));
    let mut node = Process::start(eddy().args(["node", "--input", &input.to_string()]).args([
        "--output",
        &output.to_string(),
        "--foxglove",
        "0",
        "--ros-args",
        "-r",
        "/diagnostics:=~/diagnostics",
    ]));
    let line = node.line("foxglove: ws://");
    let address = line.trim().trim_start_matches("foxglove: ws://");
    let remap = format!("/particles:={}", input.topic);
    let mut replay = Process::start(eddy().arg("replay").arg(bag).args([
        "--to",
        "shm",
        "--loop",
        "--remap",
        &remap,
        "--wait-for",
        "1",
    ]));

    let mut viewer = Viewer::connect(address);
    assert!(viewer.said("serverInfo")["name"].as_str().unwrap().starts_with('/'));
    let clouds = [&input, &output].map(|link| format!("{}/cloud", link.topic));
    let status = format!("{}/status", output.topic);
    let topics = [&clouds[0], &clouds[1], &status, "/eddy_node/diagnostics"];
    let types =
        [PointCloud2::TYPE, PointCloud2::TYPE, PredictionStatus::TYPE, DiagnosticArray::TYPE];
    let channels = viewer.channels(topics.len());
    for (number, (topic, type_name)) in (0..).zip(topics.into_iter().zip(types)) {
        let channel = &channels[topic];
        assert_eq!(channel["schemaName"], type_name, "{channel}");
        assert_eq!(
            (&channel["encoding"], &channel["schemaEncoding"]),
            (&json!("cdr"), &json!("ros2msg"))
        );
        assert!(!channel["schema"].as_str().unwrap().is_empty());
        viewer.subscribe(number, channel);
    }

    let mut shown = BTreeMap::new();
    let deadline = Instant::now() + DEADLINE;
    // The first report of a node may be about a time without frames.
    let rate = |shown: &BTreeMap<u32, Vec<u8>>| {
        let diagnostics: DiagnosticArray = cdr::decode(shown.get(&3)?).unwrap();
        let rate = diagnostics.status[0].values.iter().find(|value| value.key == "rate (1/s)");
        Some(rate.unwrap().value.parse::<f64>().unwrap()).filter(|rate| *rate > 0.0)
    };
    while shown.len() < topics.len() || rate(&shown).is_none() {
        assert!(Instant::now() < deadline, "only {:?}, rate {:?}", shown.keys(), rate(&shown));
        let (number, bytes) = viewer.message();
        shown.insert(number, bytes);
    }
    let [observed, predicted] = [0, 1].map(|number| {
        let cloud: PointCloud2 = cdr::decode(&shown[&number]).unwrap();
        cloud.width * cloud.height
    });
    assert!(observed > 0);
    assert_eq!(observed, predicted);
    let status: PredictionStatus = cdr::decode(&shown[&2]).unwrap();
    assert!(status.horizon == 1 && status.latency > 0.0, "{status:?}");

    for process in [&mut replay, &mut node] {
        process.interrupt();
        assert!(process.wait().success());
    }
}

#[test]
fn an_address_that_cannot_be_had_is_named() {
    let taken = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = taken.local_addr().unwrap().to_string();
    let world = World::new("taken");
    let [input, output] = ["a", "b"].map(|name| world.link("shm", name).to_string());
    let said = fail(1, ["node", "--input", &input, "--output", &output, "--foxglove", &address]);
    assert!(said.contains(&format!("--foxglove: {address}: found ")), "{said}");
    assert!(said.contains("expected a free port"), "{said}");
}

#[test]
fn a_viewer_that_never_reads_costs_messages_and_nothing_else() {
    const PARTICLES: usize = 100_000;
    // More than any buffer of a socket holds.
    const READ: usize = 50;
    let server = FoxgloveServer::start(ListenAddress::<8765>::loopback(0), "flood", &[]).unwrap();
    let address = server.address().to_string();
    let mut publisher = server.publisher("/cloud", PointCloud2::TYPE).unwrap();
    let mut silent = Viewer::connect(&address);
    let channel = silent.channels(1)["/cloud"].clone();
    assert_eq!(publisher.subscribers(), 0, "nobody shows it");
    silent.subscribe(1, &channel);
    wait_for("it is shown", || (publisher.subscribers() > 0).then_some(()));
    let mut reader = Viewer::connect(&address);
    let channel = reader.channels(1)["/cloud"].clone();
    reader.subscribe(1, &channel);

    let (stop, published) = (AtomicBool::new(false), AtomicU32::new(0));
    let read = thread::scope(|scope| {
        let _stopping = Raise(&stop);
        scope.spawn(|| {
            while !stop.load(Ordering::Relaxed) {
                let number = published.fetch_add(1, Ordering::Relaxed);
                let mut bytes = vec![0; PARTICLES * point_step(2)];
                bytes[..4].copy_from_slice(&number.to_le_bytes());
                publisher.publish_cdr(&bytes).unwrap();
            }
        });
        (0..READ).map(|_| reader.number()).collect::<Vec<_>>()
    });
    assert!(read.is_sorted_by(|a, b| a < b), "{read:?}");

    // What waited for the silent one is what the sockets and a few messages hold, the last one among it.
    let (published, mut waited) = (published.into_inner(), 1);
    while silent.number() + 1 < published {
        waited += 1;
    }
    assert!(waited < published / 2, "{waited} of {published} waited");
}

/// Raises a flag when it goes, also when a test fails.
struct Raise<'a>(&'a AtomicBool);

impl Drop for Raise<'_> {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

#[test]
fn foreign_pages_and_too_many_viewers_are_refused() {
    const MAX_CONNECTIONS: usize = 32;
    let own = ["http://robot:8080".to_owned()];
    let server = FoxgloveServer::start(ListenAddress::<8765>::loopback(0), "gate", &own).unwrap();
    let address = server.address().to_string();
    for origin in ["http://evil.example", "null", &format!("http://{address}")] {
        assert_eq!(Viewer::of_page(&address, Some(origin)).err(), Some(Some(403)), "{origin}");
    }
    let mut viewers = Vec::new();
    for origin in ["https://app.foxglove.dev", "http://robot:8080"] {
        viewers
            .push(Viewer::of_page(&address, Some(origin)).unwrap_or_else(|_| panic!("{origin}")));
    }
    wait_for("there are as many as there may be", || {
        match Viewer::of_page(&address, None) {
            Ok(viewer) => viewers.push(viewer),
            Err(status) => {
                // The response may be lost with the connection.
                assert!(status.is_none_or(|status| status == 503), "{status:?}");
                return Some(());
            }
        }
        assert!(viewers.len() <= MAX_CONNECTIONS);
        None
    });
    assert_eq!(viewers.len(), MAX_CONNECTIONS);
    for viewer in &mut viewers {
        assert_eq!(viewer.said("serverInfo")["name"], "gate");
    }
    drop(viewers);
    wait_for("there is room again", || Viewer::of_page(&address, None).ok());
    // Requests that are never completed make room when their time is over.
    let half: Vec<_> =
        (0..MAX_CONNECTIONS).map(|_| TcpStream::connect(&address).unwrap()).collect();
    let mut viewer = wait_for("they make room", || Viewer::of_page(&address, None).ok());
    viewer.said("serverInfo");
    drop(half);
    drop(server);
    let start = Instant::now();
    while viewer.0.read().is_ok() {}
    assert!(start.elapsed() < DEADLINE, "the connection ends with the server");
}
