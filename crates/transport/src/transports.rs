//! Opens publishers and subscribers by link, with one session per middleware.

use std::{
    ops::RangeInclusive,
    path::PathBuf,
    sync::{Arc, Mutex, atomic::AtomicBool},
    time::Duration,
};

use super::{
    Handler, Link, Membership, Publisher, Reliability, SeenService, SeenTopic, Served, Subscriber,
    TransportError, TransportKind,
    descriptors::{self, Cost},
    lock,
    memory::Broker,
    middleware::Middleware,
    patience::Patience,
};
use eddy_messages::{
    Message, ParticleFrame, QosProfile, TypeSupport, cdr,
    type_descriptions::{TypeDescriptionRequest, TypeDescriptionResponse},
    type_support,
};

/// Largest domain that ROS 2 allows (docs.ros.org, "About ROS 2 domain IDs").
const MAX_DOMAIN: u16 = 232;

/// What a publisher does, and what it offers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct PublisherOptions {
    /// What it does when a subscriber cannot keep up.
    pub reliability: Reliability,
    /// The quality of service that it offers on Zenoh and DDS [default: [`default_qos`](crate::default_qos)]. If that is transient local,
    /// as in ROS 2 for topics such as `/tf_static`, it keeps its last messages for late-joining subscribers. Other transports have no
    /// quality of service.
    pub qos: Option<QosProfile>,
}

impl From<Reliability> for PublisherOptions {
    fn from(reliability: Reliability) -> Self {
        Self { reliability, qos: None }
    }
}

/// The type of the messages of a topic: a name that is built in, or a definition.
pub trait TopicType {
    /// Its definition.
    ///
    /// # Errors
    /// [`TransportError::Type`] if the name is not built in.
    fn support(&self) -> Result<&TypeSupport, TransportError>;
}

impl TopicType for str {
    fn support(&self) -> Result<&TypeSupport, TransportError> {
        Ok(type_support(self)?)
    }
}

impl TopicType for TypeSupport {
    fn support(&self) -> Result<&TypeSupport, TransportError> {
        Ok(self)
    }
}

/// Options of all transports.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TransportOptions {
    /// Name of the node in the ROS graph: letters, digits and `_`.
    pub node_name: String,
    /// Namespace of the node, such as `/robot1` [default: `/`].
    pub namespace: String,
    /// Security enclave of the node, which Zenoh announces [default: `/`, none].
    pub enclave: String,
    /// ROS domain id, 0 to 232 [default: 0, `ROS_DOMAIN_ID`]. Topics of other domains are not seen.
    pub domain_id: u16,
    /// How long a blocking publisher waits for a subscriber that does not read [default: 30 s].
    pub patience: Duration,
    /// Options of Zenoh.
    pub zenoh: ZenohOptions,
    /// Options of DDS.
    pub dds: DdsOptions,
}

/// Options of DDS.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DdsOptions {
    /// Discovery range [default: this machine, `ROS_AUTOMATIC_DISCOVERY_RANGE`].
    pub range: DiscoveryRange,
}

/// Range of automatic discovery (docs.ros.org, "Improved dynamic discovery").
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DiscoveryRange {
    /// This machine (`LOCALHOST`).
    #[default]
    Localhost,
    /// The local networks (`SUBNET`).
    Subnet,
    /// None (`OFF`): DDS links are rejected, since static peers are not supported.
    Off,
}

/// Options of Zenoh.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ZenohOptions {
    /// A Zenoh configuration file that replaces all defaults (`ZENOH_SESSION_CONFIG_URI`).
    pub config_file: Option<PathBuf>,
    /// Settings that override all others, `key=value;key=value` with values in JSON5, as in rmw_zenoh
    /// (`ZENOH_CONFIG_OVERRIDE`).
    pub overrides: String,
    /// Endpoint of an optional router [default: `tcp/localhost:7447`].
    pub router: String,
    /// How long others wait for a sign of life of this process before they consider it dead (`transport/link/tx/lease`)
    /// [default: 60 s]. The end of a process is noticed at once.
    pub lease: Duration,
    /// Loopback ports on which eddy processes find each other without a router [default: 7448..=7463].
    pub ports: RangeInclusive<u16>,
}

