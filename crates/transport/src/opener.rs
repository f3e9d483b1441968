//! Opens publishers and subscribers by their links; one session for each middleware.

use std::{
    num::NonZeroUsize,
    ops::RangeInclusive,
    path::PathBuf,
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use super::{
    Handler, Link, Publisher, Reliability, SeenTopic, Served, Subscriber, TransportError,
    TransportKind, memory::Broker, middleware::Middleware,
};
use eddy_messages::{Message, ParticleFrame, TypeSupport, type_support};

/// Largest domain that ROS 2 allows (docs.ros.org, "About ROS 2 domain IDs").
const MAX_DOMAIN: u16 = 232;

/// How this process appears to others, and how long it waits for them.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TransportOptions {
    /// Name of this process in the ROS graph: letters, digits and `_`.
    pub node_name: String,
    /// Its namespace there [default: `/`], such as `/robot1`.
    pub namespace: String,
    /// ROS domain, 0 to 232 [default: 0, `ROS_DOMAIN_ID`]. Topics of other domains are not seen on Zenoh and DDS.
    pub domain_id: u16,
    /// How long a blocking publisher waits for a subscriber that takes nothing [default: 30 s].
    pub patience: Duration,
    /// How zenoh finds its peers.
    pub zenoh: ZenohOptions,
    /// How DDS finds its peers.
    pub dds: DdsOptions,
}

/// How DDS finds its peers.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct DdsOptions {
    /// How far away they may be [default: this machine, `ROS_AUTOMATIC_DISCOVERY_RANGE`].
    pub range: DiscoveryRange,
}

/// How far away peers may be that nobody named
/// (docs.ros.org, "Improved dynamic discovery").
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum DiscoveryRange {
    /// On this machine (`LOCALHOST`).
    #[default]
    Localhost,
    /// On the networks that this machine is part of (`SUBNET`).
    Subnet,
    /// Nowhere (`OFF`): DDS links are refused, as static peers cannot be named here.
    Off,
}

/// How zenoh finds its peers.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ZenohOptions {
    /// A zenoh configuration that replaces all of eddy's defaults (`ZENOH_SESSION_CONFIG_URI`).
    pub config_file: Option<PathBuf>,
    /// Single settings that go last, `key=value;key=value` with values in JSON5
    /// (`ZENOH_CONFIG_OVERRIDE`), as rmw_zenoh reads them.
    pub overrides: String,
    /// The router's endpoint [default: `tcp/localhost:7447`]; it need not be there.
    pub router: String,
    /// Loopback ports on which eddy processes find each other without a router
    /// [default: 7448..=7463].
    pub ports: RangeInclusive<u16>,
}

impl Default for ZenohOptions {
    fn default() -> Self {
        Self {
            config_file: None,
            overrides: String::new(),
            router: "tcp/localhost:7447".to_owned(),
            ports: 7448..=7463,
        }
    }
}

impl TransportOptions {
    /// Defaults, whatever the environment says.
    pub fn new(node_name: &str) -> Self {
        Self {
            node_name: node_name.to_owned(),
            namespace: "/".to_owned(),
            domain_id: 0,
            patience: Duration::from_secs(30),
            zenoh: ZenohOptions::default(),
            dds: DdsOptions::default(),
        }
    }

    /// Defaults, with what `ROS_DOMAIN_ID`, `ROS_AUTOMATIC_DISCOVERY_RANGE`,
    /// `ZENOH_SESSION_CONFIG_URI` and `ZENOH_CONFIG_OVERRIDE` say.
    ///
    /// # Errors
    /// [`TransportError::Environment`] when one of the first two makes no sense. The zenoh variables are
    /// read when the first zenoh link is opened.
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
        // An empty variable counts as unset, as in ROS 2.
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

/// Opens links. Clones share their sessions and the topics within the process.
#[derive(Clone)]
pub struct Transports {
    shared: Arc<Shared>,
}

struct Shared {
    options: TransportOptions,
    /// What is open, by the number of its [`TransportKind`].
    open: [Mutex<Option<Arc<dyn Middleware>>>; TransportKind::ALL.len()],
}

impl Transports {
    /// Opens nothing yet: a middleware starts with the first link that needs it.
    pub fn new(options: TransportOptions) -> Self {
        Self { shared: Arc::new(Shared { options, open: Default::default() }) }
    }

    /// A publisher of messages of type `type_name`, such as `eddy_msgs/msg/ParticleFrame`.
    ///
    /// # Errors
    /// [`TransportError`] when the type is unknown, the topic carries another one, or the
    /// middleware cannot be opened.
    pub fn publisher(
        &self,
        link: &Link,
        type_name: &str,
        reliability: Reliability,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        self.publisher_of(link, type_support(type_name)?, reliability)
    }

