//! `eddy demo`: the whole job in one process: truth, surrogate, recorder, live page, report.

use std::{
    io::{IsTerminal, Write, stdout},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use anyhow::Context;

use super::{
    Interrupt,
    eval::judge_alone,
    live::Live,
    node::summary,
    pace::Pace,
    page::{Desk, Page},
    progress_bar,
    simulate::memory,
    surrogate,
};
use crate::cli::DemoArgs;
use eddy::{
    bag::{BagSummary, BagWriter, TopicId, WriterOptions},
    clock::{self, Clock},
    dataset,
    eval::Settings,
    frame::{Frame, Stamp},
    mpm::{self, Preset, Scene, Simulation},
    msg::{self, Message, ParticleFrame, PredictionStatus, cdr},
    node::{
        Control, FrameQueue, NodeSettings, OpenClock, Outputs, Presence, Recorder, Remote, RosTime,
        SurrogateNode, drive,
    },
    transport::{Link, Payload, Publisher, Reliability, Subscriber, TransportOptions, Transports},
    viewer::{Comparison, Hub, ListenAddress, Program},
};

/// The node's name in diagnostics.
const NAME: &str = "eddy_demo";
/// Liquid and jelly: lively, and cheap enough to simulate in real time.
const SCENE: u64 = 4;
/// Length of a scene unless told otherwise (simulated s).
const SECONDS: f64 = 8.0;
/// How long the watcher waits for a frame before it looks at everything else.
const PATIENCE: Duration = Duration::from_millis(20);

/// Runs the demo.
pub fn run(args: DemoArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let surrogate = surrogate::load(args.checkpoint.as_deref(), None)?;
    let comparison = Comparison::new(surrogate.description());
    let program = Program {
        command: "demo",
        title: "liquid and jelly, simulated and predicted".to_owned(),
        model: Some(surrogate.digest().to_owned()),
    };
    let mut scenes = Scenes {
        seed: args.seed,
        seconds: args.seconds.unwrap_or(SECONDS),
        endless: !args.headless && args.seconds.is_none(),
    };
    let first = scenes.simulation(0)?;
    // With a page a free run pauses with the simulation. Of scenes that are over nothing is kept.
    let settings = match args.headless {
        true => NodeSettings::default(),
        false => NodeSettings { use_sim_time: true, max_streams: 1, ..NodeSettings::default() },
    };
    let (control, remote) = (Arc::new(Control::default()), Arc::new(Remote::default()));
    let page = (!args.headless).then(|| {
        let desk = Desk::of_both(Arc::clone(&control), Arc::clone(&remote));
        let address = ListenAddress::loopback(args.port);
        Page::serve(address, surrogate.description(), program, desk)
    });
    let page = page.transpose().context("--port")?;
    let mut node = SurrogateNode::new(surrogate, settings)?;

    let folder = unused(&args.output);
    let bag = folder.join("bag");
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot make {}", folder.display()))?;
    println!("simulating {} s of truth, predicting each next frame", scenes.seconds);
    if scenes.endless {
        println!("and further scenes, which are not recorded, until Ctrl-C");
    }
    if let Some(page) = &page {
        page.announce();
    }

    let transports = Transports::new(TransportOptions::from_env(NAME)?);
    let recorder = Recorder::new(BagWriter::create(&bag, WriterOptions::default())?, clock::wall());
    let mut wires = Wires::open(&transports, recorder)?;
    wires.source.hub = page.as_ref().map(|page| Arc::clone(&page.hub));
    wires.outputs.onlookers.extend(page.as_ref().map(Page::onlooker));
    let live_line = stdout().is_terminal() && !args.headless && !quiet;
    let (truth_ended, stop) = (AtomicBool::new(false), AtomicBool::new(false));

    let complete = thread::scope(|scope| -> anyhow::Result<bool> {
        let truth = scope.spawn(|| {
            let ends = || interrupt.requested() || stop.load(Ordering::Relaxed);
            let outcome = scenes.play(first, &mut Pace::driven(&remote), ends, &mut wires.source);
            truth_ended.store(true, Ordering::Relaxed);
            // Nobody waits for a simulation that is over.
            remote.close();
            outcome
        });
        let queue = FrameQueue::new(16, Reliability::Block);
        let outputs = std::slice::from_mut(&mut wires.outputs);
        let (node, input, stop) = (&mut node, wires.input.as_mut(), &stop);
        let (transports, control) = (&transports, &control);
        let predictor = scope.spawn(move || {
            let time = RosTime::new(simulated_time(transports.clone()));
            let mut presence = Presence { name: format!("/{NAME}"), time };
            drive(node, &mut presence, input, outputs, &queue, control, stop)
        });

        let watched = wires.watch.run(
            Live::start(comparison, Duration::ZERO),
            &truth_ended,
            if live_line { Printer::Line } else { Printer::Lines { quiet } },
        );
        stop.store(true, Ordering::Relaxed);
        if watched.is_err() {
            // Nobody records any more: read on, so that the others end without waiting for us.
            wires.watch.discard(&truth_ended);
        }
        let truth = join(truth);
        join(predictor)?;
        watched?;
        truth
    })?;
    drop(page);
    let recorded = wires.watch.finish()?;
    println!("{}", summary(node.counters()));
    println!("bag:    {} ({} messages)", bag.display(), recorded.messages);
    if !complete {
        println!("interrupted: not judged");
        return Ok(());
    }
    report(&node, &folder, &bag, quiet)
}

/// What is simulated, scene after scene.
struct Scenes {
    seed: u64,
    /// Length of each (simulated s).
    seconds: f64,
    endless: bool,
}

impl Scenes {
    /// The scene of this number; each is a stream of its own.
    fn simulation(&self, number: u64) -> anyhow::Result<Simulation> {
        let seed = self.seed.wrapping_add(number);
        let scene = Scene::generate(Preset::MultiMaterial, seed, SCENE);
        let scene = Scene { id: SCENE + number, ..scene };
        let settings = mpm::Settings { duration: Some(self.seconds), ..mpm::Settings::default() };
        Ok(Simulation::new(scene, &settings)?)
    }

    /// Plays one after the other. Returns whether the first was whole.
    fn play(
        &mut self,
        first: Simulation,
        pace: &mut Pace<'_>,
        ends: impl Fn() -> bool,
        source: &mut Source,
    ) -> anyhow::Result<bool> {
        let mut simulation = first;
        for number in 1.. {
            let whole = pace.run(&mut simulation, &ends, |frame, _| source.publish(frame))?;
            if !whole || !self.endless {
                return Ok(whole || number > 1);
            }
            source.next_scene(SCENE + number - 1);
            simulation = self.simulation(number)?;
        }
        Ok(true)
    }
}

/// Where the simulated time comes from, within this process.
fn simulated_time(transports: Transports) -> OpenClock {
    Box::new(move || transports.subscriber(&Link::memory("/clock"), msg::Clock::TYPE))
}

/// The embedded links: who publishes and who listens. Everyone listens before anyone publishes.
struct Wires {
    source: Source,
    input: Box<dyn Subscriber>,
    outputs: Outputs,
    watch: Watch,
}

/// Where the truth goes, with the time.
struct Source {
    truth: Box<dyn Publisher>,
    clock: Box<dyn Publisher>,
    /// When the scene began, and how far it is: time goes on from scene to scene.
    began: Stamp,
    now: Stamp,
    /// What the page shows.
    hub: Option<Arc<Hub>>,
}

impl Source {
    fn publish(&mut self, frame: &Frame) -> anyhow::Result<()> {
        self.truth.publish_frame(frame)?;
        self.now = Stamp(self.began.0 + frame.stamp.0);
        Ok(self.clock.publish_cdr(&cdr::encode(&msg::Clock { clock: self.now.into() }))?)
    }

    /// The stream of the scene before has `ended`.
    fn next_scene(&mut self, ended: u64) {
        self.began = self.now;
        if let Some(hub) = &self.hub {
            hub.ended(ended);
        }
    }
}

/// What is recorded and shown.
struct Watch {
    recorder: Option<Recorder>,
    recorded: Option<BagSummary>,
    truth: Recorded,
    prediction: Recorded,
    status: Recorded,
}

/// A topic that is recorded as it is received.
struct Recorded {
    subscriber: Box<dyn Subscriber>,
    topic: TopicId,
}

impl Recorded {
    /// What comes; it is recorded if it belongs to the first scene.
    fn receive(
        &mut self,
        recorder: &mut Option<Recorder>,
        timeout: Duration,
    ) -> anyhow::Result<Option<Payload>> {
        let payload = self.subscriber.receive(timeout)?;
        if let (Some(payload), Some(recorder)) = (&payload, recorder)
            && payload.stream().is_none_or(|stream| stream == SCENE)
        {
            recorder.on_message(self.topic, payload.clone(), clock::wall())?;
            recorder.on_tick(clock::wall())?;
        }
        Ok(payload)
    }
}

impl Wires {
    fn open(transports: &Transports, mut recorder: Recorder) -> anyhow::Result<Self> {
        let listen = |topic: &str, kind: &str| transports.subscriber(&Link::memory(topic), kind);
        let publish = |topic: &str, kind: &str| {
            transports.publisher(&Link::memory(topic), kind, Reliability::Block)
        };
        let mut record = |topic: &str, kind: &str| -> anyhow::Result<Recorded> {
            let topic_id = recorder.topic(topic, kind)?;
            Ok(Recorded { subscriber: listen(topic, kind)?, topic: topic_id })
        };
        let truth = record("/particles", ParticleFrame::TYPE)?;
        let prediction = record("/prediction", ParticleFrame::TYPE)?;
        let status = record("/prediction/status", PredictionStatus::TYPE)?;
        let recorder = Some(recorder);
        Ok(Self {
            watch: Watch { recorder, recorded: None, truth, prediction, status },
            input: listen("/particles", ParticleFrame::TYPE)?,
            source: Source {
                truth: publish("/particles", ParticleFrame::TYPE)?,
                clock: publish("/clock", msg::Clock::TYPE)?,
                began: Stamp(0),
                now: Stamp(0),
                hub: None,
            },
            outputs: Outputs::new(
                publish("/prediction", ParticleFrame::TYPE)?,
                publish("/prediction/status", PredictionStatus::TYPE)?,
            ),
        })
    }
}

/// How the live line is shown.
enum Printer {
    /// One line of a terminal, again and again.
    Line,
    /// A new line every second.
    Lines { quiet: bool },
}

impl Watch {
    /// Records and compares until the truth has ended and nothing more comes.
    fn run(
        &mut self,
        mut live: Live,
        truth_ended: &AtomicBool,
        printer: Printer,
    ) -> anyhow::Result<()> {
        let clock = Clock::start();
        let interval = match printer {
            Printer::Line => Duration::from_millis(200),
            Printer::Lines { .. } => Duration::from_secs(1),
        };
        let mut printed = clock.now();
        loop {
            let ended = truth_ended.load(Ordering::Relaxed);
            self.predictions(&mut live)?;
            while let Some(payload) = self.status.receive(&mut self.recorder, Duration::ZERO)? {
                let status: PredictionStatus = cdr::decode(&payload.into_cdr())?;
                // What it speaks of was published before.
                self.predictions(&mut live)?;
                if status.stream != SCENE {
                    self.close()?;
                }
                live.status(&status);
            }
            match self.truth.receive(&mut self.recorder, PATIENCE)? {
                Some(payload) => live.truth(payload.into_frame()?),
                None if ended => break,
                None => {}
            }
            if clock.now() - printed >= interval {
                printed = clock.now();
                printer.print(&live.line(printed));
            }
        }
        if matches!(printer, Printer::Line) {
            println!();
        }
        Ok(())
    }

    fn predictions(&mut self, live: &mut Live) -> anyhow::Result<()> {
        while let Some(payload) = self.prediction.receive(&mut self.recorder, Duration::ZERO)? {
            live.prediction(payload.into_frame()?);
        }
        Ok(())
    }

    /// Reads and forgets until the truth has ended.
    fn discard(&mut self, truth_ended: &AtomicBool) {
        while !truth_ended.load(Ordering::Relaxed) {
            for topic in [&mut self.prediction, &mut self.status, &mut self.truth] {
                while let Ok(Some(_)) = topic.subscriber.receive(Duration::ZERO) {}
            }
            thread::sleep(PATIENCE);
        }
    }

    /// Closes the bag, if it is open.
    fn close(&mut self) -> anyhow::Result<()> {
        if let Some(recorder) = self.recorder.take() {
            self.recorded = Some(recorder.finish()?);
        }
        Ok(())
    }

    /// Records what the node published last, and closes the bag.
    fn finish(mut self) -> anyhow::Result<BagSummary> {
        for topic in [&mut self.prediction, &mut self.status] {
            while topic.receive(&mut self.recorder, Duration::ZERO)?.is_some() {}
        }
        self.close()?;
        self.recorded.context("the bag was closed twice")
    }
}

impl Printer {
    fn print(&self, line: &str) {
        match self {
            Self::Line => {
                print!("\r\x1b[2K{line}");
                // A terminal that went away is no reason to end.
                let _ = stdout().flush();
            }
            Self::Lines { quiet: false } => println!("{line}"),
            Self::Lines { quiet: true } => {}
        }
    }
}

/// Judges the surrogate by free rollouts over the bag just recorded.
fn report(node: &SurrogateNode, folder: &Path, bag: &Path, quiet: bool) -> anyhow::Result<()> {
    let streams =
        dataset::load_trajectories(&[bag.to_owned()], memory::available() / 2, &mut |_, _| ())?;
    let settings = Settings::errors_only(20, 10);
    let longest = streams.iter().map(|stream| stream.frames).max().unwrap_or(0);
    let needed = node.surrogate().description().warm_up as usize + settings.horizon;
    if longest < needed {
        println!("not judged: found {longest} frames, expected at least {needed}");
        return Ok(());
    }
    let bar = progress_bar(streams.len() as u64, "scenes", quiet);
    let report = judge_alone(node.surrogate(), "demo", streams, settings, &bar)?;
    bar.finish_and_clear();
    report.save(folder)?;
    println!("report: {}", folder.join("report.html").display());
    println!("\nfree rollouts from {} frames of this scene:\n{}", report.windows, report.tables());
    Ok(())
}

/// `path`, or the first of `path-2`, `path-3`, ... that is not there yet.
fn unused(path: &Path) -> PathBuf {
    let numbered = |number: u32| {
        let mut name = path.file_name().unwrap_or_default().to_owned();
        name.push(format!("-{number}"));
        path.with_file_name(name)
    };
    std::iter::once(path.to_owned())
        .chain((2..).map(numbered))
        .find(|candidate| !candidate.exists())
        .unwrap_or_else(|| path.to_owned())
}

fn join<T>(handle: thread::ScopedJoinHandle<'_, T>) -> T {
    handle.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}
