//! A program as its users run it, with everything it needs for itself: folders, ports, topics.

use std::{
    collections::BTreeSet,
    io::{BufRead as _, BufReader},
    net::TcpListener,
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Output, Stdio},
    sync::{
        Arc,
        atomic::{AtomicU16, AtomicU32, AtomicU64, Ordering},
        mpsc::{Receiver, RecvTimeoutError, channel},
    },
    thread,
    time::{Duration, Instant},
};

use eddy_bag::{BagReader, Survey};
use eddy_messages::{
    Message, QosProfile, RosString, cdr,
    qos::{DurabilityPolicy, HistoryPolicy},
};
use eddy_transport::{Link, Publisher, Reliability, Subscriber, TransportOptions, Transports};
use tempfile::TempDir;

/// No test waits longer for anything.
pub const DEADLINE: Duration = Duration::from_secs(120);

/// The program under test, `crate::PROGRAM`.
pub fn eddy() -> Command {
    let mut command = talking_eddy();
    command.arg("--quiet");
    command
}

/// The program as it talks.
pub fn talking_eddy() -> Command {
    let mut command = Command::new(crate::PROGRAM);
    command.stdin(Stdio::null());
    command
}

/// Runs `eddy` with `arguments`, which must succeed. Returns what it printed.
pub fn succeed<S: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = S>) -> String {
    let output = run(arguments);
    let errors = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{}: {errors}", output.status);
    String::from_utf8(output.stdout).unwrap()
}

/// Runs `eddy` with `arguments`, which must end with `code`. Returns what it said.
pub fn fail<S: AsRef<std::ffi::OsStr>>(
    code: i32,
    arguments: impl IntoIterator<Item = S>,
) -> String {
    let output = run(arguments);
    let errors = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(code), "{errors}");
    errors
}

pub fn run<S: AsRef<std::ffi::OsStr>>(arguments: impl IntoIterator<Item = S>) -> Output {
    eddy().args(arguments).output().unwrap()
}

/// A process that ends with the test, whatever happens.
pub struct Process {
    child: Child,
    /// The lines that it prints.
    printed: Receiver<std::io::Result<String>>,
}

impl Process {
    /// Starts it in the background.
    pub fn start(command: &mut Command) -> Self {
        let mut child = command.stdout(Stdio::piped()).spawn().unwrap();
        let mut stdout = BufReader::new(child.stdout.take().unwrap());
        let (lines, printed) = channel();
        thread::spawn(move || {
            let mut line = String::new();
            loop {
                let read = stdout.read_line(&mut line);
                let ended = !matches!(read, Ok(1..));
                if !matches!(read, Ok(0)) {
                    let line = read.map(|_| std::mem::take(&mut line));
                    let _ = lines.send(line); // nobody may be interested any more
                }
                if ended {
                    return;
                }
            }
        });
        Self { child, printed }
    }

    /// Starts it and waits until it has printed a line that begins so.
    pub fn start_until(command: &mut Command, beginning: &str) -> Self {
        let mut process = Self::start(command);
        process.line(beginning);
        process
    }

    /// Waits until it has printed a line that begins so.
    pub fn line(&mut self, beginning: &str) -> String {
        let start = Instant::now();
        loop {
            match self.printed.recv_timeout(DEADLINE.saturating_sub(start.elapsed())) {
                Ok(line) => {
                    let line = line.unwrap();
                    if line.starts_with(beginning) {
                        return line;
                    }
                }
                Err(RecvTimeoutError::Timeout) => panic!("waited {DEADLINE:?} for `{beginning}`"),
                Err(RecvTimeoutError::Disconnected) => {
                    panic!("the process ended before it printed `{beginning}`")
                }
            }
        }
    }

    /// Asks it to end, as Ctrl-C does.
    pub fn interrupt(&self) {
        send("-INT", self);
    }

    /// Its number.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// Ends it without notice (SIGKILL).
    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Waits for its end.
    pub fn wait(&mut self) -> ExitStatus {
        wait_for("the process ends", || self.child.try_wait().unwrap())
    }

