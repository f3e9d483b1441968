//! The page under attack, and beyond the loopback interface.

use super::*;

/// A page that other machines can reach, and its port.
fn public_page() -> (Viewer, String) {
    let model = Checkpoint::shipped().unwrap().description;
    let viewer = Viewer::start(
        ListenAddress("0.0.0.0:0".parse().unwrap()),
        Arc::default(),
        Comparison::new(&model),
        PageInfo::default(),
        Arc::new(Pausing),
    )
    .unwrap();
    let address = format!("127.0.0.1:{}", viewer.address().port());
    (viewer, address)
}

/// Can be paused.
struct Pausing;

impl Controls for Pausing {
    fn available(&self) -> &'static [&'static str] {
        &["pause"]
    }

    fn execute(&self, _: PageCommand) -> Result<String, String> {
        Ok("paused".to_owned())
    }

    fn state(&self) -> ControlState {
        ControlState::default()
    }
}

#[test]
fn requests_that_are_never_completed_are_closed_and_lock_nobody_out() {
    let (_viewer, _, address) = page();
    let begin = || {
        let mut stream = TcpStream::connect(&address).unwrap();
        stream.set_read_timeout(Some(DEADLINE)).unwrap();
        write!(stream, "GET / HTTP/1.1\r\nHost: {address}\r\n").unwrap();
        stream
    };
    let mut half: Vec<_> = (0..300).map(|_| begin()).collect();
    // Others are served while they are open.
    let host = format!("Host: {address}\r\n");
    assert!(ask_http(&address, "/", &host).starts_with("HTTP/1.1 200"));
    let (mut browser, _) = Browser::open(&address);
    // More than there may be are closed at once, the rest when their time is over.
    let start = Instant::now();
    for stream in &mut half {
        let mut answer = Vec::new();
        // A reset is an end, too.
        let _ = stream.read_to_end(&mut answer);
        assert!(!answer.starts_with(b"HTTP/1.1 200"));
    }
    assert!(start.elapsed() < DEADLINE / 2, "{:?}", start.elapsed());
    // A browser is not closed with them.
    browser.words("metrics");
}

#[test]
fn commands_need_the_token_where_other_machines_reach_the_page() {
    let (viewer, address) = public_page();
    let url = viewer.url();
    let token = url.split_once("/?token=").unwrap().1;
    let host = format!("Host: {address}\r\n");

    // Everybody may watch.
    let (mut browser, hello) = Browser::open(&address);
    assert_eq!(hello["controls"], json!([]));
    let outcome = browser.ask(json!({ "do": "pause" }));
    assert_eq!(outcome["done"], false);
    assert!(outcome["message"].as_str().unwrap().contains("token"), "{outcome}");

    let wrong = ask_http(&address, "/?token=0123", &host);
    assert!(wrong.starts_with("HTTP/1.1 403") && wrong.contains("token"), "{wrong}");

    // The token becomes a cookie.
    let right = ask_http(&address, &format!("/?token={token}"), &host);
    assert!(right.starts_with("HTTP/1.1 303"), "{right}");
    let field = |name: &str| {
        let line = right.lines().find_map(|line| line.strip_prefix(name));
        line.unwrap_or_else(|| panic!("no {name} in {right}")).to_owned()
    };
    assert_eq!(field("location: "), "/");
    let cookie = field("set-cookie: ");
    assert!(cookie.ends_with("; HttpOnly; SameSite=Strict"), "{cookie}");
    let cookie = cookie.split(';').next().unwrap();
    for (path, cookie) in [("/ws", cookie), (&*format!("/ws?token={token}"), "a=b")] {
        let mut browser = Browser::connect_as(&address, path, cookie);
        assert_eq!(browser.words("hello")["controls"], json!(["pause"]));
        browser.done(json!({ "do": "pause" }));
    }
    // Of another run.
    let mut browser = Browser::connect_as(&address, "/ws", &cookie.replace(token, &"0".repeat(32)));
    assert_eq!(browser.words("hello")["controls"], json!([]));
}

#[test]
fn prometheus_reads_the_counters_of_a_node() {
    let world = World::new("metrics");
    let bag = world.folder.path().join("truth");
    simulate(&bag, 1, 1.0);
    let [input, output] = ["particles", "prediction"].map(|name| world.link("shm", name));
    let mut node = Process::start(eddy().args(["node", "--view", "0"]).args([
        "--input",
        &input.to_string(),
        "--output",
        &output.to_string(),
    ]));
    let address = address_of(&mut node);
    let remap = format!("/particles:={}", input.topic);
    let bag = bag.join("scene_0000");
    let mut replay = Process::start(eddy().arg("replay").arg(bag).args([
        "--to",
        "shm",
        "--wait-for",
        "1",
        "--remap",
        &remap,
    ]));
    assert!(replay.wait().success());
    let value = |text: &str, name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.map(|value| value.parse::<f64>().unwrap())
    };
    let text = wait_for("all frames are counted", || {
        let answer = ask_http(&address, "/metrics", &format!("Host: {address}\r\n"));
        assert!(answer.contains("content-type: text/plain; version=0.0.4"), "{answer}");
        let (_, text) = answer.split_once("\r\n\r\n").unwrap();
        (value(text, "eddy_received_total")? >= 60.0).then(|| text.to_owned())
    });
    assert!(value(&text, "eddy_published_total").unwrap() > 50.0, "{text}");
    assert_eq!(value(&text, "eddy_too_fast_total"), Some(0.0));
    assert_eq!(value(&text, "eddy_streams"), Some(1.0));
}
