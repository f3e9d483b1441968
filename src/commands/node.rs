//! `eddy node`: predicts the frames of live streams.

use std::{path::PathBuf, sync::Arc};

use anyhow::Context;
use serde::Deserialize;

use super::{Interrupt, leaves_the_process, surrogate};
use crate::cli::NodeArgs;
use eddy::{
    config,
    msg::{DiagnosticArray, Message, ParticleFrame, PredictionStatus},
    node::{
        Control, Counters, FrameQueue, NodeSettings, Outputs, Service, SurrogateNode, drive,
        services,
    },
    transport::{Link, Reliability, Served, TransportError, TransportOptions, Transports},
};

/// The node's name in the ROS 2 graph.
const NAME: &str = "eddy_node";

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
pub fn run(args: NodeArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let file: NodeFile = match &args.config {
        Some(path) => config::load(path)?,
        None => NodeFile::default(),
    };
    let settings = NodeSettings {
        horizon: args.horizon.unwrap_or(file.node.horizon),
        publish: args.publish.unwrap_or(file.node.publish),
        free_run: args.free_run.or(file.node.free_run),
        ..file.node
    };
    let input = args.input.or(file.input).unwrap_or(Link::zenoh("/particles"));
    let outputs = [args.output, file.output, vec![Link::zenoh("/prediction")]];
    let outputs = outputs.into_iter().find(|links| !links.is_empty()).unwrap_or_default();
    outputs.iter().chain([&input]).try_for_each(leaves_the_process)?;
    let reliability = args.reliability.or(file.reliability).unwrap_or(Reliability::Drop);

    let checkpoint = args.checkpoint.or(file.checkpoint);
    let surrogate = surrogate::load(checkpoint.as_deref(), args.threads)?;
    let queue = FrameQueue::new(settings.queue, reliability);
    let mut node = SurrogateNode::new(surrogate, settings)?;

    let transports = Transports::new(TransportOptions::from_env(NAME)?);
    let mut subscriber = transports
        .subscriber(&input, ParticleFrame::TYPE)
        .with_context(|| format!("cannot subscribe to {input}"))?;
    let mut publishers = Vec::new();
    for (index, link) in outputs.iter().enumerate() {
        anyhow::ensure!(
            !outputs[..index].contains(link),
            "output: found {link} twice, expected once"
        );
        // One `/diagnostics` is enough for a transport.
        let first = outputs[..index].iter().all(|other| other.transport != link.transport);
        publishers.push(open(&transports, link, reliability, first).context("cannot publish")?);
    }

    let control = Arc::new(Control::default());
    let _services =
        serve(&transports, &input, &outputs, &control).context("cannot offer services")?;

    if !quiet {
        let digest = &node.surrogate().digest()[..12];
        let outputs: Vec<_> = outputs.iter().map(ToString::to_string).collect();
        println!("predicting {input} -> {} with model {digest}", outputs.join(", "));
    }
    let input = subscriber.as_mut();
    let outcome =
        drive(&mut node, NAME, input, &mut publishers, &queue, &control, interrupt.flag());
    if !quiet {
        println!("{}", summary(node.counters()));
    }
    Ok(outcome?)
}

fn open(
    transports: &Transports,
    link: &Link,
    reliability: Reliability,
    with_diagnostics: bool,
) -> Result<Outputs, TransportError> {
    let diagnostics = link.with_topic("/diagnostics");
    let diagnostics = with_diagnostics
        .then(|| transports.publisher(&diagnostics, DiagnosticArray::TYPE, Reliability::Drop));
    let status = link.with_topic(&format!("{}/status", link.topic));
    Ok(Outputs {
        prediction: transports.publisher(link, ParticleFrame::TYPE, reliability)?,
        status: transports.publisher(&status, PredictionStatus::TYPE, reliability)?,
        diagnostics: diagnostics.transpose()?,
    })
}

/// Offers the node's services on every transport of its links that has them.
fn serve(
    transports: &Transports,
    input: &Link,
    outputs: &[Link],
    control: &Arc<Control>,
) -> Result<Vec<Box<dyn Served>>, TransportError> {
    let links: Vec<_> = [input].into_iter().chain(outputs).collect();
    let mut served = Vec::new();
    for (index, link) in links.iter().enumerate() {
        if links[..index].iter().any(|other| other.transport == link.transport) {
            continue;
        }
        for Service { name, type_name, handler } in services(NAME, control) {
            served.extend(transports.serve(&link.with_topic(&name), type_name, handler)?);
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
