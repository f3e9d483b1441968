//! `eddy demo`: simulation, surrogate, recorder, live page and report in one process.

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
use super::{Interrupt, TerminalProgress, announce_page, node::summary, surrogate};
use crate::cli::DemoArgs;
use eddy_bag::{BagWriter, WriterOptions};
use eddy_evaluation::{Settings, dataset, evaluate_model};
use eddy_frames::{Stamp, clock};
use eddy_messages::{self as msg, Message, ParticleFrame, PredictionStatus};
use eddy_node::{
    FrameQueue, NodeContext, NodeHandle, NodeSettings, OpenClock, Outputs, Pacer, PlayerHandle,
    Recorder, RosTime, SurrogateNode, drive,
    viewer::{Comparison, ControlPanel, LivePage, PageInfo},
};
use eddy_transport::{Link, ListenAddress, Reliability, Subscriber, TransportOptions, Transports};

/// Name of the node in diagnostics.
const NAME: &str = "eddy_demo";
/// Scene with liquid and jelly, small enough to simulate in real time.
const SCENE: u64 = 4;
/// Default duration of a scene (simulated s).
const SECONDS: f64 = 8.0;

/// Runs the demo.
pub fn run(args: DemoArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let surrogate = surrogate::load(args.checkpoint.as_deref(), None)?;
    let comparison = Comparison::new(surrogate.description());
    let info = PageInfo {
        command: "demo",
        title: "Liquid and jelly, simulated and predicted".to_owned(),
        model: Some(surrogate.digest().to_owned()),
    };
    let mut scenes = Scenes {
        seed: args.seed,
        seconds: args.seconds.unwrap_or(SECONDS),
        endless: !args.headless && args.seconds.is_none(),
    };
    let first = scenes.simulation(0)?;
    // With a page, free runs pause with the simulation, and finished scenes are evicted.
    let settings = match args.headless {
        true => NodeSettings::default(),
        false => NodeSettings { use_sim_time: true, max_streams: 1, ..NodeSettings::default() },
    };
    let (handle, source) = (Arc::new(NodeHandle::default()), Arc::new(PlayerHandle::default()));
    let page = (!args.headless).then(|| {
        let panel = ControlPanel::of_both(Arc::clone(&handle), Arc::clone(&source));
        let address = ListenAddress::loopback(args.port);
        LivePage::serve(address, surrogate.description(), info, panel)
    });
    let page = page.transpose().context("--port")?;
    let mut node = SurrogateNode::new(surrogate, settings)?;

    let folder = unused(&args.output);
    let bag = folder.join("bag");
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot create {}", folder.display()))?;
    println!("simulating {} s and predicting each next frame", scenes.seconds);
    if scenes.endless {
        println!("followed by more scenes, which are not recorded, until Ctrl-C");
    }
    if let Some(page) = &page {
        announce_page(page);
    }

    let transports = Transports::new(TransportOptions::from_env(NAME)?);
    let recorder = Recorder::new(BagWriter::create(&bag, WriterOptions::default())?, clock::wall());
    let mut links = Links::open(&transports, recorder)?;
    links.source.hub = page.as_ref().map(|page| Arc::clone(page.hub()));
    links.outputs.observers.extend(page.as_ref().map(LivePage::observer));
    let live_line = stdout().is_terminal() && !args.headless && !quiet;
    let (truth_ended, stop) = (AtomicBool::new(false), AtomicBool::new(false));

    let complete = thread::scope(|scope| -> anyhow::Result<bool> {
        let truth = scope.spawn(|| {
            let is_stopped = || interrupt.requested() || stop.load(Ordering::Relaxed);
            let outcome =
                scenes.play(first, &mut Pacer::controlled(&source), is_stopped, &mut links.source);
            truth_ended.store(true, Ordering::Relaxed);
            // Nobody waits for a simulation that has ended.
            source.close();
            outcome
        });
        let queue = FrameQueue::new(16, Reliability::Block);
        let outputs = std::slice::from_mut(&mut links.outputs);
        let (node, input, stop) = (&mut node, links.input.as_mut(), &stop);
        let (transports, handle) = (&transports, &handle);
        let predictor = scope.spawn(move || {
            let time = RosTime::new(simulated_time(transports.clone()));
            let (name, link) = (format!("/{NAME}"), Link::memory("/particles"));
            let mut context = NodeContext { name, input: link, time };
            drive(node, &mut context, input, outputs, &queue, handle, stop)
        });

        let watched = links.watch.run(
            Live::start(comparison, Duration::ZERO),
            &truth_ended,
            if live_line { Printer::Line } else { Printer::Lines { quiet } },
        );
        stop.store(true, Ordering::Relaxed);
        // Both block while nobody reads their topics.
        links.watch.drain(watched.is_ok(), || truth.is_finished() && predictor.is_finished());
        let truth = join(truth);
        join(predictor)?;
        watched?;
        truth
    })?;
    drop(page);
    let recorded = links.watch.finish()?;
    println!("{}", summary(node.counters()));
    println!("bag:    {} ({} messages)", bag.display(), recorded.messages);
    if !complete {
        println!("interrupted: not evaluated");
        return Ok(());
    }
    report(&node, &folder, &bag, quiet, interrupt)
}

/// Subscribes to the simulated time within this process.
fn simulated_time(transports: Transports) -> OpenClock {
    Box::new(move || transports.subscriber(&Link::memory("/clock"), msg::Clock::TYPE))
}

/// The links within this process. All subscribers are opened before the first message is published.
struct Links {
    source: Source,
    input: Box<dyn Subscriber>,
    outputs: Outputs,
    watch: Watch,
}

impl Links {
    fn open(transports: &Transports, mut recorder: Recorder) -> anyhow::Result<Self> {
        let subscribe = |topic: &str, kind: &str| transports.subscriber(&Link::memory(topic), kind);
        let publish = |topic: &str, kind: &str| {
            transports.publisher(&Link::memory(topic), kind, Reliability::Block)
        };
        let mut record = |topic: &str, kind: &str| -> anyhow::Result<Recorded> {
            let topic_id = recorder.topic(topic, kind)?;
            Ok(Recorded { subscriber: subscribe(topic, kind)?, topic: topic_id })
        };
        let truth = record("/particles", ParticleFrame::TYPE)?;
        let prediction = record("/prediction", ParticleFrame::TYPE)?;
        let status = record("/prediction/status", PredictionStatus::TYPE)?;
        let recorder = Some(recorder);
        Ok(Self {
            watch: Watch { recorder, recorded: None, truth, prediction, status },
            input: subscribe("/particles", ParticleFrame::TYPE)?,
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

/// Evaluates the surrogate by free rollouts over the recorded bag.
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
        println!("not evaluated: found {longest} frames, expected at least {needed}");
        return Ok(());
    }
    let progress = TerminalProgress::new(quiet, interrupt);
    let report = evaluate_model(node.surrogate(), "demo", streams, settings, &progress)?;
    report.save(folder)?;
    println!("report: {}", folder.join("report.html").display());
    println!("\nfree rollouts from {} frames of this scene:\n{}", report.windows, report.tables());
    Ok(())
}

/// `path`, or the first of `path-2`, `path-3`, ... that does not exist.
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
