//! Other processes: this test binary started again, with a role.

use std::{
    fs,
    io::{BufRead, BufReader},
    os::unix::{fs::PermissionsExt as _, process::CommandExt as _},
    process::{Child, ChildStdout, Command, Stdio},
    sync::mpsc,
    thread,
    time::{Duration, Instant},
};

use eddy_frames::{AnyFrame, with_frame};
use eddy_messages::{FrameCdr as _, Message, RosString};
use eddy_transport::{Link, Reliability, TransportOptions, Transports};

use super::{DEADLINE, frame, frames_publisher, frames_subscriber, in_space, options};

const VARIABLE: &str = "EDDY_TEST_CHILD";
const PARTICLES: usize = 2_500;

/// A process with a role, killed with SIGKILL when dropped.
pub(super) struct Process {
    child: Child,
    lines: mpsc::Receiver<String>,
}

impl Process {
    /// Starts `role` on `link`, with the same ports and the same domain as `options`.
    pub(super) fn start(role: &str, link: &Link, options: &TransportOptions) -> Self {
        Self::run(Command::new(std::env::current_exe().unwrap()), role, link, options)
    }

    /// As [`Process::start`], as the user with this id, which the superuser may.
    pub(super) fn start_as(user: u32, role: &str, link: &Link, options: &TransportOptions) -> Self {
        // A copy, as this program may be where another user cannot run it.
        let folder = tempfile::tempdir().unwrap();
        fs::set_permissions(&folder, fs::Permissions::from_mode(0o755)).unwrap();
        let program = folder.path().join("child");
        fs::copy(std::env::current_exe().unwrap(), &program).unwrap();
        let mut command = Command::new(program);
        command.uid(user).gid(user);
        Self::run(command, role, link, options)
    }

    fn run(mut command: Command, role: &str, link: &Link, options: &TransportOptions) -> Self {
        let ports = &options.zenoh.ports;
        let task = format!(
            "{role} {link} {} {} {} {}",
            ports.start(),
            ports.end(),
            options.zenoh.router,
            options.domain_id
        );
        command
            .args(["--ignored", "--exact", "child::main", "--nocapture"])
            .env(VARIABLE, task)
            .stdout(Stdio::piped());
        let mut child = command.spawn().unwrap();
        let lines = read_lines(child.stdout.take().unwrap());
        Self { child, lines }
    }

    /// Waits for a line that contains `text`.
    pub(super) fn says(&self, text: &str) -> String {
        let start = Instant::now();
        loop {
            let left = DEADLINE.saturating_sub(start.elapsed());
            let line =
                self.lines.recv_timeout(left).unwrap_or_else(|_| panic!("no line with `{text}`"));
            if line.contains(text) {
                return line;
            }
        }
    }

    /// SIGSTOP: it reads and acknowledges nothing any more.
    pub(super) fn pause(&self) {
        let id = self.child.id().to_string();
        assert!(Command::new("kill").args(["-STOP", &id]).status().unwrap().success());
        // A thread goes on until the processor that it runs on, or is to run on, is told.
        let is_stopped = |task: std::io::Result<fs::DirEntry>| {
            let status = fs::read_to_string(task.unwrap().path().join("stat"));
            // The state follows the name, which is in parentheses.
            status.is_ok_and(|status| {
                status.rsplit(')').next().is_some_and(|rest| rest.trim_start().starts_with('T'))
            })
        };
        super::eventually("all threads are stopped", || {
            fs::read_dir(format!("/proc/{id}/task")).unwrap().all(is_stopped)
        });
    }

    /// SIGKILL.
    pub(super) fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // An error means that it was killed already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn read_lines(stdout: ChildStdout) -> mpsc::Receiver<String> {
    let (sender, lines) = mpsc::channel();
    thread::spawn(move || {
        for line in BufReader::new(stdout).lines().map_while(Result::ok) {
            if sender.send(line).is_err() {
                return;
            }
        }
    });
    lines
}