    /// What it has printed since the line that was waited for, once it has ended.
    pub fn rest(&mut self) -> String {
        let mut rest = String::new();
        while let Ok(line) = self.printed.recv_timeout(DEADLINE) {
            rest.push_str(&line.unwrap());
        }
        rest
    }

    /// Whether it runs.
    pub fn is_running(&mut self) -> bool {
        self.child.try_wait().unwrap().is_none()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Sends a signal to a process.
pub fn send(signal: &str, process: &Process) {
    let id = process.id().to_string();
    assert!(Command::new("kill").args([signal, &id]).status().unwrap().success());
}

/// Asks again and again until there is an answer.
pub fn wait_for<T>(what: &str, mut answer: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(found) = answer() {
            return found;
        }
        assert!(start.elapsed() < DEADLINE, "waited {DEADLINE:?} until {what}");
        thread::sleep(Duration::from_millis(20));
    }
}

/// A word that no other test, and no other run, uses.
pub fn unique(word: &str) -> String {
    static NUMBER: AtomicU32 = AtomicU32::new(0);
    format!("{word}_{}_{}", std::process::id(), NUMBER.fetch_add(1, Ordering::Relaxed))
}

/// A DDS domain that no other test uses now. Participants on loopback find the first twelve of a
/// domain only.
pub fn domain() -> u16 {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    const DOMAINS: u32 = 100;
    let next = std::process::id().wrapping_mul(13) + NEXT.fetch_add(1, Ordering::Relaxed);
    1 + (next % DOMAINS) as u16
}

/// A port of the loopback interface that no other test of this process uses and that was free just now: below those that the system gives
/// to listeners and connections that ask for any.
pub fn free_port() -> u16 {
    static NEXT: AtomicU16 = AtomicU16::new(0);
    const PORTS: u16 = 600;
    let first = 20_000 + (std::process::id() % 20) as u16 * PORTS;
    let mut ports = (0..PORTS).map(|_| first + NEXT.fetch_add(1, Ordering::Relaxed) % PORTS);
    let is_free = |port: &u16| TcpListener::bind(("127.0.0.1", *port)).is_ok();
    ports.find(is_free).expect("a port is free")
}

/// How long the machine keeps threads from running: tests that are about time allow for it.
pub struct Stalls(Arc<AtomicU64>);

impl Stalls {
    /// Measures from now on.
    pub fn watch() -> Self {
        const NAP: Duration = Duration::from_millis(5);
        let longest = Arc::<AtomicU64>::default();
        let kept = Arc::downgrade(&longest);
        thread::spawn(move || {
            let mut last = Instant::now();
            while let Some(longest) = kept.upgrade() {
                thread::sleep(NAP);
                let stalled = last.elapsed().saturating_sub(NAP);
                longest.fetch_max(stalled.as_micros() as u64, Ordering::Relaxed);
                last = Instant::now();
            }
        });
        Self(longest)
    }

    /// The longest time that a thread of this process was not run when it was due.
    fn longest(&self) -> Duration {
        Duration::from_micros(self.0.load(Ordering::Relaxed))
    }

    /// What several processes that wait for each other may take longer for it: four, as a frame passes the source, a router, a node and
    /// the router again.
    pub fn delay(&self) -> Duration {
        4 * self.longest()
    }

