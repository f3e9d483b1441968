//! The live page from outside: HTTP, WebSocket, and what its controls do to the program.

mod limits;

use std::{
    io::{Read as _, Write as _},
    net::TcpStream,
    sync::{Arc, Mutex, mpsc},
    time::{Duration, Instant},
};

use eddy_frames::{Domain, Frame, FrameView, Material, Stamp};
use eddy_inference::checkpoint::Checkpoint;
use eddy_messages::{Message as _, ParticleFrame};
use eddy_node::viewer::{
    Comparison, ControlState, Controls, HEADER, Hub, NoControls, PageCommand, PageInfo,
    PredictionInfo, Viewer,
};
use eddy_transport::ListenAddress;
use serde_json::{Value, json};
use tungstenite::{Message, WebSocket, client::IntoClientRequest as _};

use crate::support::{DEADLINE, Process, World, eddy, fail, simulate, wait_for};

/// A browser that draws nothing.
struct Browser {
    socket: WebSocket<TcpStream>,
    /// The last metrics.
    metrics: Value,
    /// Frames that were drawn while an outcome was waited for.
    drawn: Vec<Shown>,
}

/// The header of a frame.
#[derive(Clone, Debug, PartialEq)]
struct Shown {
    flags: u32,
    particles: usize,
    ahead: u32,
    stream: u64,
    sequences: [u64; 2],
    errors: [f32; 2],
}

const TRUTH: u32 = 1;
const PREDICTION: u32 = 2;
const PAIR: u32 = 4;
const FREE: u32 = 8;

impl Shown {
    fn read(bytes: &[u8]) -> Self {
        let u32_at = |at: usize| u32::from_le_bytes(bytes[at..at + 4].try_into().unwrap());
        let u64_at = |at: usize| u64::from_le_bytes(bytes[at..at + 8].try_into().unwrap());
        assert_eq!(&bytes[..4], b"EDY\x03");
        let particles = u32_at(8) as usize;
        assert_eq!(bytes.len(), HEADER + 12 * particles);
        Self {
            flags: u32_at(4),
            particles,
            ahead: u32_at(12),
            stream: u64_at(16),
            sequences: [u64_at(24), u64_at(32)],
            errors: [76, 80].map(|at| f32::from_bits(u32_at(at))),
        }
    }

    fn has(&self, flags: u32) -> bool {
        self.flags & flags == flags
    }
}

impl Browser {
    fn connect(address: &str, origin: &str) -> Result<Self, tungstenite::Error> {
        Self::request(address, "/ws", origin, "")
    }

    /// On the page at `address`, with a cookie.
    fn connect_as(address: &str, path: &str, cookie: &str) -> Self {
        Self::request(address, path, &format!("http://{address}"), cookie).unwrap()
    }

    fn request(
        address: &str,
        path: &str,
        origin: &str,
        cookie: &str,
    ) -> Result<Self, tungstenite::Error> {
        let stream = TcpStream::connect(address).unwrap();
        stream.set_read_timeout(Some(DEADLINE)).unwrap();
        let mut request = format!("ws://{address}{path}").into_client_request()?;
        request.headers_mut().insert("Origin", origin.parse().unwrap());
        request.headers_mut().insert("Cookie", cookie.parse().unwrap());
        match tungstenite::client(request, stream) {
            Ok((socket, _)) => Ok(Self { socket, metrics: Value::Null, drawn: Vec::new() }),
            Err(tungstenite::HandshakeError::Failure(error)) => Err(error),
            Err(error) => panic!("{error}"),
        }
    }

    /// On the page at `address`, greeted.
    fn open(address: &str) -> (Self, Value) {
        let mut browser = Self::connect(address, &format!("http://{address}")).unwrap();
        let hello = browser.words("hello");
        (browser, hello)
    }

    fn say(&mut self, words: Value) {
        self.socket.send(Message::text(words.to_string())).unwrap();
    }