impl Default for ZenohOptions {
    fn default() -> Self {
        Self {
            config_file: None,
            overrides: String::new(),
            router: "tcp/localhost:7447".to_owned(),
            lease: Duration::from_secs(60),
            ports: 7448..=7463,
        }
    }
}

impl TransportOptions {
    /// The defaults, without the environment.
    pub fn new(node_name: &str) -> Self {
        Self {
            node_name: node_name.to_owned(),
            namespace: "/".to_owned(),
            enclave: "/".to_owned(),
            domain_id: 0,
            patience: Duration::from_secs(30),
            zenoh: ZenohOptions::default(),
            dds: DdsOptions::default(),
        }
    }

    /// The defaults with the values of `ROS_DOMAIN_ID`, `ROS_AUTOMATIC_DISCOVERY_RANGE`, `ZENOH_SESSION_CONFIG_URI`
    /// and `ZENOH_CONFIG_OVERRIDE`.
    ///
    /// # Errors
    /// [`TransportError::Environment`] when one of the first two is invalid. The values of the Zenoh variables are
    /// checked when the first Zenoh link is opened.
    #[expect(clippy::disallowed_methods, reason = "the one place that reads the environment")]
    pub fn from_env(node_name: &str) -> Result<Self, TransportError> {
        Self::from_variables(node_name, |name| {
            std::env::var_os(name).map(|value| value.to_string_lossy().into_owned())
        })
    }

    fn from_variables(
        node_name: &str,
        variable: impl Fn(&'static str) -> Option<String>,
    ) -> Result<Self, TransportError> {
        // As in ROS 2, an empty variable is the same as an unset one.
        let variable = |name| variable(name).filter(|value| !value.is_empty());
        let mut options = Self::new(node_name);
        if let Some(found) = variable("ROS_DOMAIN_ID") {
            let domain = found.parse().ok().filter(|&domain| domain <= MAX_DOMAIN);
            options.domain_id = domain.ok_or_else(|| TransportError::Environment {
                variable: "ROS_DOMAIN_ID",
                found,
                expected: format!("a whole number from 0 to {MAX_DOMAIN}"),
            })?;
        }
        options.dds.range = match variable("ROS_AUTOMATIC_DISCOVERY_RANGE").as_deref() {
            None | Some("LOCALHOST" | "SYSTEM_DEFAULT") => DiscoveryRange::Localhost,
            Some("SUBNET") => DiscoveryRange::Subnet,
            Some("OFF") => DiscoveryRange::Off,
            Some(found) => {
                return Err(TransportError::Environment {
                    variable: "ROS_AUTOMATIC_DISCOVERY_RANGE",
                    found: found.to_owned(),
                    expected: "LOCALHOST, SUBNET, OFF or SYSTEM_DEFAULT".to_owned(),
                });
            }
        };
        options.zenoh.config_file = variable("ZENOH_SESSION_CONFIG_URI").map(PathBuf::from);
        options.zenoh.overrides = variable("ZENOH_CONFIG_OVERRIDE").unwrap_or_default();
        Ok(options)
    }
}

/// Opens publishers, subscribers and services. Clones share sessions and the topics within the process.
#[derive(Clone)]
pub struct Transports {
    shared: Arc<Shared>,
}

struct Shared {
    options: TransportOptions,
    patience: Patience,
    /// The open middlewares, indexed by [`TransportKind`].
    open: [Mutex<Option<Arc<dyn Middleware>>>; TransportKind::ALL.len()],
}

impl Transports {
    /// Opens no middleware; each is opened with its first link.
    pub fn new(options: TransportOptions) -> Self {
        Self::stopped_by(Arc::default(), options)
    }

    /// As [`Transports::new`]; once `stop` is raised, blocking publishers wait for half a second more, all of them
    /// together, and the middlewares are closed without waiting for others.
    pub fn stopped_by(stop: Arc<AtomicBool>, options: TransportOptions) -> Self {
        let patience = Patience::new(options.patience, stop);
        Self { shared: Arc::new(Shared { options, patience, open: Default::default() }) }
    }