    /// Whether nodes of a group may have withheld predictions: they do 100 ms after they last looked at the others, which they do every
    /// 25 ms.
    pub fn are_long(&self) -> bool {
        self.longest() > Duration::from_millis(40)
    }
}

/// Simulates `scenes` short scenes into `folder`.
pub fn simulate(folder: &Path, scenes: u32, seconds: f64) {
    let (scenes, seconds) = (scenes.to_string(), seconds.to_string());
    let folder = folder.to_str().unwrap();
    succeed(["simulate", "--scenes", &scenes, "--duration", &seconds, "--output", folder]);
}

/// The QoS of a publisher that keeps messages for late subscribers.
pub fn latched(kept: usize) -> QosProfile {
    let (durability, history) = (DurabilityPolicy::TransientLocal, HistoryPolicy::KeepLast(kept));
    QosProfile { durability, history, ..QosProfile::default() }
}

/// A message with a text.
pub fn word(words: &str) -> Vec<u8> {
    cdr::encode(&RosString { data: words.into() })
}

/// Everything that is wrong with a bag.
pub fn findings(path: &Path) -> Vec<String> {
    let bag = BagReader::open(path).unwrap();
    let mut survey = Survey::of(&bag, |_| ());
    survey.check_files(&bag);
    survey.findings.iter().map(ToString::to_string).collect()
}

/// A place for a bag, topics of its own, and this process's end of the transports.
pub struct World {
    pub folder: TempDir,
    pub prefix: String,
    pub transports: Transports,
    /// The program's part of the same Zenoh network (`ZENOH_CONFIG_OVERRIDE`).
    pub overrides: String,
    /// Where the program listens on Zenoh.
    pub port: u16,
    /// `ROS_DOMAIN_ID` of the program.
    pub domain: u16,
}

impl World {
    pub fn new(name: &str) -> Self {
        Self::in_domain(name, 0)
    }

    /// On DDS, tests need domains of their own.
    pub fn in_domain(name: &str, domain: u16) -> Self {
        let ports = [free_port(), free_port()];
        let overrides = |listen: usize| {
            let [mine, other] = [ports[listen], ports[1 - listen]];
            format!(
                r#"listen/endpoints=["tcp/127.0.0.1:{mine}"];connect/endpoints=["tcp/127.0.0.1:{other}"]"#
            )
        };
        let mut options = TransportOptions::new("eddy_test");
        options.zenoh.overrides = overrides(0);
        options.domain_id = domain;
        Self {
            folder: tempfile::tempdir().unwrap(),
            prefix: format!("/{}", unique(name)),
            transports: Transports::new(options),
            overrides: overrides(1),
            port: ports[1],
            domain,
        }
    }

    pub fn bag(&self) -> PathBuf {
        self.folder.path().join("bag")
    }

    pub fn topic(&self, name: &str) -> String {
        format!("{}/{name}", self.prefix)
    }

    pub fn link(&self, transport: &str, name: &str) -> Link {
        format!("{transport}:{}", self.topic(name)).parse().unwrap()
    }

    pub fn publisher(&self, transport: &str, name: &str, kind: &str) -> Box<dyn Publisher> {
        self.transports.publisher(&self.link(transport, name), kind, Reliability::Block).unwrap()
    }

    pub fn subscriber(&self, transport: &str, name: &str, kind: &str) -> Box<dyn Subscriber> {
        self.transports.subscriber(&self.link(transport, name), kind).unwrap()
    }