    /// What comes next: words, or the bytes of a frame.
    fn next(&mut self) -> Result<Value, Vec<u8>> {
        loop {
            match self.socket.read().unwrap() {
                Message::Text(text) => {
                    let words: Value = serde_json::from_str(&text).unwrap();
                    if words["type"] == "metrics" {
                        self.metrics = words.clone();
                    }
                    return Ok(words);
                }
                Message::Binary(bytes) => return Err(bytes.to_vec()),
                _ => {}
            }
        }
    }

    /// The next words of this type; frames before it are not drawn.
    fn words(&mut self, kind: &str) -> Value {
        let start = Instant::now();
        loop {
            if let Ok(words) = self.next()
                && words["type"] == kind
            {
                return words;
            }
            assert!(start.elapsed() < DEADLINE, "no {kind} comes");
        }
    }

    /// Draws frames until one is as wanted.
    fn until(&mut self, what: &str, wanted: impl Fn(&Shown) -> bool) -> Shown {
        let start = Instant::now();
        loop {
            if let Err(bytes) = self.next() {
                self.say(json!({ "drawn": 1 }));
                let shown = Shown::read(&bytes);
                if wanted(&shown) {
                    return shown;
                }
            }
            assert!(start.elapsed() < DEADLINE, "waited until {what}: {}", self.metrics);
        }
    }

    /// Figures until they are as wanted; frames are drawn meanwhile.
    fn metrics_until(&mut self, what: &str, wanted: impl Fn(&Value) -> bool) -> Value {
        let start = Instant::now();
        loop {
            match self.next() {
                Ok(words) if words["type"] == "metrics" && wanted(&words) => return words,
                Ok(_) => {}
                Err(_) => self.say(json!({ "drawn": 1 })),
            }
            assert!(start.elapsed() < DEADLINE, "waited until {what}: {}", self.metrics);
        }
    }

    /// Frames that have come since something was asked for, until three metrics came and no frame.
    fn rest(&mut self) -> Vec<Shown> {
        let (mut frames, mut quiet) = (std::mem::take(&mut self.drawn), 0);
        while quiet < 3 {
            match self.next() {
                Ok(words) if words["type"] == "metrics" => quiet += 1,
                Ok(_) => {}
                Err(bytes) => {
                    quiet = 0;
                    frames.push(Shown::read(&bytes));
                    self.say(json!({ "drawn": 1 }));
                }
            }
        }
        frames
    }

    /// Waits until no more frames come.
    fn until_quiet(&mut self, what: &str) {
        let start = Instant::now();
        while !self.rest().is_empty() {
            assert!(start.elapsed() < DEADLINE, "{what}");
        }
    }

    /// Asks for a step of what is paused. Returns the sequence of the one frame that it shows.
    fn step(&mut self) -> u64 {
        self.done(json!({ "do": "step" }));
        let start = Instant::now();
        loop {
            // On a busy machine the frame may be shown first without its prediction.
            if let [first, more @ ..] = &self.rest()[..] {
                assert!(more.iter().all(|shown| shown.sequences[0] == first.sequences[0]));
                return first.sequences[0];
            }
            assert!(start.elapsed() < DEADLINE, "no frame comes");
        }
    }

    /// Asks for something, and waits for what becomes of it.
    fn ask(&mut self, command: Value) -> Value {
        self.drawn.clear();
        self.say(command);
        let start = Instant::now();
        loop {
            match self.next() {
                Ok(words) if words["type"] == "outcome" => return words,
                Ok(_) => {}
                Err(bytes) => {
                    self.drawn.push(Shown::read(&bytes));
                    self.say(json!({ "drawn": 1 }));
                }
            }
            assert!(start.elapsed() < DEADLINE, "no outcome comes");
        }
    }

    fn done(&mut self, command: Value) {
        let outcome = self.ask(command);
        assert_eq!(outcome["done"], true, "{outcome}");
    }
}

/// Where the page of a program is, from its line `page:   http://127.0.0.1:1234/`.
fn address_of(process: &mut Process) -> String {
    let line = process.line("page:");
    line.split_once("http://").unwrap().1.trim().trim_end_matches('/').to_owned()
}

