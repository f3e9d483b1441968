//! `eddy node`: predicts the frames of live streams.

use std::{path::PathBuf, sync::Arc};

use anyhow::{Context, bail};
use serde::Deserialize;

use super::{
    Interrupt, leaves_the_process,
    page::{Desk, Page},
    surrogate, transport_options,
};
use crate::cli::NodeArgs;
use eddy_messages::{
    Clock, DiagnosticArray, Message, ParameterEvent, ParticleFrame, PointCloud2, PredictionStatus,
};
use eddy_node::{
    CloudTopic, Control, Counters, FrameQueue, InvalidSettings, NodeSettings, Outputs, Presence,
    RosTime, Service, SurrogateNode, drive, ros::RosNode, services, viewer::Program,
};
use eddy_settings as config;
#[cfg(feature = "foxglove")]
use eddy_transport::{FoxgloveAddress, FoxgloveServer};
use eddy_transport::{Link, Reliability, Served, TransportError, TransportKind, Transports};

/// What a configuration file of `eddy node` may say; the command line goes first.
#[derive(Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct NodeFile {
    /// Directory of the checkpoint; the shipped particle model if not given.
    checkpoint: Option<PathBuf>,
    /// Link that frames come from, `zenoh:/particles` if not given.
    input: Option<Link>,
    /// Links that predictions go to, `zenoh:/prediction` if not given.
    output: Vec<Link>,
    /// What happens when a subscriber cannot keep up, `drop` if not given.
    reliability: Option<Reliability>,
    /// The behaviour towards streams.
    node: NodeSettings,
}

/// Runs the node until a signal comes.
pub fn run(
    args: NodeArgs,
    ros: &RosNode,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let file: NodeFile = match &args.config {
        Some(path) => config::load(path)?,
        None => NodeFile::default(),
    };
    let mut settings = NodeSettings {
        horizon: args.horizon.unwrap_or(file.node.horizon),
        publish: args.publish.unwrap_or(file.node.publish),
        free_run: args.free_run.or(file.node.free_run),
        cloud: args.cloud || file.node.cloud,
        ..file.node
    };
    set_parameters(&mut settings, ros)?;
    let links = Links::named(
        args.input.or(file.input),
        [args.output, file.output].into_iter().find(|links| !links.is_empty()),
    );
    let renamed = links.renamed(ros);
    renamed.check()?;
    let reliability = args.reliability.or(file.reliability).unwrap_or(Reliability::Drop);

    let checkpoint = args.checkpoint.or(file.checkpoint);
    let surrogate = surrogate::load(checkpoint.as_deref(), args.threads)?;
    let queue = FrameQueue::new(settings.queue, reliability);
    let mut node = SurrogateNode::new(surrogate, settings)?;

    let transports = Transports::new(transport_options(ros)?);
    let input = &renamed.input;
    let mut subscriber = transports
        .subscriber(input, ParticleFrame::TYPE)
        .with_context(|| format!("cannot subscribe to {input}"))?;
    let mut outputs = open(&transports, &links, ros, reliability, node.settings().cloud)
        .context("cannot publish")?;
    #[cfg(feature = "foxglove")]
    let foxglove = foxglove(args.foxglove, &links, ros, &mut outputs).context("--foxglove")?;
    let mut presence = presence(&transports, input, ros);
    let control = Arc::new(Control::default());
    let _services = serve(&transports, &renamed, ros, &control).context("cannot offer services")?;

    // It ends before the outputs, whose onlooker then speaks to a hub that nobody reads.
    let page = args.view.map(|address| {
        let program = Program {
            command: "node",
            title: format!("{} on {input}", ros.full_name()),
            model: Some(node.surrogate().digest().to_owned()),
        };
        let desk = Desk::of_node(Arc::clone(&control));
        Page::serve(address, node.surrogate().description(), program, desk)
    });
    let page = page.transpose().context("--view")?;
    if let (Some(page), Some(first)) = (&page, outputs.first_mut()) {
        first.onlookers.push(page.onlooker());
    }

    if !quiet {
        let digest = &node.surrogate().digest()[..12];
        let names: Vec<_> = renamed.outputs.iter().map(ToString::to_string).collect();
        println!("predicting {input} -> {} with model {digest}", names.join(", "));
        for link in &renamed.outputs {
            if let Some(memory) = transports.shared_memory(link, ParticleFrame::TYPE)? {
                println!("{link} takes {memory}, more for frames of more than 2,560 particles");
            }
        }
    }
    #[cfg(feature = "foxglove")]
    if let Some(server) = &foxglove {
        let beyond = !server.address().ip().is_loopback();
        let whom = if beyond { " (whoever reaches this address can watch)" } else { "" };
        println!("foxglove: ws://{}{whom}", server.address());
    }
    if let Some(page) = &page {
        page.announce();
    }
    let outcome = drive(
        &mut node,
        &mut presence,
        subscriber.as_mut(),
        &mut outputs,
        &queue,
        &control,
        interrupt.flag(),
    );
    if !quiet {
        println!("{}", summary(node.counters()));
    }
    Ok(outcome?)
}

/// Parameters of `--ros-args` go last. What a file says to nodes of any name need not be for us.
fn set_parameters(settings: &mut NodeSettings, ros: &RosNode) -> anyhow::Result<()> {
    for given in ros.parameters() {
        match settings.set(&given.parameter) {
            Ok(()) => {}
            Err(InvalidSettings::Unknown { found }) if given.for_all => {
                tracing::debug!("{}: {found} is no parameter of this node", given.argument);
            }
            Err(error) => return Err(error).context(given.argument.clone()),
        }
    }
    Ok(())
}

