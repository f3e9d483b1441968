//! `eddy node`: predicts frames of live streams.

use std::{
    io::{IsTerminal as _, stdout},
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use anyhow::Context;
use serde::{Deserialize, Deserializer, de::Error as _};

use super::{announce_page, counted, keyboard::Keyboard, publish_log, surrogate};
use crate::cli::NodeArgs;
use eddy_cli::{Interrupt, terminal};
use eddy_frames::FrameView;
#[cfg(feature = "foxglove")]
use eddy_messages::{DiagnosticArray, PointCloud2, PredictionStatus};
use eddy_messages::{Message, ParticleFrame};
#[cfg(feature = "foxglove")]
use eddy_node::{CloudTopic, Outputs};
use eddy_node::{
    InvalidSettings, LiveNode, NodeHandle, NodeLinks, NodeReport, NodeRequest, NodeResponse,
    NodeSettings, Observer, Prediction, SurrogateNode,
    ros::{ParameterOverride, RosNode, Rosout, TopicQos},
    viewer::{ControlPanel, LivePage, PageInfo},
};
use eddy_settings::{self as config, usage::Usage};
#[cfg(feature = "foxglove")]
use eddy_transport::{FoxgloveAddress, FoxgloveServer};
use eddy_transport::{Link, ListenAddress, Reliability};

/// Interval between looks at the keyboard.
const KEY_INTERVAL: Duration = Duration::from_millis(50);
/// How long a key waits for the node.
const KEY_TIMEOUT: Duration = Duration::from_secs(1);

/// A settings file of `eddy node`; command-line options override it.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct NodeFile {
    /// Checkpoint directory [default: the shipped particle model].
    checkpoint: Option<PathBuf>,
    /// Input link [default: `zenoh:particles`].
    #[serde(deserialize_with = "link")]
    input: Option<Link>,
    /// Output links [default: `zenoh:prediction`].
    #[serde(deserialize_with = "links")]
    output: Vec<Link>,
    /// What happens when a subscriber cannot keep up [default: `drop`].
    reliability: Option<Reliability>,
    /// Settings of the node, the same as its ROS parameters.
    node: NodeSettings,
}

/// A link whose topic may be relative to the node.
fn link<'de, D: Deserializer<'de>>(from: D) -> Result<Option<Link>, D::Error> {
    let text = String::deserialize(from)?;
    Link::parse_of_node(&text).map(Some).map_err(D::Error::custom)
}

/// Such links.
fn links<'de, D: Deserializer<'de>>(from: D) -> Result<Vec<Link>, D::Error> {
    let texts = Vec::<String>::deserialize(from)?;
    texts.iter().map(|text| Link::parse_of_node(text).map_err(D::Error::custom)).collect()
}

/// Runs the node until a signal comes.
pub fn run(
    args: NodeArgs,
    ros: &RosNode,
    rosout: Option<&Rosout>,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    // Before the first thread starts: threads inherit all of this.
    args.real_time.apply()?;
    let (mut live, links) = open(&args, ros, interrupt)?;
    let renamed = links.renamed(ros);
    let on = renamed.all().map(|link| link.transport);
    let _log = publish_log(rosout, live.transports(), ros, on)?;
    let input = &renamed.input;
    #[cfg(feature = "foxglove")]
    let foxglove = foxglove(args.foxglove, &args.foxglove_origin, &links, ros, &mut live.outputs)
        .context("--foxglove")?;
    // Dropped before the outputs, whose observer may outlive it.
    let title = format!("{} on {input}", ros.full_name());
    let page = args.view.map(|address| serve_page(address, title, &mut live)).transpose()?;
    if !quiet {
        show_links(&live, &renamed)?;
    }
    #[cfg(feature = "foxglove")]
    if let Some(server) = &foxglove {
        let is_local = server.address().ip().is_loopback();
        let warning = if is_local { "" } else { " (anyone who can reach this address can watch)" };
        println!("foxglove: ws://{}{warning}", server.address());
    }
    if let Some(page) = &page {
        announce_page(page);
    }
    let has_line = !quiet && stdout().is_terminal();
    if let (true, Some(first)) = (has_line, live.outputs.first_mut()) {
        terminal::show_status(&format!("waiting for frames on {input}"));
        first.observers.push(Box::new(StatusLine));
    }
    let (handle, ended) = (Arc::clone(live.handle()), AtomicBool::new(false));
    let outcome = thread::scope(|scope| {
        let keyboard = if has_line { Keyboard::open() } else { None };
        if let Some(keyboard) = keyboard {
            println!("keys: r resets all streams");
            scope.spawn(|| answer_keys(keyboard, &handle, &ended));
        }
        let outcome = live.run();
        ended.store(true, Ordering::Relaxed);
        outcome
    });
    terminal::clear_status();
    if !quiet {
        println!("{}", summary(live.node()));
    }
    Ok(outcome?)
}

