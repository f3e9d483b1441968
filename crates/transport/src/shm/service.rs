//! Opens or creates the services of a topic.

use std::{
    fmt::{self, Debug, Display},
    fs,
    path::Path,
    sync::{Mutex, mpsc},
    thread,
    time::Duration,
};

use iceoryx2::{
    node::{Node, NodeState},
    prelude::*,
    service::{
        builder::publish_subscribe::{PublishSubscribeCreateError, PublishSubscribeOpenError},
        port_factory::{event, publish_subscribe},
        service_hash::ServiceHash,
        static_config::{
            StaticConfig,
            message_type_details::{TypeDetail, TypeVariant},
            messaging_pattern,
        },
    },
};

pub(super) use super::failure::error as middleware;
use super::{
    layout::{FrameHeader, SharedParticle},
    names,
};
use crate::{Link, SeenTopic, TransportError, TransportOptions, lock};
use eddy_messages::{Message, ParticleFrame, topic_type};

/// The iceoryx2 variant whose ports may move between threads.
pub(super) type Ipc = ipc_threadsafe::Service;
/// Opens the ports of a topic.
pub(super) type Topic<P, H> = publish_subscribe::PortFactory<Ipc, [P], H>;
/// The same for frames of three dimensions.
pub(super) type Topic3 = Topic<SharedParticle<3>, FrameHeader<3>>;
/// Opens the ports of a topic's events.
pub(super) type Events = event::PortFactory<Ipc>;

/// Buffer length of a subscriber (messages). A publisher reserves and zeroes memory for the buffers and borrowed samples
/// of all possible subscribers: 16 MB for frames of 2,560 particles (once it publishes frames of three dimensions, 23 MB for those), 0.8 MB
/// for short messages, so that some topics fit into the usual 64 MB of a container.
pub(super) const DEPTH: usize = 32;
/// Samples that a subscriber may borrow.
pub(super) const BORROWED: usize = 8;
/// Largest number of subscribers of a topic, and of publishers.
const PORTS: usize = 8;
/// Largest number of processes per topic.
const PROCESSES: usize = 32;
/// Interval at which resources of killed processes are removed.
const CLEANING: Duration = Duration::from_millis(500);
/// Attempts to open a service while another process creates or removes it.
const ATTEMPTS: u32 = 50;
/// After so many of them, nobody creates or removes it, and what is left was abandoned: iceoryx2 waits about a second in each for a
/// state that is missing.
const PATIENT_ATTEMPTS: u32 = 2;
/// The attribute that names a service's message type.
const TYPE_ATTRIBUTE: &str = "type";

/// Opens services and removes the resources of killed processes.
pub(super) struct Services {
    // A mutex only for thread safety: opening is rare.
    node: Mutex<Node<Ipc>>,
    domain_id: u16,
    cleaner: Cleaner,
}

/// Keeps the cleaner thread running until the last clone is dropped.
pub(super) type Cleaner = mpsc::Sender<()>;

