//! `eddy demo`: simulation, surrogate, recorder, live page and report in one process.

mod live;
mod push;
mod scenes;
mod watch;

use std::{
    io::{IsTerminal, stdout},
    path::Path,
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
    scenes::{Progress, Scenes, Source},
    watch::{Printer, Recorded, Watch},
};
use super::{announce_page, eval::print_report, node::summary, surrogate};
use crate::cli::{DemoArgs, DemoScene};
use eddy_bag::{BagWriter, WriterOptions};
use eddy_cli::{Device, Interrupt, Output, OutputKind, TerminalProgress, unused};
use eddy_dataset::LoadOptions;
use eddy_evaluation::{Settings, evaluate_model};
use eddy_frames::{Stamp, clock, decimal};
use eddy_inference::checkpoint::Description;
use eddy_messages::{
    self as msg, Message, ParticleFrame, PredictionStatus, ToolDescription, ToolFrame, tool_topics,
};
use eddy_mpm::Scene;
use eddy_node::{
    FrameQueue, NodeContext, NodeHandle, NodeSettings, OpenClock, Outputs, Pacer, PlayerHandle,
    Recorder, RosTime, SurrogateNode, drive,
    tools::ToolTopics,
    viewer::{Comparison, ControlPanel, LivePage, PageInfo},
};
use eddy_transport::{Link, ListenAddress, Reliability, Subscriber, TransportOptions, Transports};

/// Name of the node in diagnostics.
const NAME: &str = "eddy_demo";
/// Scene with liquid and jelly, small enough to simulate in real time.
const SCENE: u64 = 4;
/// Default output directory.
const DEFAULT_OUTPUT: &str = "bags/demo";
/// Default duration of a scene (simulated s): then little happens.
const SECONDS: f64 = 5.0;
/// The same with a blade that is moved by hand.
const SECONDS_OF_PUSHING: f64 = 20.0;
/// Frames that are predicted ahead: far enough that truth and prediction can look different.
const AHEAD: u32 = 20;

/// Runs the demo.
pub fn run(args: DemoArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let folder = args.output.clone().unwrap_or_else(|| unused(Path::new(DEFAULT_OUTPUT)));
    let output = Output::at(&folder, OutputKind::Demo, args.force, &[])?;
    let surrogate = surrogate::load(args.checkpoint.as_deref(), None, Device::Cpu)?;
    let comparison = Comparison::new(surrogate.description());
    let info = PageInfo {
        command: "demo",
        title: format!("Predicted {AHEAD} frames ahead, beside what then happened"),
        model: Some(surrogate.digest().to_owned()),
    };
    let mut scenes = scenes(&args);
    let first = scenes.simulation(0)?;
    let settings = node_settings(args.headless, surrogate.description(), first.scene());
    let (handle, source) = (Arc::new(NodeHandle::default()), Arc::new(PlayerHandle::default()));
    let page = (!args.headless).then(|| {
        let (node, source) = (Arc::clone(&handle), Arc::clone(&source));
        let panel = match scenes.blade.clone() {
            Some(blade) => ControlPanel::of_both_and_tool(node, source, blade),
            None => ControlPanel::of_both(node, source),
        };
        let address = ListenAddress::loopback(args.port);
        LivePage::serve(address, surrogate.description(), info, panel)
    });
    let page = page.transpose().context("--port")?;
    let mut node = SurrogateNode::new(surrogate, settings)?;

    let bag = folder.join("bag");
    std::fs::create_dir_all(&folder)
        .with_context(|| format!("cannot create {}", folder.display()))?;
    introduce(&scenes, first.scene().frames.interval);
    if let Some(page) = &page {
        announce_page(page);
    }

    let transports = Transports::new(TransportOptions::from_env(NAME)?);
    let recorder = Recorder::new(BagWriter::create(&bag, WriterOptions::default())?, clock::wall());
    let mut links = Links::open(&transports, recorder, scenes.blade.is_some())?;
    links.source.hub = page.as_ref().map(|page| Arc::clone(page.hub()));
    links.outputs.observers.extend(page.as_ref().map(LivePage::observer));
    let live_line = stdout().is_terminal() && !args.headless && !quiet;
    let printer = if live_line { Printer::Line } else { Printer::Lines { quiet } };
    let simulate = |stop: &AtomicBool, to: &mut Source| {
        let is_stopped = || interrupt.requested() || stop.load(Ordering::Relaxed);
        let outcome = scenes.play(first, &mut Pacer::controlled(&source), is_stopped, to);
        // Nobody waits for a simulation that has ended.
        source.close();
        outcome
    };
    let live = Live::start(comparison, Duration::ZERO);
    let complete = links.run(&transports, &mut node, &handle, simulate, live, printer)?;
    drop(page);
    let recorded = links.watch.finish()?;
    output.replaced();
    println!("{}", summary(&node));
    println!("bag:    {} ({} messages)", bag.display(), recorded.messages);
    if !complete {
        println!("interrupted: not evaluated");
        return Ok(());
    }
    report(&node, &folder, &bag, quiet, interrupt)
}