    /// Ensures that this process may open the files that further publishers and subscribers of messages of these types need, and raises
    /// its limit where the system permits that. Each is checked again when it is opened; this is for a program that opens many, and is to
    /// fail before it starts.
    ///
    /// # Errors
    /// [`TransportError::Descriptors`] with the numbers.
    pub fn reserve(
        &self,
        transport: TransportKind,
        published: &[&str],
        subscribed: &[&str],
    ) -> Result<(), TransportError> {
        let link = Link { transport, topic: "/".to_owned() };
        self.ensure(&link, published, subscribed)
    }

    fn ensure(
        &self,
        link: &Link,
        published: &[&str],
        subscribed: &[&str],
    ) -> Result<(), TransportError> {
        let Cost { middleware, publisher, subscriber, of_frames } = cost(link.transport);
        let is_open = lock(&self.shared.open[link.transport as usize]).is_some();
        let of = |types: &[&str], port| -> u64 {
            types.iter().map(|name| port + if is_frames(name) { of_frames } else { 0 }).sum()
        };
        let ports = of(published, publisher) + of(subscribed, subscriber);
        let needed = ports + if is_open { 0 } else { middleware };
        if needed == 0 { Ok(()) } else { descriptors::ensure(link, needed) }
    }

    /// A publisher of messages of a type: its name, such as `eddy_msgs/msg/ParticleFrame`, or its definition. Messages other than frames
    /// are CDR bytes.
    ///
    /// # Errors
    /// [`TransportError`] when the type is unknown, the topic has another type, or the middleware cannot be opened.
    pub fn publisher(
        &self,
        link: &Link,
        of: &(impl TopicType + ?Sized),
        options: impl Into<PublisherOptions>,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        let (support, PublisherOptions { reliability, qos }) = (of.support()?, options.into());
        self.ensure(link, &[&support.name], &[])?;
        self.middleware(link)?.publisher(link, support, reliability, qos)
    }

    /// A subscriber to messages of a type, as in [`Transports::publisher`], with a bounded queue. A full queue holds blocking publishers
    /// back; messages of the others are dropped. On Zenoh and DDS it also receives the messages that publishers have kept.
    ///
    /// # Errors
    /// As [`Transports::publisher`].
    pub fn subscriber(
        &self,
        link: &Link,
        of: &(impl TopicType + ?Sized),
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        self.requesting_subscriber(link, of, None)
    }

    /// As [`Transports::subscriber`]; on Zenoh and DDS the subscriber requests this quality of service.
    ///
    /// # Errors
    /// As [`Transports::publisher`].
    pub fn requesting_subscriber(
        &self,
        link: &Link,
        of: &(impl TopicType + ?Sized),
        requested: Option<QosProfile>,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        let support = of.support()?;
        self.ensure(link, &[], &[&support.name])?;
        self.middleware(link)?.subscriber(link, support, requested)
    }

    /// The type of a topic as its publishers define it: Zenoh and DDS ask their nodes
    /// (`~/get_type_description`). `None` if the type hash is not known, or nobody answers within `timeout`.
    ///
    /// # Errors
    /// [`TransportError`] when nobody can be asked, or the answers define another type.
    pub fn described_type(
        &self,
        topic: &SeenTopic,
        timeout: Duration,
    ) -> Result<Option<TypeSupport>, TransportError> {
        let Some(hash) = &topic.hash else { return Ok(None) };
        let request = TypeDescriptionRequest {
            type_name: topic.type_name.clone(),
            type_hash: hash.clone(),
            include_type_sources: true,
        };
        let middleware = self.middleware(&topic.link)?;
        let mut invalid = None;
        for answer in middleware.describe(topic, &cdr::encode(&request), timeout)? {
            match cdr::decode::<TypeDescriptionResponse>(&answer) {
                Ok(response) if response.successful => {
                    match response.into_type(&topic.type_name, hash) {
                        Ok(support) => return Ok(Some(support)),
                        Err(error) => invalid = Some(error),
                    }
                }
                Ok(response) => tracing::debug!("{}: {}", topic.link, response.failure_reason),
                Err(error) => tracing::debug!("{}: {error}", topic.link),
            }
        }
        match invalid {
            Some(error) => Err(TransportError::Definition { link: topic.link.clone(), error }),
            None => Ok(None),
        }
    }