impl Services {
    pub(super) fn open(link: &Link, options: &TransportOptions) -> Result<Self, TransportError> {
        let failed = |error: &dyn Display| middleware(link, "open shared memory", error);
        let name = &options.node_name;
        let name = NodeName::new(name).map_err(|_| TransportError::LongName {
            link: link.clone(),
            found: name.len(),
            limit: NodeName::max_len(),
        })?;
        let node = NodeBuilder::new()
            .name(&name)
            // The program handles signals.
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|error| failed(&error))?;
        let cleaner = spawn_cleaner(node.config().clone()).map_err(|error| failed(&error))?;
        Ok(Self { node: Mutex::new(node), domain_id: options.domain_id, cleaner })
    }

    /// For ports, which may outlive these services.
    pub(super) fn cleaner(&self) -> Cleaner {
        self.cleaner.clone()
    }

    /// The service that carries the messages of a topic.
    pub(super) fn topic<P, H>(
        &self,
        link: &Link,
        type_name: &str,
    ) -> Result<Topic<P, H>, TransportError>
    where
        P: Debug + ZeroCopySend,
        H: Debug + ZeroCopySend,
    {
        self.named(link, &names::service(self.domain_id, link)?, type_name)
    }

    /// The one that carries its frames of three dimensions.
    pub(super) fn space(&self, link: &Link) -> Result<Topic3, TransportError> {
        self.named(link, &names::service_in_space(self.domain_id, link)?, ParticleFrame::TYPE)
    }

    fn named<P, H>(
        &self,
        link: &Link,
        name: &ServiceName,
        type_name: &str,
    ) -> Result<Topic<P, H>, TransportError>
    where
        P: Debug + ZeroCopySend,
        H: Debug + ZeroCopySend,
    {
        let node = lock(&self.node);
        let builder = || node.service_builder(name).publish_subscribe::<[P]>().user_header::<H>();
        let mut last = String::new();
        for attempt in 0..ATTEMPTS {
            if attempt == PATIENT_ATTEMPTS {
                remove_abandoned(link, name, node.config(), MessagingPattern::PublishSubscribe);
            }
            match builder().open() {
                Ok(topic) => return check_type(link, type_name, topic),
                Err(PublishSubscribeOpenError::IncompatibleTypes) => {
                    return Err(foreign_type::<P, H>(link, name, node.config()));
                }
                Err(error) if is_transient(error) => {}
                Err(error) => return Err(middleware(link, "open the service", &error)),
            }
            let created = builder()
                .enable_safe_overflow(false)
                .subscriber_max_buffer_size(DEPTH)
                .subscriber_max_borrowed_samples(BORROWED)
                .history_size(0)
                .max_publishers(PORTS)
                .max_subscribers(PORTS)
                .max_nodes(PROCESSES)
                .create_with_attributes(&attributes(type_name));
            match created {
                Ok(topic) => return Ok(topic),
                // Another process creates the service at the same time.
                Err(
                    error @ (PublishSubscribeCreateError::AlreadyExists
                    | PublishSubscribeCreateError::IsBeingCreatedByAnotherInstance
                    | PublishSubscribeCreateError::HangsInCreation
                    | PublishSubscribeCreateError::ServiceInCorruptedState),
                ) => last = error.to_string(),
                Err(error) => return Err(middleware(link, "create the service", &error)),
            }
            thread::sleep(Duration::from_millis(20));
        }
        Err(middleware(link, "open the service", &last))
    }

    /// The topics that have a service. A missing type is inferred from the memory layout and the name.
    pub(super) fn topics(&self, link: &Link) -> Result<Vec<SeenTopic>, TransportError> {
        let node = lock(&self.node);
        let mut topics: Vec<SeenTopic> = Vec::new();
        Ipc::list(node.config(), |service| {
            let seen = discovered(self.domain_id, &service.static_details);
            // A topic of frames has two services.
            topics.extend(seen.filter(|seen| !topics.contains(seen)));
            CallbackProgression::Continue
        })
        .map_err(|error| middleware(link, "list the services", &format!("{error:?}")))?;
        Ok(topics)
    }

    /// The service that wakes the subscribers of a topic.
    pub(super) fn events(&self, link: &Link) -> Result<Events, TransportError> {
        let name = names::service(self.domain_id, link)?;
        let node = lock(&self.node);
        let mut last = String::new();
        for attempt in 0..ATTEMPTS {
            if attempt == PATIENT_ATTEMPTS {
                remove_abandoned(link, &name, node.config(), MessagingPattern::Event);
            }
            match node.service_builder(&name).event().open_or_create() {
                Ok(events) => return Ok(events),
                Err(error) => last = error.to_string(),
            }
            thread::sleep(Duration::from_millis(20));
        }
        Err(middleware(link, "open the event service", &last))
    }
}

/// The memory that the publishers of a topic have allocated.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SharedMemory {
    /// Number of publishers.
    pub publishers: usize,
    /// Number of subscribers.
    pub subscribers: usize,
    /// Size (bytes), without a few bytes of overhead per message.
    pub bytes: usize,
}

impl SharedMemory {
    pub(super) fn of<P, H>(topic: &Topic<P, H>) -> Self
    where
        P: Debug + ZeroCopySend,
        H: Debug + ZeroCopySend,
    {
        let users = topic.dynamic_config();
        let subscribers = users.number_of_subscribers();
        let mut memory = Self { subscribers, ..Self::default() };
        users.list_publishers(|publisher| {
            let message = publisher.max_slice_len * size_of::<P>() + size_of::<H>();
            memory.publishers += 1;
            memory.bytes += publisher.number_of_samples * message;
            CallbackProgression::Continue
        });
        memory
    }
}

