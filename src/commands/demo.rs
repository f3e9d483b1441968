//! `eddy demo`: the whole job in one process: truth, surrogate, recorder, report.

use std::{
    io::{IsTerminal, Write, stdout},
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use anyhow::Context;

use super::{
    Interrupt, eval::judge_alone, live::Live, node::summary, pace, progress_bar, simulate::memory,
    surrogate,
};
use crate::cli::DemoArgs;
use eddy::{
    bag::{BagSummary, BagWriter, TopicId, WriterOptions},
    clock::{self, Clock},
    dataset,
    eval::Settings,
    model::Ballistic,
    mpm::{self, Preset, Scene, Simulation},
    msg::{Message, ParticleFrame, PredictionStatus, cdr},
    node::{
        Control, FrameQueue, NodeSettings, Outputs, Presence, Recorder, RosTime, SurrogateNode,
        drive,
    },
    transport::{Link, Payload, Publisher, Reliability, Subscriber, TransportOptions, Transports},
};

/// The node's name in diagnostics.
const NAME: &str = "eddy_demo";
/// Liquid and jelly: lively, and cheap enough to simulate in real time.
const SCENE: u64 = 4;
/// How long the watcher waits for a frame before it looks at everything else.
const PATIENCE: Duration = Duration::from_millis(20);

/// Runs the demo.
pub fn run(args: DemoArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let surrogate = surrogate::load(args.checkpoint.as_deref(), None)?;
    let ballistic = Ballistic::of(surrogate.description());
    let scene = Scene::generate(Preset::MultiMaterial, args.seed, SCENE);
    let settings = mpm::Settings { duration: Some(args.seconds), ..mpm::Settings::default() };
    let mut simulation = Simulation::new(scene, &settings)?;
    let mut node = SurrogateNode::new(surrogate, NodeSettings::default())?;

    let folder = unused(&args.output);
    let bag = folder.join("bag");
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot make {}", folder.display()))?;
    println!("simulating {} s of truth, predicting each next frame", args.seconds);

    let transports = Transports::new(TransportOptions::from_env(NAME)?);
    let recorder = Recorder::new(BagWriter::create(&bag, WriterOptions::default())?, clock::wall());
    let mut wires = Wires::open(&transports, recorder)?;
    let live_line = stdout().is_terminal() && !args.headless && !quiet;
    let (truth_ended, stop) = (AtomicBool::new(false), AtomicBool::new(false));

    thread::scope(|scope| -> anyhow::Result<()> {
        let truth = scope.spawn(|| {
            let ends = || interrupt.requested() || stop.load(Ordering::Relaxed);
            let outcome = pace::run(&mut simulation, 1.0, ends, |frame, _| {
                Ok(wires.truth.publish_frame(frame)?)
            });
            truth_ended.store(true, Ordering::Relaxed);
            outcome.map(|_| ())
        });
        let queue = FrameQueue::new(16, Reliability::Block);
        let outputs = std::slice::from_mut(&mut wires.outputs);
        let (node, input, stop) = (&mut node, wires.input.as_mut(), &stop);
        let predictor = scope.spawn(move || {
            let mut presence =
                Presence { name: format!("/{NAME}"), time: RosTime::of_the_machine() };
            drive(node, &mut presence, input, outputs, &queue, &Control::default(), stop)
        });

        let watched = wires.watch.run(
            Live::start(ballistic, Duration::ZERO),
            &truth_ended,
            if live_line { Printer::Line } else { Printer::Lines { quiet } },
        );
        stop.store(true, Ordering::Relaxed);
        if watched.is_err() {
            // Nobody records any more: read on, so that the others end without waiting for us.
            wires.watch.discard(&truth_ended);
        }
        for outcome in [join(truth), join(predictor).map_err(Into::into)] {
            outcome?;
        }
        watched
    })?;
    let recorded = wires.watch.finish()?;
    println!("{}", summary(node.counters()));
    println!("bag:    {} ({} messages)", bag.display(), recorded.messages);
    if interrupt.requested() {
        println!("interrupted: not judged");
        return Ok(());
    }
    report(&node, &folder, &bag, quiet)
}

/// The embedded links: who publishes and who listens. Everyone listens before anyone publishes.
struct Wires {
    truth: Box<dyn Publisher>,
    input: Box<dyn Subscriber>,
    outputs: Outputs,
    watch: Watch,
}

/// What is recorded and shown.
struct Watch {
    recorder: Recorder,
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
    fn receive(
        &mut self,
        recorder: &mut Recorder,
        timeout: Duration,
    ) -> anyhow::Result<Option<Payload>> {
        let payload = self.subscriber.receive(timeout)?;
        if let Some(payload) = &payload {
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
        Ok(Self {
            watch: Watch { recorder, truth, prediction, status },
            input: listen("/particles", ParticleFrame::TYPE)?,
            truth: publish("/particles", ParticleFrame::TYPE)?,
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
            let recorder = &mut self.recorder;
            while let Some(payload) = self.prediction.receive(recorder, Duration::ZERO)? {
                live.prediction(payload.into_frame()?);
            }
            while let Some(payload) = self.status.receive(recorder, Duration::ZERO)? {
                let status: PredictionStatus = cdr::decode(&payload.into_cdr())?;
                live.latency(Duration::from_secs_f32(status.latency.max(0.0)));
            }
            match self.truth.receive(recorder, PATIENCE)? {
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

    /// Reads and forgets until the truth has ended.
    fn discard(&mut self, truth_ended: &AtomicBool) {
        while !truth_ended.load(Ordering::Relaxed) {
            for topic in [&mut self.prediction, &mut self.status, &mut self.truth] {
                while let Ok(Some(_)) = topic.subscriber.receive(Duration::ZERO) {}
            }
            thread::sleep(PATIENCE);
        }
    }

    /// Records what the node published last, and closes the bag.
    fn finish(mut self) -> anyhow::Result<BagSummary> {
        for topic in [&mut self.prediction, &mut self.status] {
            while topic.receive(&mut self.recorder, Duration::ZERO)?.is_some() {}
        }
        Ok(self.recorder.finish()?)
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