/// Where frames come from and predictions go.
struct Links {
    input: Link,
    outputs: Vec<Link>,
}

impl Links {
    /// The links that were named. Those that were not have relative topics, which are in the namespace of the
    /// node.
    fn named(input: Option<Link>, outputs: Option<Vec<Link>>) -> Self {
        Self {
            input: input.unwrap_or(Link::zenoh("particles")),
            outputs: outputs.unwrap_or(vec![Link::zenoh("prediction")]),
        }
    }

    fn renamed(&self, ros: &RosNode) -> Self {
        let outputs = self.outputs.iter().map(|link| ros.link(link));
        Self { input: ros.link(&self.input), outputs: outputs.collect() }
    }

    fn check(&self) -> anyhow::Result<()> {
        self.outputs.iter().chain([&self.input]).try_for_each(leaves_the_process)?;
        for (index, link) in self.outputs.iter().enumerate() {
            if self.outputs[..index].contains(link) {
                bail!("output: found {link} twice, expected once");
            }
            if *link == self.input {
                bail!("output: found {link}, which is the input, expected another topic");
            }
        }
        Ok(())
    }
}

/// Opens the outputs. What says something about the whole node is once on a transport.
fn open(
    transports: &Transports,
    links: &Links,
    ros: &RosNode,
    reliability: Reliability,
    clouds: bool,
) -> Result<Vec<Outputs>, TransportError> {
    let mut opened = Vec::new();
    for (index, link) in links.outputs.iter().enumerate() {
        let prediction = transports.publisher(&ros.link(link), ParticleFrame::TYPE, reliability)?;
        let status = ros.beside(link, "status");
        let status = transports.publisher(&status, PredictionStatus::TYPE, reliability)?;
        let mut outputs = Outputs::new(prediction, status);
        let publish = |link: &Link, type_name| {
            transports.publisher(link, type_name, Reliability::Drop).map(Some)
        };
        let cloud = |link: &Link| {
            let publisher = publish(&ros.beside(link, "cloud"), PointCloud2::TYPE);
            publisher.map(|publisher| publisher.map(CloudTopic::new))
        };
        if clouds {
            outputs.prediction_cloud = cloud(link)?;
        }
        if links.outputs[..index].iter().all(|other| other.transport != link.transport) {
            let shared = |topic: &str| ros.link(&link.with_topic(topic));
            outputs.diagnostics = publish(&shared("/diagnostics"), DiagnosticArray::TYPE)?;
            if matches!(link.transport, TransportKind::Zenoh | TransportKind::Dds) {
                let events = shared("/parameter_events");
                outputs.parameter_events = publish(&events, ParameterEvent::TYPE)?;
            }
            if clouds {
                outputs.input_cloud = cloud(&link.with_topic(&links.input.topic))?;
            }
        }
        opened.push(outputs);
    }
    Ok(opened)
}

/// Serves what there is to look at under the names of the first output, if it is wanted.
#[cfg(feature = "foxglove")]
fn foxglove(
    address: Option<FoxgloveAddress>,
    links: &Links,
    ros: &RosNode,
    outputs: &mut Vec<Outputs>,
) -> anyhow::Result<Option<FoxgloveServer>> {
    let (Some(address), Some(output)) = (address, links.outputs.first()) else { return Ok(None) };
    let server = FoxgloveServer::start(address, &ros.full_name())?;
    let publish = |link: &Link, type_name| server.publisher(&link.topic, type_name);
    let cloud = |link| {
        publish(&ros.beside(link, "cloud"), PointCloud2::TYPE).map(CloudTopic::new).map(Some)
    };
    let status = publish(&ros.beside(output, "status"), PredictionStatus::TYPE)?;
    let diagnostics = ros.link(&output.with_topic("/diagnostics"));
    outputs.push(Outputs {
        diagnostics: Some(publish(&diagnostics, DiagnosticArray::TYPE)?),
        prediction_cloud: cloud(output)?,
        input_cloud: cloud(&links.input)?,
        ..Outputs::to_look_at(status)
    });
    Ok(Some(server))
}

/// The node in the graph. Simulated time comes from where the frames come from.
fn presence(transports: &Transports, input: &Link, ros: &RosNode) -> Presence {
    let (transports, clock) = (transports.clone(), ros.link(&input.with_topic("/clock")));
    let open = move || transports.subscriber(&clock, Clock::TYPE);
    Presence { name: ros.full_name(), time: RosTime::new(Box::new(open)) }
}

/// Offers the node's services on every transport of its links that has them.
fn serve(
    transports: &Transports,
    links: &Links,
    ros: &RosNode,
    control: &Arc<Control>,
) -> Result<Vec<Box<dyn Served>>, TransportError> {
    let links: Vec<_> = [&links.input].into_iter().chain(&links.outputs).collect();
    let mut served = Vec::new();
    for (index, link) in links.iter().enumerate() {
        if links[..index].iter().any(|other| other.transport == link.transport) {
            continue;
        }
        for Service { name, type_name, handler } in services(&ros.full_name(), control) {
            let link = link.with_topic(&ros.service(&name));
            served.extend(transports.serve(&link, type_name, handler)?);
        }
    }
    Ok(served)
}

/// What was used and what was not, in one line; zeros are left out.
pub(super) fn summary(counters: &Counters) -> String {
    let counted: Vec<_> = counters
        .named()
        .into_iter()
        .filter(|&(name, count)| count > 0 || matches!(name, "received" | "published"))
        .map(|(name, count)| format!("{count} {}", name.replace('_', " ")))
        .collect();
    counted.join(", ")
}
