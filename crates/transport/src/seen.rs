//! Which topics there are on a transport.

use super::Link;
use eddy_messages::{TypeSupport, type_support};

/// A topic that somebody publishes.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SeenTopic {
    /// Where it is.
    pub link: Link,
    /// The type of its messages, such as `eddy_msgs/msg/ParticleFrame`.
    pub type_name: String,
    /// RIHS01 type hash, where the transport tells.
    pub hash: Option<String>,
    /// How many messages its publishers keep for subscribers that come later (transient local), where the
    /// transport tells.
    pub kept: usize,
}

impl SeenTopic {
    /// What is needed to subscribe to it: our own type if it is the same, else its name and hash.
    pub fn type_support(&self) -> TypeSupport {
        match type_support(&self.type_name) {
            Ok(ours) if self.hash.as_ref().is_none_or(|hash| *hash == ours.hash) => ours.clone(),
            _ => TypeSupport::foreign(&self.type_name, self.hash.as_deref().unwrap_or_default()),
        }
    }
}
