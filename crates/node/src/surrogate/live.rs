//! A node with its topics and services open.

use std::{
    sync::{Arc, atomic::AtomicBool},
    time::Duration,
};

use eddy_messages::{Clock, Message, ParticleFrame, QosProfile};
use eddy_transport::{Link, Reliability, Served, Subscriber, TransportError, Transports};
use xxhash_rust::xxh3::xxh3_64;

use super::{
    DriveError, FrameQueue, GroupMember, NodeContext, NodeHandle, NodeLinks, NodeSettings, Outputs,
    RosTime, SurrogateNode, drive, lifecycle_services, node_services, publishers::Publishers,
};
use crate::{
    ros::{RosNode, TopicQos},
    service::Service,
};

/// Why the topics of a node cannot be opened.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum OpenError {
    /// The environment is invalid.
    #[error(transparent)]
    Environment(TransportError),
    /// The input cannot be opened.
    #[error("cannot subscribe to {link}")]
    Input { link: Box<Link>, source: TransportError },
    /// An output cannot be opened.
    #[error("cannot publish")]
    Outputs(#[source] TransportError),
    /// The node cannot take part in its group.
    #[error("cannot take part in the group")]
    Group(#[source] TransportError),
    /// The services cannot be offered.
    #[error("cannot offer services")]
    Services(#[source] TransportError),
}

/// Lease of a member of a group, unless the configuration of zenoh has another: streams of a member that is cut off from
/// the network are predicted elsewhere within a second. Four signs of life each, so that a busy processor does not end it.
const GROUP_LEASE: Duration = Duration::from_millis(800);

/// A node with its topics and services open.
pub struct LiveNode {
    // Dropped first: requests come from other threads.
    _services: Vec<Box<dyn Served>>,
    /// The outputs: others can be added before the node runs, and observers.
    pub outputs: Vec<Outputs>,
    subscriber: Box<dyn Subscriber>,
    context: NodeContext,
    transports: Transports,
    queue: FrameQueue,
    handle: Arc<NodeHandle>,
    stop: Arc<AtomicBool>,
    node: SurrogateNode,
}

impl LiveNode {
    /// Opens input, outputs and services under the names of `ros`; `reliability` is that of topics that `qos` does not name.
    /// The node ends once `stop` is raised.
    ///
    /// # Errors
    /// [`OpenError`].
    pub fn open(
        mut node: SurrogateNode,
        links: &NodeLinks,
        ros: &RosNode,
        reliability: Reliability,
        mut qos: TopicQos,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, OpenError> {
        node.stop_with(Arc::clone(&stop));
        let mut options = ros.transport_options().map_err(OpenError::Environment)?;
        let group = node.settings().group.clone();
        if !group.is_empty() {
            options.zenoh.lease = GROUP_LEASE;
        }
        let transports = Transports::stopped_by(Arc::clone(&stop), options);
        let renamed = links.renamed(ros);
        let input = renamed.input.clone();
        let requested = qos.subscription(&input.topic, QosProfile::default());
        let subscriber =
            transports
                .requesting_subscriber(&input, ParticleFrame::TYPE, requested)
                .map_err(|source| OpenError::Input { link: Box::new(input.clone()), source })?;
        let mut publishers = Publishers { transports: &transports, ros, qos, reliability };
        let is_managed = node.lifecycle().is_some();
        let outputs = publishers
            .open(links, node.settings().cloud, is_managed)
            .map_err(OpenError::Outputs)?;
        for topic in publishers.qos.unused() {
            tracing::warn!("qos_overrides.{topic}: this node has no such topic on this side");
        }
        // After the outputs, so that a member can publish.
        let group = (!group.is_empty()).then(|| {
            transports
                .membership(&input, &group, &label(&node, &renamed))
                .map(|membership| Arc::new(GroupMember::start(&group, membership)))
        });
        let group = group.transpose().map_err(OpenError::Group)?;
        let handle = Arc::default();
        let services = || {
            let mut services = node_services(&ros.full_name(), &handle);
            if is_managed {
                services.extend(lifecycle_services(&ros.full_name(), &handle));
            }
            services
        };
        let services = serve(&transports, &renamed, ros, services).map_err(OpenError::Services)?;
        Ok(Self {
            _services: services,
            outputs,
            subscriber,
            context: NodeContext { group, ..context(&transports, input, ros) },
            transports,
            queue: FrameQueue::new(node.settings().queue, reliability),
            handle,
            stop,
            node,
        })
    }

    /// Runs until the node is stopped, see [`drive`].
    ///
    /// # Errors
    /// As [`drive`].
    pub fn run(&mut self) -> Result<(), DriveError> {
        let Self { node, context, subscriber, outputs, queue, handle, stop, .. } = self;
        drive(node, context, subscriber.as_mut(), outputs, queue, handle, stop)
    }

    /// The node itself.
    pub fn node(&self) -> &SurrogateNode {
        &self.node
    }

    /// For requests while it runs.
    pub fn handle(&self) -> &Arc<NodeHandle> {
        &self.handle
    }

    /// The transports of its links.
    pub fn transports(&self) -> &Transports {
        &self.transports
    }
}

/// The name of the node and its time; `/clock` is on the transport of the input.
fn context(transports: &Transports, input: Link, ros: &RosNode) -> NodeContext {
    let (transports, clock) = (transports.clone(), ros.link(&input.with_topic("/clock")));
    let open = move || transports.subscriber(&clock, Clock::TYPE);
    NodeContext { name: ros.full_name(), input, time: RosTime::new(Box::new(open)), group: None }
}

/// Differs between members of a group that start with different checkpoints, settings or outputs, so that the predictions
/// of a stream change when it is handed over.
fn label(node: &SurrogateNode, links: &NodeLinks) -> String {
    let NodeSettings { horizon, publish, free_run, max_gap, .. } = node.settings();
    let outputs: Vec<_> = links.outputs.iter().map(Link::to_string).collect();
    let digest = node.surrogate().digest();
    let all = format!("{digest} {horizon} {publish:?} {free_run:?} {max_gap} {outputs:?}");
    format!("{:08x}", xxh3_64(all.as_bytes()) >> 32)
}

/// Offers services on every transport of the node's links that has services.
fn serve(
    transports: &Transports,
    links: &NodeLinks,
    ros: &RosNode,
    services: impl Fn() -> Vec<Service>,
) -> Result<Vec<Box<dyn Served>>, TransportError> {
    let mut served = Vec::new();
    for link in links.one_per_transport() {
        for Service { name, type_name, handler } in services() {
            let link = link.with_topic(&ros.service(&name));
            served.extend(transports.serve(&link, type_name, handler)?);
        }
    }
    Ok(served)
}