impl Display for SharedMemory {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { publishers, subscribers, bytes } = self;
        let megabytes = *bytes as f64 * 1e-6;
        write!(formatter, "{megabytes:.1} MB ({publishers} publishers, {subscribers} subscribers)")
    }
}

/// The topic of a service; `None` if its name is not that of a topic in this domain.
fn discovered(domain_id: u16, service: &StaticConfig) -> Option<SeenTopic> {
    let messaging_pattern::MessagingPattern::PublishSubscribe(details) =
        service.messaging_pattern()
    else {
        return None;
    };
    let payload = details.message_type_details().payload.type_name();
    let is_of = |particle: TypeDetail| particle.type_name() == payload;
    let in_space = is_of(TypeDetail::new::<SharedParticle<3>>(TypeVariant::Dynamic));
    let of_frames = in_space || is_of(TypeDetail::new::<SharedParticle>(TypeVariant::Dynamic));
    let link = names::topic(domain_id, service.name(), in_space)?;
    let declared = TYPE_ATTRIBUTE
        .try_into()
        .ok()
        .and_then(|key| service.attributes().key_value(&key, 0).map(ToString::to_string));
    let type_name = declared.or_else(|| {
        let guess = if of_frames { ParticleFrame::TYPE } else { topic_type(&link.topic) };
        (of_frames || guess != ParticleFrame::TYPE).then(|| guess.to_owned())
    })?;
    Some(SeenTopic::new(link, type_name))
}

/// Whether the service does not exist, or another process is creating or removing it.
fn is_transient(error: PublishSubscribeOpenError) -> bool {
    matches!(
        error,
        PublishSubscribeOpenError::DoesNotExist
            | PublishSubscribeOpenError::IsMarkedForDestruction
            | PublishSubscribeOpenError::HangsInCreation
            | PublishSubscribeOpenError::Interrupt
            | PublishSubscribeOpenError::ServiceInCorruptedState
    )
}

/// Removes the description of a service that is empty, or whose state is gone. A process that is killed while it creates
/// or removes a service leaves it behind; iceoryx2 can then neither open the service nor create it.
fn remove_abandoned(link: &Link, name: &ServiceName, config: &Config, pattern: MessagingPattern) {
    let global = &config.global;
    let (prefix, suffix) = (&global.prefix, &global.service.static_config_storage_suffix);
    let hash = ServiceHash::new::<<Ipc as Service>::ServiceNameHasher>(name, pattern);
    let file = Path::new(&global.service_dir().to_string()).join(format!("{prefix}{hash}{suffix}"));
    let is_abandoned = match Ipc::details(name, config, pattern) {
        Ok(Some(service)) => service.dynamic_details.is_none(),
        // What cannot be read may also be of another version of iceoryx2.
        Ok(None) | Err(_) => fs::metadata(&file).is_ok_and(|file| file.len() == 0),
    };
    if !is_abandoned {
        return;
    }
    match fs::remove_file(&file) {
        Ok(()) => tracing::warn!("{link}: removed what a killed process left of the topic"),
        Err(error) => tracing::debug!("{link}: {}: {error}", file.display()),
    }
}

fn attributes(type_name: &str) -> AttributeSpecifier {
    let specifier = AttributeSpecifier::new();
    match (TYPE_ATTRIBUTE.try_into(), type_name.try_into()) {
        (Ok(key), Ok(value)) => specifier.define(&key, &value).unwrap_or_default(),
        // Longer than iceoryx2 allows: not checked.
        _ => specifier,
    }
}

/// Checks the attribute with the message type, since CDR of all types has the same layout.
fn check_type<P, H>(
    link: &Link,
    expected: &str,
    topic: Topic<P, H>,
) -> Result<Topic<P, H>, TransportError>
where
    P: Debug + ZeroCopySend,
    H: Debug + ZeroCopySend,
{
    let found = TYPE_ATTRIBUTE
        .try_into()
        .ok()
        .and_then(|key| topic.attributes().key_value(&key, 0).map(ToString::to_string));
    match found {
        Some(found) if found != expected => Err(TransportError::TopicType {
            link: link.clone(),
            found,
            expected: expected.to_owned(),
        }),
        _ => Ok(topic),
    }
}