    /// Offers a service of type `type_name`, such as `std_srvs/srv/Trigger`. `handler` answers the requests on a
    /// thread of its own. `None` on transports without services; Zenoh and DDS have them.
    ///
    /// # Errors
    /// [`TransportError`] from the middleware, or when the type is unknown and its hash is needed.
    pub fn serve(
        &self,
        link: &Link,
        type_name: &str,
        handler: Handler,
    ) -> Result<Option<Box<dyn Served>>, TransportError> {
        self.middleware(link)?.service(link, type_name, handler)
    }

    /// The services of other nodes, sorted; none on transports without services.
    ///
    /// # Errors
    /// [`TransportError`] when the middleware cannot be opened or asked.
    pub fn services(&self, transport: TransportKind) -> Result<Vec<SeenService>, TransportError> {
        // For error messages.
        let link = Link { transport, topic: "/".to_owned() };
        let mut services = self.middleware(&link)?.services(&link)?;
        services.sort();
        services.dedup();
        Ok(services)
    }

    /// Sends a request, CDR bytes with their header, to a service. `None` if nobody answers within `timeout`.
    ///
    /// # Errors
    /// [`TransportError`] from the middleware.
    pub fn call(
        &self,
        service: &SeenService,
        request: &[u8],
        timeout: Duration,
    ) -> Result<Option<Vec<u8>>, TransportError> {
        self.middleware(&service.link)?.call(service, request, timeout)
    }

    /// The known topics with a publisher, sorted; in shared memory also those with a subscriber only, which determines the
    /// type as well.
    ///
    /// # Errors
    /// [`TransportError`] when the middleware cannot be opened or asked.
    pub fn topics(&self, transport: TransportKind) -> Result<Vec<SeenTopic>, TransportError> {
        // For error messages.
        let link = Link { transport, topic: "/".to_owned() };
        let mut topics = self.middleware(&link)?.topics(&link)?;
        topics.sort();
        topics.dedup();
        Ok(topics)
    }

    /// Watches the members of a group among the processes that read a topic; this process is not one of them before
    /// [`Membership::join`]. Groups of different topics or domains are different groups. Others see the `label` of this
    /// process at the end of its id. Only Zenoh has groups.
    ///
    /// # Errors
    /// [`TransportError::NoGroups`]; as [`Transports::publisher`].
    pub fn membership(
        &self,
        link: &Link,
        group: &str,
        label: &str,
    ) -> Result<Box<dyn Membership>, TransportError> {
        self.middleware(link)?.membership(link, group, label)
    }

    /// The memory that the publishers of a topic of type `type_name` have made for it; `None` where nothing is
    /// shared.
    ///
    /// # Errors
    /// As [`Transports::publisher`].
    #[cfg(feature = "shm")]
    pub fn shared_memory(
        &self,
        link: &Link,
        type_name: &str,
    ) -> Result<Option<super::SharedMemory>, TransportError> {
        self.middleware(link)?.shared_memory(link, type_name)
    }

    #[cfg(feature = "lab")]
    pub(super) fn options(&self) -> &TransportOptions {
        &self.shared.options
    }