/// What a request is answered, head and body.
fn ask_http(address: &str, path: &str, fields: &str) -> String {
    let mut stream = TcpStream::connect(address).unwrap();
    stream.set_read_timeout(Some(DEADLINE)).unwrap();
    write!(stream, "GET {path} HTTP/1.1\r\n{fields}Connection: close\r\n\r\n").unwrap();
    let mut answer = String::new();
    stream.read_to_string(&mut answer).unwrap();
    answer
}

/// A page on a free port, without a program.
fn page() -> (Viewer, Arc<Hub>, String) {
    page_of(Arc::new(NoControls))
}

fn page_of(controls: Arc<dyn Controls>) -> (Viewer, Arc<Hub>, String) {
    let model = Checkpoint::shipped().unwrap().description;
    let hub = Arc::new(Hub::default());
    let viewer = Viewer::start(
        ListenAddress::loopback(0),
        Arc::clone(&hub),
        Comparison::new(&model),
        PageInfo::default(),
        controls,
    );
    let viewer = viewer.unwrap();
    let address = viewer.address().to_string();
    (viewer, hub, address)
}

fn frame(sequence: u64, particles: usize) -> Frame {
    let place = |i: usize| [0.1 + 0.8 * (i as f32 / particles as f32), 0.5];
    Frame {
        stream: 9,
        sequence,
        stamp: Stamp(0).advance(0.016, sequence as u32),
        dt: 0.016,
        domain: Domain::UNIT,
        position: (0..particles).map(place).collect(),
        velocity: vec![[0.5, 0.0]; particles],
        material: vec![Material::Snow; particles],
    }
}

#[test]
fn the_page_is_served_to_itself_only() {
    let (_viewer, _hub, address) = page();
    let host = format!("Host: {address}\r\n");
    let index = ask_http(&address, "/", &host);
    assert!(index.starts_with("HTTP/1.1 200"), "{index}");
    assert!(index.contains("content-security-policy: default-src 'none'; script-src 'self'"));
    // Every file that the page names is there, and none is from elsewhere.
    let named: Vec<&str> =
        index.split(['"', '\'']).filter(|word| word.starts_with('/') && word.len() > 1).collect();
    assert!(named.contains(&"/app.js") && named.contains(&"/style.css"), "{named:?}");
    let app = ask_http(&address, "/app.js", &host);
    let imported = app.split('"').filter(|word| word.starts_with('/') && word.ends_with(".js"));
    for path in named.into_iter().chain(imported) {
        let file = ask_http(&address, path, &host);
        assert!(file.starts_with("HTTP/1.1 200"), "{path}: {file}");
        let elsewhere = file.replace("http://www.w3.org/2000/svg", "");
        assert!(!elsewhere.contains("http://") && !elsewhere.contains("https://"), "{path}");
    }
    assert!(ask_http(&address, "/Cargo.toml", &host).starts_with("HTTP/1.1 404"));

    let rebound = ask_http(&address, "/", "Host: evil.example\r\n");
    assert!(rebound.starts_with("HTTP/1.1 403"), "{rebound}");
    assert!(rebound.contains("Host: found evil.example, expected an address"), "{rebound}");
    let beside = "http://127.0.0.1:1";
    for origin in ["http://evil.example", "null", beside] {
        match Browser::connect(&address, origin).map(|_| ()) {
            Err(tungstenite::Error::Http(answer)) => assert_eq!(answer.status(), 403, "{origin}"),
            other => panic!("{origin}: {other:?}"),
        }
    }
    Browser::open(&address);
}