/// Opens the node with its links: of the command line, else of the settings file, else the default ones.
fn open(
    args: &NodeArgs,
    ros: &RosNode,
    interrupt: &Interrupt,
) -> anyhow::Result<(LiveNode, NodeLinks)> {
    let file: NodeFile = match &args.config {
        Some(path) => config::load(path)?,
        None => NodeFile::default(),
    };
    let mut settings = file.node;
    let options = args.settings.parameters();
    options.iter().try_for_each(|option| settings.set(option)).map_err(Usage::new)?;
    set_parameters(&mut settings, ros)?;
    let outputs = if args.output.is_empty() { file.output } else { args.output.clone() };
    let links = NodeLinks::new(args.input.clone().or(file.input), outputs)
        .map_err(|error| Usage::new(format_args!("EDDY_TRANSPORT: {error}")))?;
    let is_in_group = !settings.group.is_empty();
    links.renamed(ros).check(args.lifecycle, is_in_group).map_err(Usage::new)?;
    let reliability = args.reliability.or(file.reliability).unwrap_or(Reliability::Drop);
    let qos = TopicQos::from_parameters(ros.parameters())?;

    let checkpoint = args.checkpoint.as_deref().or(file.checkpoint.as_deref());
    let surrogate = surrogate::load(checkpoint, args.threads, args.device)?;
    let mut node = SurrogateNode::new(surrogate, settings)?;
    if args.lifecycle {
        node.manage();
    }
    let live = LiveNode::open(node, &links, ros, reliability, qos, interrupt.shared())?;
    Ok((live, links))
}

/// Serves the live page, which observes the first output.
fn serve_page(
    address: ListenAddress,
    title: String,
    live: &mut LiveNode,
) -> anyhow::Result<LivePage> {
    let surrogate = live.node().surrogate();
    let info = PageInfo { command: "node", title, model: Some(surrogate.digest().to_owned()) };
    let panel = ControlPanel::of_node(Arc::clone(live.handle()));
    let page = LivePage::serve(address, surrogate.description(), info, panel).context("--view")?;
    if let Some(first) = live.outputs.first_mut() {
        first.observers.push(page.observer());
    }
    Ok(page)
}

/// Says what is predicted from which topic to which, and the shared memory that this takes.
fn show_links(live: &LiveNode, renamed: &NodeLinks) -> anyhow::Result<()> {
    let digest = &live.node().surrogate().digest()[..12];
    let (input, outputs) = (&renamed.input, &renamed.outputs);
    let names: Vec<_> = outputs.iter().map(ToString::to_string).collect();
    println!("predicting {input} -> {} with model {digest}", names.join(", "));
    tracing::info!("predicting {input} -> {} with model {digest}", names.join(", "));
    for link in outputs {
        if let Some(memory) = live.transports().shared_memory(link, ParticleFrame::TYPE)? {
            println!("{link} uses {memory}, more for frames of more than 2,560 particles");
        }
    }
    Ok(())
}

/// Sets the parameters of `--ros-args`, which take precedence, except those for the QoS of topics and those without an effect. Unknown parameters for
/// nodes of any name are ignored.
fn set_parameters(settings: &mut NodeSettings, ros: &RosNode) -> anyhow::Result<()> {
    let is_setting = |given: &&ParameterOverride| {
        !TopicQos::is_parameter(&given.parameter.name) && !given.is_without_effect()
    };
    for given in ros.parameters().iter().filter(is_setting) {
        match settings.set(&given.parameter) {
            Ok(()) => {}
            Err(InvalidSettings::Unknown { found }) if given.for_all => {
                tracing::debug!("{}: this node has no parameter {found}", given.argument);
            }
            Err(error) => return Err(error).context(given.argument.clone()),
        }
    }
    Ok(())
}