    /// The middleware of a link, opened if necessary.
    pub(super) fn middleware(&self, link: &Link) -> Result<Arc<dyn Middleware>, TransportError> {
        let slot = &self.shared.open[link.transport as usize];
        let mut slot = lock(slot);
        let opened = match slot.take() {
            Some(opened) => opened,
            None => {
                descriptors::ensure(link, cost(link.transport).middleware)?;
                open(link, &self.shared.options, &self.shared.patience)?
            }
        };
        Ok(Arc::clone(slot.insert(opened)))
    }
}

/// The file descriptors that a transport opens.
fn cost(transport: TransportKind) -> Cost {
    match transport {
        TransportKind::Memory => Cost::default(),
        #[cfg(feature = "shm")]
        TransportKind::Shm => super::shm::COST,
        #[cfg(feature = "zenoh")]
        TransportKind::Zenoh => super::zenoh::COST,
        #[cfg(feature = "dds")]
        TransportKind::Dds => super::dds::COST,
        #[cfg(not(all(feature = "shm", feature = "zenoh", feature = "dds")))]
        _ => Cost::default(),
    }
}

/// Opens the middleware of a link.
fn open(
    link: &Link,
    options: &TransportOptions,
    patience: &Patience,
) -> Result<Arc<dyn Middleware>, TransportError> {
    let patience = patience.clone();
    Ok(match link.transport {
        TransportKind::Memory => Arc::new(Broker::new(patience)),
        #[cfg(feature = "shm")]
        TransportKind::Shm => Arc::new(super::shm::ShmNode::open(link, options, patience)?),
        #[cfg(feature = "zenoh")]
        TransportKind::Zenoh => Arc::new(super::zenoh::ZenohNode::open(link, options, patience)?),
        #[cfg(feature = "dds")]
        TransportKind::Dds => Arc::new(super::dds::DdsNode::open(link, options, patience)?),
        #[cfg(not(all(feature = "shm", feature = "zenoh", feature = "dds")))]
        _ => {
            let _ = options;
            return Err(TransportError::NotBuilt { link: link.clone() });
        }
    })
}

/// Rejects frames on topics of other types.
pub(super) fn check_frames(link: &Link, type_name: &str) -> Result<(), TransportError> {
    if is_frames(type_name) {
        return Ok(());
    }
    Err(TransportError::TopicType {
        link: link.clone(),
        found: ParticleFrame::TYPE.to_owned(),
        expected: type_name.to_owned(),
    })
}

/// Whether messages of this type are frames.
pub(super) fn is_frames(type_name: &str) -> bool {
    type_name == ParticleFrame::TYPE
}

#[cfg(test)]
mod tests {
    use super::*;

    fn options(variables: &[(&'static str, &str)]) -> Result<TransportOptions, TransportError> {
        TransportOptions::from_variables("test", |name| {
            variables.iter().find(|(known, _)| *known == name).map(|(_, value)| (*value).to_owned())
        })
    }

    #[test]
    fn an_empty_environment_gives_the_defaults() {
        assert_eq!(options(&[]).unwrap(), TransportOptions::new("test"));
        assert_eq!(options(&[("ROS_DOMAIN_ID", "")]).unwrap().domain_id, 0);
    }

    #[test]
    fn the_environment_variables_of_rmw_zenoh_are_used() {
        let options = options(&[
            ("ROS_DOMAIN_ID", "42"),
            ("ZENOH_SESSION_CONFIG_URI", "/etc/zenoh.json5"),
            ("ZENOH_CONFIG_OVERRIDE", "mode=\"client\""),
        ])
        .unwrap();
        assert_eq!(options.domain_id, 42);
        assert_eq!(options.zenoh.config_file, Some(PathBuf::from("/etc/zenoh.json5")));
        assert_eq!(options.zenoh.overrides, "mode=\"client\"");
    }

    #[test]
    fn the_default_discovery_range_is_this_machine() {
        let range = |found| options(&[("ROS_AUTOMATIC_DISCOVERY_RANGE", found)]);
        for (found, expected) in [
            ("", DiscoveryRange::Localhost),
            ("LOCALHOST", DiscoveryRange::Localhost),
            ("SYSTEM_DEFAULT", DiscoveryRange::Localhost),
            ("SUBNET", DiscoveryRange::Subnet),
            ("OFF", DiscoveryRange::Off),
        ] {
            assert_eq!(range(found).unwrap().dds.range, expected, "{found}");
        }
        let message = range("FAR").unwrap_err().to_string();
        let expected = "found `FAR`, expected LOCALHOST, SUBNET, OFF or SYSTEM_DEFAULT";
        assert_eq!(message, format!("ROS_AUTOMATIC_DISCOVERY_RANGE: {expected}"));
    }

    #[test]
    fn the_port_range_excludes_the_router() {
        assert!(!ZenohOptions::default().ports.contains(&7447));
    }

    #[test]
    fn an_invalid_domain_is_rejected_with_variable_found_and_expected() {
        for found in ["-1", "233", "one", "70000"] {
            let message = options(&[("ROS_DOMAIN_ID", found)]).unwrap_err().to_string();
            assert_eq!(
                message,
                format!("ROS_DOMAIN_ID: found `{found}`, expected a whole number from 0 to 232")
            );
        }
    }
}