/// The error with the layout of the service and the expected one.
fn foreign_type<P: ZeroCopySend, H: ZeroCopySend>(
    link: &Link,
    name: &ServiceName,
    config: &Config,
) -> TransportError {
    let details = Ipc::details(name, config, MessagingPattern::PublishSubscribe).ok().flatten();
    let found = match details.as_ref().map(|service| service.static_details.messaging_pattern()) {
        Some(messaging_pattern::MessagingPattern::PublishSubscribe(service)) => {
            let types = service.message_type_details();
            layout_name(&types.payload, &types.user_header)
        }
        _ => "unknown".to_owned(),
    };
    let payload = TypeDetail::new::<P>(TypeVariant::Dynamic);
    let header = TypeDetail::new::<H>(TypeVariant::FixedSize);
    let expected = layout_name(&payload, &header);
    TransportError::TopicType { link: link.clone(), found, expected }
}

fn layout_name(payload: &TypeDetail, header: &TypeDetail) -> String {
    let (payload, variant) = (payload.type_name(), payload.variant());
    let header = header.type_name();
    match variant {
        TypeVariant::Dynamic => format!("[{payload}] with header {header}"),
        TypeVariant::FixedSize => format!("{payload} with header {header}"),
    }
}

/// Starts a thread that removes the resources of killed processes: their subscribers would block publishers forever and
/// would be counted. The thread ends with the last [`Cleaner`].
fn spawn_cleaner(config: Config) -> std::io::Result<Cleaner> {
    let (keep, ended) = mpsc::channel::<()>();
    thread::Builder::new().name("shm cleaner".to_owned()).spawn(move || {
        while ended.recv_timeout(CLEANING) == Err(mpsc::RecvTimeoutError::Timeout) {
            let listed = Node::<Ipc>::list(&config, |state| {
                if let NodeState::Dead(node) = state
                    && let Err(error) = node.try_remove_stale_resources()
                {
                    tracing::debug!(?error, "cannot remove a killed process yet");
                }
                CallbackProgression::Continue
            });
            if let Err(error) = listed {
                tracing::debug!(%error, "cannot list the users of shared memory");
            }
        }
    })?;
    Ok(keep)
}

#[cfg(test)]
mod tests {
    use std::{fs::Permissions, os::unix::fs::PermissionsExt as _};

    use super::*;

    /// Mode of a description that is being written (iceoryx2-cal, `static_storage/file.rs`, `INIT_PERMISSIONS`).
    const LOCKED: u32 = 0o600;

    /// As [`remove_abandoned`] says; without it, both fail with `AlreadyExists`.
    #[test]
    fn a_topic_that_was_half_created_or_removed_is_created_anew() {
        let link = Link::shm(&format!("/abandoned_{}", std::process::id()));
        let services = Services::open(&link, &TransportOptions::new("eddy_test")).unwrap();
        let type_name = "std_msgs/msg/String";
        let opened =
            (services.topic::<u8, ()>(&link, type_name).unwrap(), services.events(&link).unwrap());
        let folder = lock(&services.node).config().global.service_dir().to_string();
        let described = |path: &std::path::PathBuf| {
            fs::read_to_string(path).is_ok_and(|text| text.contains(&link.topic))
        };
        let files: Vec<_> = fs::read_dir(folder)
            .unwrap()
            .map(|entry| entry.unwrap().path())
            .filter(described)
            .map(|path| {
                (fs::read(&path).unwrap(), fs::metadata(&path).unwrap().permissions(), path)
            })
            .collect();
        assert_eq!(files.len(), 2);
        drop(opened);
        // With the whole description; empty; empty, and locked as it is until it is written.
        for (is_written, is_locked) in [(true, false), (false, false), (false, true)] {
            for (bytes, permissions, path) in &files {
                assert!(!path.exists(), "{}", path.display());
                fs::write(path, if is_written { bytes } else { [].as_slice() }).unwrap();
                let locked = Permissions::from_mode(LOCKED);
                let permissions = if is_locked { locked } else { permissions.clone() };
                fs::set_permissions(path, permissions).unwrap();
            }
            services.topic::<u8, ()>(&link, type_name).unwrap();
            services.events(&link).unwrap();
        }
    }
}
