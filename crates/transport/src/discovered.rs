//! Topics and services found on a transport.

use super::Link;
use eddy_messages::{QosProfile, TypeSupport, type_support};

/// A topic with a publisher.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SeenTopic {
    /// Transport and name of the topic.
    pub link: Link,
    /// The type of its messages, such as `eddy_msgs/msg/ParticleFrame`.
    pub type_name: String,
    /// RIHS01 type hash, if known.
    pub hash: Option<String>,
    /// What each of its publishers offers, sorted; empty if unknown.
    pub offered: Vec<QosProfile>,
}

/// A service of another node.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SeenService {
    /// Transport and name of the service.
    pub link: Link,
    /// Its type, such as `std_srvs/srv/Trigger`.
    pub type_name: String,
    /// RIHS01 type hash, if known.
    pub hash: Option<String>,
}

impl SeenTopic {
    /// A topic of which only the type is known.
    pub fn new(link: Link, type_name: String) -> Self {
        Self { link, type_name, hash: None, offered: Vec::new() }
    }

    /// The built-in type support, if there is one with this hash; else name and hash only.
    pub fn type_support(&self) -> TypeSupport {
        match type_support(&self.type_name) {
            Ok(ours) if self.hash.as_ref().is_none_or(|hash| *hash == ours.hash) => ours.clone(),
            _ => TypeSupport::foreign(&self.type_name, self.hash.as_deref().unwrap_or_default()),
        }
    }
}