/// The scenes that are asked for.
fn scenes(args: &DemoArgs) -> Scenes {
    let endless = !args.headless && args.seconds.is_none();
    let pushes = args.scene == DemoScene::Push;
    let usual = if pushes && endless { SECONDS_OF_PUSHING } else { SECONDS };
    Scenes {
        seed: args.seed,
        seconds: args.seconds.unwrap_or(usual),
        endless,
        blade: pushes.then(Arc::default),
    }
}

/// Settings of the node that predicts `scene`.
fn node_settings(headless: bool, model: &Description, scene: &Scene) -> NodeSettings {
    // All scenes have the preset's stiffness.
    let stiffness = model.stiffness.then_some(scene.materials.stiffness.into());
    let settings = NodeSettings { horizon: AHEAD, stiffness, ..NodeSettings::default() };
    match headless {
        true => settings,
        // With a page, free runs pause with the simulation, and finished scenes are forgotten.
        false => NodeSettings { use_sim_time: true, max_streams: 1, ..settings },
    }
}

/// Says what is simulated and what the numbers mean.
fn introduce(scenes: &Scenes, interval: f32) {
    let ahead = f64::from(AHEAD) * decimal(interval);
    println!(
        "Simulating matter, and predicting it {AHEAD} frames ({ahead:.2} s) ahead from what was observed so far."
    );
    if scenes.blade.is_some() {
        println!(
            "A blade pushes it; on the live page it follows the mouse or the arrow keys. The shipped network does not\nknow tools: near the blade it predicts as if that were not there."
        );
    }
    if scenes.endless {
        println!(
            "Scenes follow one another until Ctrl-C; the first one is recorded and evaluated."
        );
    }
    println!("error:  RMS distance from predicted to true positions (the box is 1 x 1)");
    println!("skill:  1 is perfect; 0 is as good as the best of three simple guesses, which");
    println!("        stands before it with its own error; below 0 the guess is better;");
    println!("        at rest, where nothing is left to predict, there is none");
}