#[test]
fn a_browser_that_never_reads_costs_frames_and_nothing_else() {
    const PARTICLES: usize = 100_000;
    const FRAMES: u64 = 120;
    let (_viewer, hub, address) = page();
    let (mut silent, _) = Browser::open(&address);
    let (mut reader, _) = Browser::open(&address);
    let reading = std::thread::spawn(move || {
        let mut shown = Vec::new();
        while shown.last().is_none_or(|last: &Shown| last.sequences[0] + 1 < FRAMES) {
            shown.push(reader.until("a frame comes", |_| true));
        }
        shown
    });
    let (mut observed, mut next) = (frame(0, PARTICLES), frame(1, PARTICLES));
    let mut longest = Duration::ZERO;
    for sequence in 0..FRAMES {
        (observed.sequence, next.sequence) = (sequence, sequence + 1);
        let start = Instant::now();
        hub.predicted(&next, PredictionInfo { source: sequence, horizon: 1, free_running: false });
        hub.observed(&FrameView::from(&observed));
        longest = longest.max(start.elapsed());
        std::thread::sleep(Duration::from_millis(16).saturating_sub(start.elapsed()));
    }
    // Who published waited for nobody: a browser that does not read is sent away after 20 s only.
    assert!(longest < Duration::from_secs(1), "{longest:?}");
    let shown = reading.join().unwrap();
    assert!(shown.len() > 10, "{}", shown.len());
    assert!(shown.iter().all(|shown| shown.particles == PARTICLES));
    assert!(shown.iter().any(|shown| shown.has(TRUTH | PREDICTION | PAIR)));

    // What it was sent by then: two frames that it has not drawn. What it was not sent is counted.
    let metrics = silent.metrics_until("drops are counted", |metrics| {
        metrics["page"]["dropped"].as_u64().unwrap() > 0 && metrics["page"]["browsers"] == 1
    });
    let (dropped, made) = (&metrics["page"]["dropped"], &metrics["page"]["shown"]);
    assert!(dropped.as_u64().unwrap() + 5 >= made.as_u64().unwrap(), "{dropped} of {made}");
}

/// Sets a horizon, each time that the test lets it.
struct Slow {
    set: Mutex<Vec<u32>>,
    allowed: Mutex<mpsc::Receiver<()>>,
}

impl Controls for Slow {
    fn available(&self) -> &'static [&'static str] {
        &["horizon"]
    }

    fn execute(&self, command: PageCommand) -> Result<String, String> {
        self.allowed.lock().unwrap().recv_timeout(DEADLINE).unwrap();
        let PageCommand::Horizon { frames } = command else {
            return Err(command.name().to_owned());
        };
        self.set.lock().unwrap().push(frames);
        Ok(String::new())
    }

    fn state(&self) -> ControlState {
        let horizon = self.set.lock().unwrap().last().copied();
        ControlState { horizon, ..ControlState::default() }
    }
}

#[test]
fn what_a_page_asks_for_is_done_in_order_and_what_is_too_much_is_refused() {
    const ASKED: u32 = 12;
    let (allow, allowed) = mpsc::channel();
    let slow = Arc::new(Slow { set: Mutex::default(), allowed: Mutex::new(allowed) });
    let (_viewer, _hub, address) = page_of(Arc::clone(&slow) as Arc<dyn Controls>);
    let (mut browser, _) = Browser::open(&address);
    for frames in 1..=ASKED {
        browser.say(json!({ "do": "horizon", "frames": frames }));
    }
    // While the first is not done, four more wait: the others are refused at once.
    let refused = browser.words("outcome");
    assert_eq!(refused["done"], false, "{refused}");
    assert!(refused["message"].as_str().unwrap().starts_with("still busy"), "{refused}");
    (0..ASKED).for_each(|_| allow.send(()).unwrap());
    let mut states = Vec::new();
    for _ in 1..ASKED {
        let outcome = browser.words("outcome");
        if outcome["done"] == true {
            states.push(outcome["state"]["horizon"].as_u64().unwrap() as u32);
        }
    }
    let set = slow.set.lock().unwrap().clone();
    assert!(set.is_sorted() && set.len() >= 4 && set.len() < ASKED as usize, "{set:?}");
    assert_eq!(states, set, "every outcome says what is set since");
}