#[test]
#[ignore = "the process that other tests start; does nothing by itself"]
fn main() {
    let Ok(task) = std::env::var(VARIABLE) else { return };
    let words: Vec<&str> = task.split(' ').collect();
    let [role, link, start, end, router, domain] = words[..] else { panic!("{VARIABLE}={task}") };
    let link: Link = link.parse().unwrap();
    let mut options = options();
    options.zenoh.ports = start.parse().unwrap()..=end.parse().unwrap();
    options.zenoh.router = router.to_owned();
    options.domain_id = domain.parse().unwrap();
    tracing_subscriber::fmt().with_max_level(tracing::Level::WARN).with_ansi(false).init();
    let transports = Transports::new(options);
    match role {
        "publish" => publish(&transports, &link),
        "publish-in-space" => publish_in_space(&transports, &link),
        "subscribe" => subscribe(&transports, &link, u64::MAX),
        "stall" => subscribe(&transports, &link, 1),
        "strings" => {
            let mut subscriber = transports.subscriber(&link, RosString::TYPE).unwrap();
            println!("ready");
            while subscriber.receive(Duration::from_secs(1)).unwrap().is_none() {}
        }
        "echo" => echo(&transports, &link),
        "refused" => {
            let refused = transports.subscriber(&link, RosString::TYPE).err();
            println!("{}", refused.expect("it is refused"));
        }
        other => panic!("no role {other}"),
    }
}

/// Publishes a frame every few milliseconds, forever.
fn publish(transports: &Transports, link: &Link) {
    let mut publisher = frames_publisher(transports, link, Reliability::Block);
    println!("ready");
    for sequence in 0.. {
        publisher.publish_frame(&frame(sequence, PARTICLES)).unwrap();
        thread::sleep(Duration::from_millis(5));
    }
}

/// Publishes frames of three dimensions as fast as they are taken, forever.
fn publish_in_space(transports: &Transports, link: &Link) {
    let mut publisher = frames_publisher(transports, link, Reliability::Block);
    super::eventually("both subscribers are seen", || publisher.subscribers() == 2);
    for sequence in 0.. {
        publisher.publish_cdr(&in_space(sequence, 2 * PARTICLES).to_cdr()).unwrap();
    }
}

/// Prints the frames that arrive; stops receiving after `most` frames.
fn subscribe(transports: &Transports, link: &Link, most: u64) {
    let mut subscriber = frames_subscriber(transports, link);
    println!("ready");
    let mut read = 0;
    loop {
        if read == most {
            thread::park();
        } else if let Some(payload) = subscriber.receive(Duration::from_millis(100)).unwrap() {
            let frame = AnyFrame::from_cdr(&payload.into_cdr()).unwrap();
            println!("frame {}", with_frame!(frame, frame => frame.sequence));
            read += 1;
        }
    }
}

/// Sends every frame back on another topic.
fn echo(transports: &Transports, link: &Link) {
    let mut subscriber = frames_subscriber(transports, link);
    let back = link.with_topic(&format!("{}/back", link.topic));
    let mut publisher = frames_publisher(transports, &back, Reliability::Block);
    // Each end of a DDS topic finds the other one by itself.
    super::eventually("the frames that go back are awaited", || publisher.subscribers() == 1);
    println!("ready");
    loop {
        if let Some(payload) = subscriber.receive(Duration::from_millis(100)).unwrap() {
            publisher.publish_frame(&payload.into_frame().unwrap()).unwrap();
        }
    }
}

/// Prints, with `--nocapture`, half of the median time that a frame takes there and back.
#[test]
fn frames_go_to_another_process_and_come_back() {
    const ROUNDS: u64 = 200;
    for transport in ["shm", "zenoh", "dds"] {
        let (mut options, link) = (options(), super::link(transport));
        if transport == "dds" {
            options.domain_id = super::domain();
        }
        let transports = Transports::new(options.clone());
        let back = link.with_topic(&format!("{}/back", link.topic));
        let mut subscriber = frames_subscriber(&transports, &back);
        let mut publisher = frames_publisher(&transports, &link, Reliability::Block);
        let echo = Process::start("echo", &link, &options);
        echo.says("ready");
        super::eventually("the echo is seen", || publisher.subscribers() == 1);
        let mut ways = Vec::new();
        for sequence in 0..ROUNDS {
            let sent = frame(sequence, PARTICLES);
            let start = Instant::now();
            publisher.publish_frame(&sent).unwrap();
            super::expect_frame(&mut *subscriber, &sent);
            ways.push(start.elapsed() / 2);
        }
        ways.sort_unstable();
        let median = ways[ways.len() / 2];
        println!("{transport}: {PARTICLES} particles one way in {median:?} (median of {ROUNDS})");
    }
}
