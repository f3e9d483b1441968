//! Nodes of a group, each a process, that share streams through a zenoh router on this machine.

use std::{
    collections::BTreeMap,
    io,
    net::{Ipv4Addr, TcpListener, TcpStream},
    path::Path,
    process::{Child, Command, ExitStatus, Stdio},
    sync::atomic::{AtomicBool, AtomicU64, Ordering},
    thread,
    time::Duration,
};

use serde::Serialize;

use super::{Spread, Tail, particles, transport::Stopping};
use eddy_frames::{Frame, Stamp, clock::Clock};
use eddy_inference::checkpoint::{Checkpoint, CheckpointError};
use eddy_messages::{Message, ParticleFrame};
use eddy_transport::{
    Link, Publisher, Reliability, Subscriber, TransportError, TransportOptions, Transports,
};

/// The name of the group.
const GROUP: &str = "bench";
/// Time for all processes to start and to find each other.
const START_TIMEOUT: Duration = Duration::from_secs(60);
/// Time for the last predictions.
const DRAIN_TIME: Duration = Duration::from_secs(3);
/// Timeout of a wait, after which its end is checked.
const POLL_TIMEOUT: Duration = Duration::from_millis(50);

/// Parameters of the benchmark.
#[derive(Clone, Copy, Debug)]
pub struct Plan {
    /// Number of nodes.
    pub nodes: usize,
    /// Number of streams that they share.
    pub streams: u64,
    /// Particles per stream.
    pub particles: usize,
    /// Frame rate per stream (Hz).
    pub hertz: f64,
    /// Duration (s).
    pub seconds: f64,
    /// Whether a node is killed after half of the time.
    pub kill: bool,
}

/// Results of the benchmark.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct Timing {
    /// Published frames.
    pub frames: u64,
    /// Frames without a prediction.
    pub lost: u64,
    /// Predictions of frames that had one already.
    pub twice: u64,
    /// From the publication of a frame to the reception of its prediction.
    pub way: Spread,
    /// The longest of these times.
    pub way_tail: Tail,
    /// Longest time between two predictions of a stream (s).
    pub silence: f64,
    /// Use of the processor; not known on all systems, nor when a node is killed.
    pub processor: Option<ProcessorUse>,
}

/// Use of the processor, each in seconds per second: 1 is one core.
#[derive(Clone, Copy, Debug, Serialize)]
pub struct ProcessorUse {
    /// All nodes together.
    pub nodes: f64,
    /// The router.
    pub router: f64,
    /// This process, which publishes the frames and receives the predictions.
    pub source: f64,
}

