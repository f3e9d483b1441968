//! `eddy demo`: the whole job in one process: truth, surrogate, recorder, live page, report.

mod live;
mod scenes;
mod watch;

use std::{
    io::{IsTerminal, stdout},
    path::{Path, PathBuf},
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use anyhow::Context;

use self::{
    live::Live,
    scenes::{Scenes, Source},
    watch::{Printer, Recorded, Watch},
};
use super::{
    Interrupt, TerminalProgress,
    node::summary,
    pace::Pace,
    page::{Desk, Page},
    surrogate,
};
use crate::cli::DemoArgs;
use eddy_bag::{BagWriter, WriterOptions};
use eddy_evaluation::{Settings, dataset, evaluate_model};
use eddy_frames::{Stamp, clock};
use eddy_messages::{self as msg, Message, ParticleFrame, PredictionStatus};
use eddy_node::{
    Control, FrameQueue, NodeSettings, OpenClock, Outputs, Presence, Recorder, Remote, RosTime,
    SurrogateNode, drive,
    viewer::{Comparison, Program},
};
use eddy_transport::{Link, ListenAddress, Reliability, Subscriber, TransportOptions, Transports};

/// The node's name in diagnostics.
const NAME: &str = "eddy_demo";
/// Liquid and jelly: lively, and cheap enough to simulate in real time.
const SCENE: u64 = 4;
/// Length of a scene unless told otherwise (simulated s).
const SECONDS: f64 = 8.0;

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
        // Both wait for room where nobody reads.
        wires.watch.read_on(watched.is_ok(), || truth.is_finished() && predictor.is_finished());
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
    report(&node, &folder, &bag, quiet, interrupt)
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

/// Judges the surrogate by free rollouts over the bag just recorded.
fn report(
    node: &SurrogateNode,
    folder: &Path,
    bag: &Path,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let streams = dataset::load_trajectories(
        &[bag.to_owned()],
        dataset::available_memory() / 2,
        &mut |_, _| (),
    )?;
    let settings = Settings::errors_only(20, 10);
    let longest = streams.iter().map(|stream| stream.frames).max().unwrap_or(0);
    let needed = node.surrogate().description().warm_up as usize + settings.horizon;
    if longest < needed {
        println!("not judged: found {longest} frames, expected at least {needed}");
        return Ok(());
    }
    let progress = TerminalProgress::new(quiet, interrupt);
    let report = evaluate_model(node.surrogate(), "demo", streams, settings, &progress)?;
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
