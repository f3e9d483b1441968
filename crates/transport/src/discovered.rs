//! Topics found on a transport.

use super::Link;
use eddy_messages::{TypeSupport, type_support};

/// A topic with a publisher.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct SeenTopic {
    /// Transport and name of the topic.
    pub link: Link,
    /// The type of its messages, such as `eddy_msgs/msg/ParticleFrame`.
    pub type_name: String,
    /// RIHS01 type hash, if known.
    pub hash: Option<String>,
    /// Number of messages that its publishers keep for late-joining subscribers (transient local); 0 if unknown.
    pub kept: usize,
}

impl SeenTopic {
    /// The type support for a subscription: that of eddy-messages if the hashes are equal, else name and hash only.
    pub fn type_support(&self) -> TypeSupport {
        match type_support(&self.type_name) {
            Ok(ours) if self.hash.as_ref().is_none_or(|hash| *hash == ours.hash) => ours.clone(),
            _ => TypeSupport::foreign(&self.type_name, self.hash.as_deref().unwrap_or_default()),
        }
    }
}