/// Why a measurement failed.
#[derive(Debug, thiserror::Error)]
pub enum BenchError {
    /// The shipped checkpoint, which the nodes predict with, cannot be read.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// A process cannot be started.
    #[error("cannot start a node: {0}")]
    Start(#[from] io::Error),
    /// A process has ended.
    #[error("{process}: found {status}, expected that it runs to the end of the measurement")]
    Ended { process: String, status: ExitStatus },
    /// Nodes have not joined the group.
    #[error("found {found} of {expected} nodes in the group after {START_TIMEOUT:?}")]
    Late { found: usize, expected: usize },
    /// A transport failed.
    #[error(transparent)]
    Transport(#[from] TransportError),
}

/// Runs nodes of `program`, which is eddy.
///
/// # Errors
/// [`BenchError`].
pub fn time(program: &Path, plan: &Plan, is_over: &dyn Fn() -> bool) -> Result<Timing, BenchError> {
    let description = Checkpoint::shipped()?.description;
    let frame = particles::body_for(&description, plan.particles);
    let mut network = Network::start(program, plan)?;
    network.wait(plan)?;
    let (source, predictions) = (network.source()?, network.predictions()?);
    network.wait_for_subscribers(source.as_ref(), plan)?;
    // All streams are warm, and those of the last hand-over are published, a second after the last warm-up frame.
    let warm_up = u64::from(description.warm_up) + plan.hertz.ceil() as u64;
    let run = Run {
        plan,
        warm_up,
        rounds: warm_up + (plan.seconds * plan.hertz).ceil() as u64,
        clock: Clock::start(),
    };
    run.measure(&mut network, frame, source, predictions, is_over)
}

/// A process that ends with the benchmark.
struct Process {
    name: String,
    child: Child,
}

impl Process {
    fn start(name: String, command: &mut Command) -> io::Result<Self> {
        let child = command.stdin(Stdio::null()).stdout(Stdio::null()).spawn()?;
        Ok(Self { name, child })
    }

    fn check(&mut self) -> Result<(), BenchError> {
        match self.child.try_wait()? {
            None => Ok(()),
            Some(status) => Err(BenchError::Ended { process: self.name.clone(), status }),
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // Neither fails for a process that has ended already.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// The router, the nodes, and this process's connection.
struct Network {
    prefix: String,
    transports: Transports,
    nodes: Vec<Process>,
    router: Process,
}

impl Network {
    fn start(program: &Path, plan: &Plan) -> Result<Self, BenchError> {
        let prefix = format!("/bench_{}", std::process::id());
        let port = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?.local_addr()?.port();
        let endpoint = format!(r#"["tcp/127.0.0.1:{port}"]"#);
        let node = |log_level: &str, input: &str, output: &str, overrides: &str| {
            let mut command = Command::new(program);
            command.args(["--quiet", "--log-level", log_level, "node", "--threads", "1"]);
            command.args(["--input", &format!("zenoh:{prefix}/{input}")]);
            command.args(["--output", &format!("zenoh:{prefix}/{output}")]);
            command.env("ZENOH_CONFIG_OVERRIDE", overrides);
            command.env_remove("ZENOH_SESSION_CONFIG_URI");
            command
        };
        // The router is a node without input in zenoh's router mode.
        let router = format!(r#"mode="router";listen/endpoints={endpoint};connect/endpoints=[]"#);
        let router = Process::start(
            "the router".into(),
            &mut node("error", "nothing", "unpredicted", &router),
        )?;
        let clock = Clock::start();
        while TcpStream::connect((Ipv4Addr::LOCALHOST, port)).is_err() {
            if clock.now() > START_TIMEOUT {
                return Err(BenchError::Late { found: 0, expected: plan.nodes });
            }
            thread::sleep(POLL_TIMEOUT);
        }
        let client = format!(r#"mode="client";connect/endpoints={endpoint}"#);
        let nodes = (0..plan.nodes).map(|number| {
            let mut node = node("warn", "particles", "prediction", &client);
            node.args(["--group", GROUP, "--ros-args", "-r", &format!("__node:=bench_{number}")]);
            // Any one may have to keep them all.
            node.args(["-p", &format!("max_streams:={}", plan.streams)]);
            Process::start(format!("node {number}"), &mut node)
        });
        let nodes = nodes.collect::<Result<_, _>>()?;
        let mut options = TransportOptions::from_env("eddy_bench")?;
        (options.zenoh.overrides, options.zenoh.config_file) = (client, None);
        Ok(Self { prefix, transports: Transports::new(options), nodes, router })
    }

    fn link(&self, name: &str) -> Link {
        Link::zenoh(&format!("{}/{name}", self.prefix))
    }

    fn source(&self) -> Result<Box<dyn Publisher>, TransportError> {
        self.transports.publisher(&self.link("particles"), ParticleFrame::TYPE, Reliability::Block)
    }

    fn predictions(&self) -> Result<Box<dyn Subscriber>, TransportError> {
        self.transports.subscriber(&self.link("prediction"), ParticleFrame::TYPE)
    }

    /// Waits until all nodes have joined the group.
    fn wait(&mut self, plan: &Plan) -> Result<(), BenchError> {
        let members = self.transports.membership(&self.link("particles"), GROUP, "bench")?;
        self.wait_until(plan, || members.members().len())
    }

    fn wait_for_subscribers(
        &mut self,
        source: &dyn Publisher,
        plan: &Plan,
    ) -> Result<(), BenchError> {
        self.wait_until(plan, || source.subscribers())
    }

    /// Waits until a count is that of the nodes.
    fn wait_until(&mut self, plan: &Plan, count: impl Fn() -> usize) -> Result<(), BenchError> {
        let (clock, expected) = (Clock::start(), plan.nodes);
        loop {
            let found = count();
            if found >= expected {
                return Ok(());
            }
            if clock.now() > START_TIMEOUT {
                return Err(BenchError::Late { found, expected });
            }
            self.check()?;
            thread::sleep(POLL_TIMEOUT);
        }
    }

    fn check(&mut self) -> Result<(), BenchError> {
        self.nodes.iter_mut().chain([&mut self.router]).try_for_each(Process::check)
    }

    /// Time on the processor until now (s): nodes, router, this process. `None` where the system does not tell.
    fn processor(&self) -> Option<[f64; 3]> {
        let nodes = self.nodes.iter().map(|node| processor(&node.child.id().to_string()));
        Some([
            nodes.sum::<Option<f64>>()?,
            processor(&self.router.child.id().to_string())?,
            processor("self")?,
        ])
    }
}

/// Time of a process on the processor (s), from Linux's `/proc/ID/stat`.
fn processor(id: &str) -> Option<f64> {
    /// Ticks per second in files for programs (`USER_HZ`), the same on every system.
    const TICKS: f64 = 100.0;
    let stat = std::fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
    // Fields 14 and 15; the second, in parentheses, may contain blanks.
    let (_, fields) = stat.rsplit_once(") ")?;
    let ticks = fields.split(' ').skip(11).take(2).map(|ticks| ticks.parse::<f64>().ok());
    Some(ticks.sum::<Option<f64>>()? / TICKS)
}

/// A measurement.
struct Run<'a> {
    plan: &'a Plan,
    /// Frames of each stream before the measurement.
    warm_up: u64,
    /// Frames of each stream.
    rounds: u64,
    clock: Clock,
}

impl Run<'_> {
    fn measure(
        &self,
        network: &mut Network,
        mut frame: Frame,
        mut source: Box<dyn Publisher>,
        mut predictions: Box<dyn Subscriber>,
        is_over: &dyn Fn() -> bool,
    ) -> Result<Timing, BenchError> {
        let (plan, clock) = (self.plan, self.clock);
        // Publication time of each frame (ns).
        let frames = plan.streams * self.rounds;
        let sent: Vec<AtomicU64> = (0..frames).map(|_| AtomicU64::new(0)).collect();
        let mut arrivals = Arrivals::default();
        let over = AtomicBool::new(false);
        let processor = thread::scope(|scope| -> Result<_, BenchError> {
            let _stopping = Stopping(&over);
            let watching =
                scope.spawn(|| self.watch(predictions.as_mut(), &sent, &over, &mut arrivals));
            let mut before = None;
            for number in 0..self.rounds {
                if number == self.warm_up {
                    before = network.processor();
                }
                if plan.kill && number == self.warm_up.midpoint(self.rounds) {
                    network.nodes.pop();
                }
                for stream in 0..plan.streams {
                    let phase = stream as f64 / plan.streams as f64;
                    let due = Duration::from_secs_f64((number as f64 + phase) / plan.hertz);
                    thread::sleep(due.saturating_sub(clock.now()));
                    (frame.stream, frame.sequence) = (stream, number);
                    frame.stamp = Stamp(0).advance(frame.dt, number as u32);
                    let now = clock.now().as_nanos() as u64;
                    sent[self.index(stream, number)].store(now, Ordering::Relaxed);
                    source.publish_frame(&frame)?;
                }
                network.check()?;
                if is_over() {
                    break;
                }
            }
            let after = if plan.kill { None } else { network.processor() };
            thread::sleep(DRAIN_TIME);
            over.store(true, Ordering::Relaxed);
            watching.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
            Ok(before.zip(after))
        })?;
        let seconds = (self.rounds - self.warm_up) as f64 / plan.hertz;
        Ok(arrivals.timing(
            plan.streams * (self.rounds - self.warm_up),
            processor.map(|(before, after)| {
                let [nodes, router, source] =
                    std::array::from_fn(|of| (after[of] - before[of]) / seconds);
                ProcessorUse { nodes, router, source }
            }),
        ))
    }

    fn index(&self, stream: u64, number: u64) -> usize {
        (stream * self.rounds + number) as usize
    }

    /// Receives predictions until the measurement is over.
    fn watch(
        &self,
        predictions: &mut dyn Subscriber,
        sent: &[AtomicU64],
        over: &AtomicBool,
        arrivals: &mut Arrivals,
    ) -> Result<(), TransportError> {
        while !over.load(Ordering::Relaxed) {
            let Some(mut payload) = predictions.receive(POLL_TIMEOUT)? else { continue };
            let arrived = self.clock.now();
            if payload.decode().is_err() {
                continue;
            }
            let Some(view) = payload.view() else { continue };
            let number = view.sequence - 1;
            if number >= self.warm_up {
                let sent = sent[self.index(view.stream, number)].load(Ordering::Relaxed);
                arrivals.add(view.stream, number, Duration::from_nanos(sent), arrived);
            }
        }
        Ok(())
    }
}

/// Predictions that have arrived.
#[derive(Debug, Default)]
struct Arrivals {
    ways: Vec<Duration>,
    /// Number of predictions of each frame of a stream.
    counts: BTreeMap<(u64, u64), u64>,
    /// Last arrival of each stream.
    last: BTreeMap<u64, Duration>,
    silence: Duration,
}

impl Arrivals {
    fn add(&mut self, stream: u64, number: u64, sent: Duration, arrived: Duration) {
        self.ways.push(arrived.saturating_sub(sent));
        *self.counts.entry((stream, number)).or_default() += 1;
        if let Some(last) = self.last.insert(stream, arrived) {
            self.silence = self.silence.max(arrived.saturating_sub(last));
        }
    }

    fn timing(self, frames: u64, processor: Option<ProcessorUse>) -> Timing {
        Timing {
            frames,
            lost: frames - self.counts.len() as u64,
            twice: self.counts.values().map(|count| count - 1).sum(),
            way_tail: Tail::of(self.ways.clone()),
            way: Spread::of(self.ways),
            silence: self.silence.as_secs_f64(),
            processor,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_duplicates_and_silence_are_counted() {
        let ms = Duration::from_millis;
        let mut arrivals = Arrivals::default();
        for (stream, number, sent, arrived) in
            [(0, 3, 0, 10), (1, 3, 5, 25), (0, 3, 0, 30), (0, 5, 200, 240)]
        {
            arrivals.add(stream, number, ms(sent), ms(arrived));
        }
        let timing = arrivals.timing(6, None);
        assert_eq!((timing.frames, timing.lost, timing.twice), (6, 3, 1));
        assert_eq!((timing.silence, timing.way_tail.worst), (0.21, 40.0));
    }

    #[test]
    #[cfg(target_os = "linux")]
    fn the_time_of_this_process_on_the_processor_grows() {
        let before = processor("self").unwrap();
        let clock = Clock::start();
        while processor("self").unwrap() < before + 0.05 {
            assert!(clock.now() < Duration::from_secs(60), "it does not grow");
        }
        assert_eq!(processor("no process"), None);
    }
}