/// Shows rate, latency and losses on the terminal once a second.
struct StatusLine;

impl Observer for StatusLine {
    fn observed(&mut self, _: &FrameView<'_>) {}

    fn predicted(&mut self, _: &Prediction<'_>) {}

    fn reported(&mut self, report: &NodeReport<'_>) {
        let &NodeReport { rates, counters, streams, rejected, .. } = report;
        if counters.received == 0 {
            return;
        }
        let milliseconds = |latency: Duration| format!("{:.1} ms", latency.as_secs_f64() * 1e3);
        let [p50, p99] = [rates.latency_p50, rates.latency_p99].map(milliseconds);
        let all_rejected = counters.bad() + counters.late;
        // First, so that a narrow terminal does not cut it off.
        let rejection = match rejected {
            Some(reason) => format!("{all_rejected} rejected: {reason}"),
            None if all_rejected > 0 => format!("{all_rejected} rejected"),
            None => String::new(),
        };
        let parts = [
            (0, rejection),
            (0, format!("{:.1} predictions/s", rates.rate)),
            (1, format!("latency p50 {p50}, p99 {p99}")),
            (2, counted(streams as u64, "stream")),
            (0, format!("{} lost", counters.frames_lost())),
        ];
        terminal::show_status(&terminal::fit(&parts, " | ", terminal::columns()));
    }
}

/// Carries out what the keys say until the node has ended.
fn answer_keys(mut keyboard: Keyboard, handle: &NodeHandle, ended: &AtomicBool) {
    while !ended.load(Ordering::Relaxed) {
        if keyboard.keys().contains(&b'r') {
            match handle.request(NodeRequest::Reset, KEY_TIMEOUT) {
                Ok(NodeResponse::Reset(streams)) => {
                    println!("reset {}", counted(streams as u64, "stream"));
                }
                Ok(_) => {}
                Err(error) => println!("not reset: {error}"),
            }
        }
        thread::sleep(KEY_INTERVAL);
    }
}

/// Serves status, diagnostics and point clouds to Foxglove, under the names of the first output.
#[cfg(feature = "foxglove")]
fn foxglove(
    address: Option<FoxgloveAddress>,
    origins: &[String],
    links: &NodeLinks,
    ros: &RosNode,
    outputs: &mut Vec<Outputs>,
) -> anyhow::Result<Option<FoxgloveServer>> {
    let (Some(address), Some(output)) = (address, links.outputs.first()) else { return Ok(None) };
    let server = FoxgloveServer::start(address, &ros.full_name(), origins)?;
    let publish = |link: &Link, type_name| server.publisher(&link.topic, type_name);
    let cloud = |link| {
        publish(&ros.subtopic(link, "cloud"), PointCloud2::TYPE).map(CloudTopic::new).map(Some)
    };
    let status = publish(&ros.subtopic(output, "status"), PredictionStatus::TYPE)?;
    let diagnostics = ros.link(&output.with_topic("/diagnostics"));
    outputs.push(Outputs {
        diagnostics: Some(publish(&diagnostics, DiagnosticArray::TYPE)?),
        prediction_cloud: cloud(output)?,
        input_cloud: cloud(&links.input)?,
        ..Outputs::status_only(status)
    });
    Ok(Some(server))
}

/// The counters in one line, without zeros, and why the last rejected frame was rejected.
pub(super) fn summary(node: &SurrogateNode) -> String {
    let counted: Vec<_> = node
        .counters()
        .named()
        .into_iter()
        .filter(|&(name, count)| count > 0 || matches!(name, "received" | "published"))
        .map(|(name, count)| format!("{count} {}", name.replace('_', " ")))
        .collect();
    let counted = counted.join(", ");
    match node.rejections().last() {
        Some(reason) => format!("{counted}; last rejected: {reason}"),
        None => counted,
    }
}