    /// A publisher of texts.
    pub fn words(&self, transport: &str, name: &str) -> Box<dyn Publisher> {
        self.publisher(transport, name, RosString::TYPE)
    }
}

/// Names in a directory, sorted.
pub fn entries(directory: &Path) -> Vec<String> {
    let names = std::fs::read_dir(directory).unwrap().map(|e| e.unwrap().file_name());
    let mut names: Vec<String> = names.map(|name| name.into_string().unwrap()).collect();
    names.sort();
    names
}

/// A page is whole, its tags are closed, and it asks nobody for anything.
pub fn is_a_page_of_its_own(html: &str) {
    for word in ["http://", "https://", "@import", "url(", "<link", "<iframe", "srcset", "fetch("] {
        assert!(!html.contains(word), "found {word}");
    }
    // One script of its own, without which the page is complete.
    let (before, script) = html.split_once("<script>").unwrap();
    let (_, after) = script.split_once("</script>").unwrap();
    let html = &format!("{before}{after}");
    assert!(!html.contains("<script"));
    assert_eq!(html.matches("src=").count(), html.matches("src=\"data:").count());
    assert!(!html.contains("NaN") && !html.contains("inf "), "numbers that are none");
    let mut open = Vec::new();
    let rest = html.strip_prefix("<!DOCTYPE html>").unwrap();
    for tag in rest.split('<').skip(1) {
        let (tag, _) = tag.split_once('>').unwrap();
        let name = tag.trim_start_matches('/').split([' ', '\n', '/']).next().unwrap();
        match tag.starts_with('/') {
            true => assert_eq!(open.pop(), Some(name), "</{name}>"),
            // Those have no end.
            false if ["meta", "img"].contains(&name) || tag.ends_with('/') => {}
            false => open.push(name),
        }
    }
    assert!(open.is_empty(), "not closed: {open:?}");
    // Where links lead to is there.
    for link in html.split("href=\"#").skip(1) {
        let (target, _) = link.split_once('"').unwrap();
        assert!(html.contains(&format!("id=\"{target}\"")), "{target}");
    }
}

/// The commands below `path`, as its help lists them.
fn listed(path: &[&str]) -> Vec<String> {
    let help = succeed(path.iter().copied().chain(["--help"]));
    let (list, _) = help.split_once("ptions:\n").unwrap();
    let of_line = |line: &str| {
        // The first screen names less used commands in a line.
        if let Some(names) = line.strip_prefix("More commands: ") {
            return names.split(", ").map(str::to_owned).collect();
        }
        let name = line.strip_prefix("  ").and_then(|line| line.split(' ').next());
        let name = name.filter(|name| name.starts_with(|first: char| first.is_ascii_lowercase()));
        Vec::from_iter(name.map(str::to_owned))
    };
    list.lines().flat_map(of_line).filter(|name| name != "help").collect()
}

/// Every command with its words, those that only hold others too.
pub fn commands() -> BTreeSet<Vec<String>> {
    let mut all = BTreeSet::new();
    let mut open = vec![Vec::new()];
    while let Some(path) = open.pop() {
        let words: Vec<_> = path.iter().map(String::as_str).collect();
        for name in listed(&words) {
            open.push([path.as_slice(), &[name]].concat());
        }
        all.insert(path);
    }
    all
}

/// Every option that takes a value is required, or its help says what holds without it.
fn defaults_are_named(command: &[String]) {
    let help = succeed(command.iter().map(String::as_str).chain(["--help"]));
    let usage = help.split_once("Usage: ").unwrap().1.split_once("\n\n").unwrap().0.to_owned();
    let mut lines = help.lines().peekable();
    while let Some(line) = lines.next() {
        let Some((_, option)) = line.split_once("--").filter(|_| line.starts_with(' ')) else {
            continue;
        };
        let is_option = line.trim_start().starts_with('-') && option.contains('<');
        let is_text = |line: &&str| line.is_empty() || line.starts_with("        ");
        let text: Vec<_> = std::iter::from_fn(|| lines.next_if(is_text)).collect();
        let text = format!("{line}{}", text.concat());
        let name = format!("--{}", option.split(' ').next().unwrap());
        let required = usage.split_whitespace().any(|word| word == name);
        let named = text.contains("[default") || text.contains("[without a value");
        assert!(!is_option || required || named, "{command:?} {name}: found no default in: {text}");
    }
}

/// Every help lists global options apart, says what holds without an option, and uses the same names for the same things.
pub fn helps_list_global_options_apart() {
    for command in commands() {
        defaults_are_named(&command);
        let words = command.iter().map(String::as_str);
        for option in ["-h", "--help"] {
            let help = succeed(words.clone().chain([option]));
            assert!(!help.contains("[`") && !help.contains("]("), "{command:?}: a rustdoc link");
            let (_, global) = help.split_once("\nGlobal options:\n").unwrap();
            assert!(global.contains("--quiet") && global.contains("--log-level"), "{help}");
            // Names of one thing: a directory, a number.
            for other in ["<OUTPUT>", "<DIRECTORY>", "<FOLDER>", "<HERTZ>", "<PARTICLES>"] {
                assert!(!help.contains(other), "{command:?}: {other}");
            }
        }
    }
}