#[test]
fn the_demo_shows_truth_and_prediction_and_does_what_its_page_asks_for() {
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("demo");
    let mut demo = Process::start(eddy().args(["demo", "--port", "0", "--output"]).arg(&output));
    let address = address_of(&mut demo);
    let (mut browser, hello) = Browser::open(&address);
    assert_eq!(hello["command"], "demo");
    assert_eq!(hello["materials"][0], json!({ "name": "liquid", "color": [0, 114, 178] }));

    let pair = browser.until("a prediction meets its truth", |shown| shown.has(PAIR));
    assert!(pair.has(TRUTH | PREDICTION) && pair.sequences[0] == pair.sequences[1], "{pair:?}");
    assert!(pair.errors[0] > 0.0 && pair.errors[0] < 0.1, "{pair:?}");
    assert_eq!(pair.ahead, 20);
    let metrics = browser.metrics_until("the node reports", |metrics| {
        metrics["node"]["rate"].as_f64().is_some_and(|rate| rate > 1.0)
            && metrics["curves"]["time"].as_array().is_some_and(|time| time.len() > 10)
    });
    assert!(metrics["node"]["latency"][0].as_f64().unwrap() > 0.0, "{metrics}");
    assert!(metrics["curves"]["baseline"].is_string(), "{metrics}");
    assert_eq!(metrics["state"]["paused"], false);

    browser.done(json!({ "do": "pause" }));
    browser.until_quiet("nothing comes while it pauses");
    let [one, next] = [(); 2].map(|()| browser.step());
    assert_eq!(next, one + 1);
    browser.done(json!({ "do": "horizon", "frames": 5 }));
    browser.done(json!({ "do": "resume" }));
    browser.until("predictions are five ahead", |shown| shown.ahead == 5 && shown.has(PAIR));
    let refused = browser.ask(json!({ "do": "horizon", "frames": 0 }));
    assert_eq!(refused["message"], "horizon: found 0, expected 1 to 10000", "{refused}");
    let refused = browser.ask(json!({ "do": "skip", "seconds": 1.0 }));
    assert_eq!(refused["done"], false, "{refused}");

    browser.done(json!({ "do": "free_run", "on": true }));
    let free = browser.until("the model simulates alone", |shown| shown.has(FREE));
    browser.until("farther and farther ahead", |shown| {
        shown.has(FREE | PAIR) && shown.ahead > free.ahead
    });
    browser.done(json!({ "do": "free_run", "on": false }));
    browser.until("it observes again", |shown| shown.has(PAIR) && !shown.has(FREE));
    let before = counter(&browser.metrics, "resets");
    browser.done(json!({ "do": "reset" }));
    browser.metrics_until("the reset is counted", |metrics| counter(metrics, "resets") > before);

    // It ends also while more is predicted than anybody reads.
    browser.done(json!({ "do": "horizon", "frames": 40 }));
    browser.done(json!({ "do": "publish_all", "on": true }));
    browser.until("many frames are ahead", |shown| shown.has(PREDICTION) && shown.ahead > 5);
    demo.interrupt();
    assert!(demo.wait().success());
    // The page is told, and does not find out.
    let closed = loop {
        match browser.socket.read() {
            Ok(Message::Close(close)) => break close,
            Ok(_) => {}
            Err(error) => panic!("{error}"),
        }
    };
    assert_eq!(closed.unwrap().reason.as_str(), "the program ended");
    assert!(output.join("bag/metadata.yaml").exists());
}

fn counter(metrics: &Value, name: &str) -> u64 {
    let counters = metrics["node"]["counters"].as_array();
    let mut named = counters.into_iter().flatten().filter(|counter| counter[0] == name);
    named.next().and_then(|counter| counter[1].as_u64()).unwrap_or(0)
}