    /// A publisher of messages of any type, given as CDR bytes unless they are frames.
    ///
    /// # Errors
    /// As [`Transports::publisher`].
    pub fn publisher_of(
        &self,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        self.keeping_publisher_of(link, support, reliability, None)
    }

    /// A publisher that on Zenoh keeps its last `kept` messages for subscribers that come later, as ROS 2
    /// has it for topics such as `/tf_static` (transient local). Elsewhere these get what comes after them.
    ///
    /// # Errors
    /// As [`Transports::publisher`].
    pub fn keeping_publisher_of(
        &self,
        link: &Link,
        support: &TypeSupport,
        reliability: Reliability,
        kept: Option<NonZeroUsize>,
    ) -> Result<Box<dyn Publisher>, TransportError> {
        self.middleware(link)?.publisher(link, support, reliability, kept)
    }

    /// A subscriber to messages of type `type_name`. It keeps the messages it is behind in a
    /// bounded queue; a full one holds blocking publishers back and is passed over by the others.
    /// On Zenoh it also gets what publishers have kept for it.
    ///
    /// # Errors
    /// As [`Transports::publisher`].
    pub fn subscriber(
        &self,
        link: &Link,
        type_name: &str,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        self.subscriber_of(link, type_support(type_name)?)
    }

    /// A subscriber to messages of any type, which come as CDR bytes unless they are frames.
    ///
    /// # Errors
    /// As [`Transports::publisher`].
    pub fn subscriber_of(
        &self,
        link: &Link,
        support: &TypeSupport,
    ) -> Result<Box<dyn Subscriber>, TransportError> {
        self.middleware(link)?.subscriber(link, support)
    }

    /// Offers a service of type `type_name`, such as `std_srvs/srv/Trigger`, whose requests `handler`
    /// answers on a thread of its own. `None` on a transport without services: Zenoh and DDS have them.
    ///
    /// # Errors
    /// [`TransportError`] when the middleware refuses, or the type is unknown where its hash is needed.
    pub fn serve(
        &self,
        link: &Link,
        type_name: &str,
        handler: Handler,
    ) -> Result<Option<Box<dyn Served>>, TransportError> {
        self.middleware(link)?.service(link, type_name, handler)
    }

    /// The topics that are published on a transport now (on DDS also those that are read), as far as it
    /// knows, in order. Within the process nobody lists them.
    ///
    /// # Errors
    /// [`TransportError`] when the middleware cannot be opened or asked.
    pub fn topics(&self, transport: TransportKind) -> Result<Vec<SeenTopic>, TransportError> {
        // Errors need a link to name.
        let link = Link { transport, topic: "/".to_owned() };
        let mut topics = self.middleware(&link)?.topics(&link)?;
        topics.sort();
        topics.dedup();
        Ok(topics)
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

    /// The middleware of a link, opened if it is not.
    pub(super) fn middleware(&self, link: &Link) -> Result<Arc<dyn Middleware>, TransportError> {
        let slot = &self.shared.open[link.transport as usize];
        let mut slot = slot.lock().unwrap_or_else(PoisonError::into_inner);
        let opened = match slot.take() {
            Some(opened) => opened,
            None => open(link, &self.shared.options)?,
        };
        Ok(Arc::clone(slot.insert(opened)))
    }
}

/// Opens the middleware of a link.
fn open(link: &Link, options: &TransportOptions) -> Result<Arc<dyn Middleware>, TransportError> {
    Ok(match link.transport {
        TransportKind::Memory => Arc::new(Broker::new(options.patience)),
        #[cfg(feature = "shm")]
        TransportKind::Shm => Arc::new(super::shm::ShmNode::open(link, options)?),
        #[cfg(feature = "zenoh")]
        TransportKind::Zenoh => Arc::new(super::zenoh::ZenohNode::open(link, options)?),
        #[cfg(feature = "dds")]
        TransportKind::Dds => Arc::new(super::dds::DdsNode::open(link, options)?),
        #[cfg(not(all(feature = "shm", feature = "zenoh", feature = "dds")))]
        _ => return Err(TransportError::NotBuilt { link: link.clone() }),
    })
}

/// Frames can be sent only on topics of frames.
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
    fn the_environment_of_rmw_zenoh_counts() {
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
    fn the_discovery_range_is_this_machine_unless_told_otherwise() {
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
    fn the_port_of_a_router_is_never_ours() {
        assert!(!ZenohOptions::default().ports.contains(&7447));
    }

    #[test]
    fn a_bad_domain_names_variable_found_and_expected() {
        for found in ["-1", "233", "one", "70000"] {
            let message = options(&[("ROS_DOMAIN_ID", found)]).unwrap_err().to_string();
            assert_eq!(
                message,
                format!("ROS_DOMAIN_ID: found `{found}`, expected a whole number from 0 to 232")
            );
        }
    }
}