/// Says what to type next.
fn next_steps(bag: &Path) {
    println!("next:   eddy bag render {} --output demo.gif \\", bag.display());
    println!("            --topic /particles /prediction   # truth beside prediction");
    println!("        eddy node --view             # predict your own /particles topic");
    println!("        docs/src/tutorial.md         # simulate, train, evaluate, deploy");
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
    fn open(
        transports: &Transports,
        mut recorder: Recorder,
        has_tools: bool,
    ) -> anyhow::Result<Self> {
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
        let [poses, description] = tool_topics("/particles");
        let of_tools = [(&description, ToolDescription::TYPE), (&poses, ToolFrame::TYPE)];
        let of_tools = of_tools.into_iter().filter(|_| has_tools);
        let recorded_tools =
            of_tools.map(|(topic, kind)| record(topic, kind)).collect::<Result<_, _>>()?;
        let tools = has_tools
            .then(|| ToolTopics::open(transports, &Link::memory("/particles"), Reliability::Block))
            .transpose()?;
        let recorder = Some(recorder);
        let progress = Progress::default();
        let mut outputs = Outputs::new(
            publish("/prediction", ParticleFrame::TYPE)?,
            publish("/prediction/status", PredictionStatus::TYPE)?,
        );
        outputs.observers.push(Box::new(progress.clone()));
        Ok(Self {
            watch: Watch {
                recorder,
                recorded: None,
                truth,
                prediction,
                status,
                tools: recorded_tools,
            },
            input: subscribe("/particles", ParticleFrame::TYPE)?,
            source: Source {
                truth: publish("/particles", ParticleFrame::TYPE)?,
                clock: publish("/clock", msg::Clock::TYPE)?,
                began: Stamp(0),
                now: Stamp(0),
                progress,
                published: 0,
                hub: None,
                named: None,
                tools,
            },
            outputs,
        })
    }

    /// Simulates, predicts and watches, each on a thread of its own, until the simulation has ended. `simulate` returns whether
    /// the first scene was complete, and ends when the flag is raised.
    fn run(
        &mut self,
        transports: &Transports,
        node: &mut SurrogateNode,
        handle: &NodeHandle,
        simulate: impl FnOnce(&AtomicBool, &mut Source) -> anyhow::Result<bool> + Send,
        live: Live,
        printer: Printer,
    ) -> anyhow::Result<bool> {
        let Self { source, input, outputs, watch } = self;
        let progress = source.progress.clone();
        let (truth_ended, stop) = (AtomicBool::new(false), AtomicBool::new(false));
        thread::scope(|scope| {
            let truth = scope.spawn(|| {
                let outcome = simulate(&stop, source);
                truth_ended.store(true, Ordering::Relaxed);
                outcome
            });
            let queue = FrameQueue::new(16, Reliability::Block);
            let (input, outputs, stop) = (input.as_mut(), std::slice::from_mut(outputs), &stop);
            let predictor = scope.spawn(move || {
                let time = RosTime::new(simulated_time(transports.clone()));
                let (name, link) = (format!("/{NAME}"), Link::memory("/particles"));
                let mut context = NodeContext { name, input: link, time, group: None };
                let outcome = drive(node, &mut context, input, outputs, &queue, handle, stop);
                progress.end();
                outcome
            });
            let watched = watch.run(live, &truth_ended, printer);
            stop.store(true, Ordering::Relaxed);
            // Both block while nobody reads their topics.
            watch.drain(watched.is_ok(), || truth.is_finished() && predictor.is_finished());
            let truth = join(truth);
            join(predictor)?;
            watched?;
            truth
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
    let memory = LoadOptions::within(eddy_dataset::available_memory() / 2);
    let mut streams =
        eddy_dataset::load_trajectories(&[bag.to_owned()], memory, &mut |_, _| ())?.streams;
    let stiffness = node.settings().stiffness.map(|stiffness| stiffness as f32);
    streams.iter_mut().for_each(|stream| stream.stiffness = stiffness);
    let settings = Settings::errors_only(20, 10);
    let longest = streams.iter().map(|stream| stream.frames).max().unwrap_or(0);
    let horizon = settings.horizon;
    let needed = node.surrogate().description().warm_up as usize + horizon;
    if longest < needed {
        println!("not evaluated: found {longest} frames, expected at least {needed}");
        return Ok(());
    }
    let progress = TerminalProgress::new(quiet, interrupt);
    let report = evaluate_model(node.surrogate(), "demo", streams, settings, &progress)?;
    report.save(folder)?;
    println!("\nPredicted again from {} frames, each time {horizon} frames ahead:", report.windows);
    print_report(&report, folder, false);
    next_steps(bag);
    Ok(())
}

fn join<T>(handle: thread::ScopedJoinHandle<'_, T>) -> T {
    handle.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))
}