#[test]
fn a_replay_and_a_node_have_pages_of_their_own() {
    let world = World::new("view");
    simulate(world.folder.path().join("truth").as_path(), 1, 2.0);
    let bag = world.folder.path().join("truth/scene_0000");
    let input = world.link("shm", "particles").to_string();
    let mut node = Process::start(eddy().args(["node", "--input", &input]).args([
        "--output",
        &world.link("shm", "prediction").to_string(),
        "--view",
        "0",
    ]));
    let node_page = address_of(&mut node);
    let remap = format!("/particles:={}", world.topic("particles"));
    let mut replay = Process::start(eddy().arg("replay").arg(bag).args([
        "--to",
        "shm",
        "--loop",
        "--remap",
        &remap,
        "--wait-for",
        "1",
        "--view",
        "0",
    ]));
    let replay_page = address_of(&mut replay);

    let (mut browser, hello) = Browser::open(&node_page);
    assert_eq!(hello["controls"], json!(["reset", "horizon", "publish_all", "free_run"]));
    let pair = browser.until("the node predicts", |shown| shown.has(PAIR));
    let refused = browser.ask(json!({ "do": "pause" }));
    assert_eq!(refused["done"], false, "the source of a node is another program: {refused}");

    let (mut player, hello) = Browser::open(&replay_page);
    assert_eq!(hello["controls"], json!(["pause", "step", "rate", "skip"]));
    let truth = player.until("the bag is shown", |_| true);
    assert_eq!((truth.flags, truth.stream), (TRUTH, pair.stream));
    player.done(json!({ "do": "pause" }));
    player.until_quiet("nothing comes while it pauses");
    player.step();
    player.done(json!({ "do": "rate", "rate": 0.5 }));
    let metrics = player.metrics_until("it is known", |metrics| metrics["state"]["rate"] == 0.5);
    assert_eq!(metrics["state"]["paused"], true);

    for process in [&mut replay, &mut node] {
        process.interrupt();
        assert!(process.wait().success());
    }
}

#[test]
fn a_page_says_why_frames_are_rejected_and_how_a_stream_differs() {
    let world = World::new("banner");
    let mut node = Process::start(eddy().args([
        "node",
        "--input",
        &world.link("shm", "particles").to_string(),
        "--output",
        &world.link("shm", "prediction").to_string(),
        "--view",
        "0",
    ]));
    let (mut browser, _) = Browser::open(&address_of(&mut node));
    let mut source = world.publisher("shm", "particles", ParticleFrame::TYPE);
    wait_for("the node listens", || (source.subscribers() > 0).then_some(()));
    let wide = Frame { domain: Domain { lower: [0.0; 2], upper: [2.0, 1.0] }, ..frame(0, 60) };
    source.publish_frame(&wide).unwrap();
    let metrics = browser
        .metrics_until("the stream differs", |metrics| metrics["node"]["warnings"][0].is_string());
    let warning = metrics["node"]["warnings"][0].as_str().unwrap();
    assert!(warning.starts_with("domain is 2 x 1, model was trained on 1 x 1"), "{warning}");
    assert!(metrics["node"]["rejected"].is_null(), "{metrics}");
    source.publish_frame(&Frame { dt: 0.02, sequence: 1, ..wide }).unwrap();
    browser.metrics_until("a frame is rejected", |metrics| {
        let rejected = metrics["node"]["rejected"].as_str();
        rejected.is_some_and(|said| said.contains("dt: found 0.02 s, expected 0.016 s"))
    });
    node.interrupt();
    assert!(node.wait().success());
}

#[test]
fn an_address_that_cannot_be_had_is_named() {
    let taken = std::net::TcpListener::bind("127.0.0.1:0").unwrap();
    let port = taken.local_addr().unwrap().port().to_string();
    let folder = tempfile::tempdir().unwrap();
    let output = folder.path().join("demo");
    let said = fail(1, ["demo", "--port", &port, "--output", output.to_str().unwrap()]);
    assert!(said.contains(&format!("--port: 127.0.0.1:{port}: cannot listen: ")), "{said}");
    assert!(said.contains("choose a free port"), "{said}");
    assert!(!output.exists(), "nothing is written before");
    let world = World::new("taken");
    let [input, output] = ["a", "b"].map(|name| world.link("shm", name).to_string());
    let view = format!("127.0.0.1:{port}");
    let said = fail(1, ["node", "--input", &input, "--output", &output, "--view", &view]);
    let looped = fail(2, ["node", "--input", &input, "--output", &input]);
    assert!(looped.contains(&format!("output: found {input}, which is the input")), "{looped}");
    assert!(said.contains(&format!("--view: 127.0.0.1:{port}: cannot listen: ")), "{said}");
    let said = fail(2, ["node", "--view", "somewhere"]);
    assert!(said.contains("expected a port (9000), an address (0.0.0.0) or both"), "{said}");
    assert!(fail(2, ["demo", "--headless", "--port", "1"]).contains("--headless"));
}
