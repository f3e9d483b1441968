//! Links: a transport and a topic, written `zenoh:/particles`.

use std::{fmt, str::FromStr};

use serde::Deserialize;

use eddy_settings::near;

/// The transports.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum TransportKind {
    /// Within a process.
    Memory,
    /// Shared memory (iceoryx2).
    Shm,
    /// Zenoh with the wire format of ROS 2's rmw_zenoh.
    Zenoh,
    /// DDS, the default of ROS 2.
    Dds,
}

impl TransportKind {
    pub(crate) const ALL: [Self; 4] = [Self::Memory, Self::Shm, Self::Zenoh, Self::Dds];

    /// The transport of topics that are given without one: that of the environment variable `EDDY_TRANSPORT`, else
    /// Zenoh.
    ///
    /// # Errors
    /// [`InvalidLink::Transport`].
    #[expect(
        clippy::disallowed_methods,
        reason = "a setting of the user's session, like ROS_DOMAIN_ID"
    )]
    pub fn from_env() -> Result<Self, InvalidLink> {
        match std::env::var("EDDY_TRANSPORT") {
            Ok(name) if !name.is_empty() => name.parse(),
            _ => Ok(Self::Zenoh),
        }
    }

    /// Whether ROS 2 nodes use it too.
    pub fn is_of_ros(self) -> bool {
        matches!(self, Self::Zenoh | Self::Dds)
    }

    /// The name in links.
    pub fn name(self) -> &'static str {
        match self {
            Self::Memory => "memory",
            Self::Shm => "shm",
            Self::Zenoh => "zenoh",
            Self::Dds => "dds",
        }
    }
}

impl fmt::Display for TransportKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl FromStr for TransportKind {
    type Err = InvalidLink;

    fn from_str(text: &str) -> Result<Self, InvalidLink> {
        Self::ALL
            .into_iter()
            .find(|kind| kind.name() == text)
            .ok_or_else(|| InvalidLink::Transport { found: text.to_owned() })
    }
}

/// A topic on a transport.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Deserialize)]
#[serde(try_from = "String")]
pub struct Link {
    /// The transport.
    pub transport: TransportKind,
    /// Absolute ROS 2 name of the topic, such as `/particles`; in a link of a node that is not open yet
    /// ([`Link::parse_of_node`]) also a relative one.
    pub topic: String,
}

/// A text that is not a [`Link`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidLink {
    /// It has no colon.
    #[error("link: found `{found}`, expected transport:topic, for example zenoh:/particles")]
    Form {
        /// The text.
        found: String,
    },
    /// The transport is unknown.
    #[error(
        "link transport: found `{found}`, expected shm, zenoh or dds{}",
        near::hint(found, TransportKind::ALL.map(TransportKind::name))
    )]
    Transport {
        /// The part before the colon.
        found: String,
    },
    /// The topic is not an absolute ROS 2 name.
    #[error(
        "link topic: found `{found}`, expected an absolute ROS 2 name such as /particles (letters, digits and _; no part starts with a digit){}",
        meant(found)
    )]
    Topic {
        /// The part after the colon.
        found: String,
    },
    /// The link stays within a process, but others are to use it.
    #[error(
        "{link}: found memory, expected shm, zenoh or dds: memory links stay within one process"
    )]
    Memory {
        /// The link.
        link: Link,
    },
}

impl Link {
    /// A topic on Zenoh.
    pub fn zenoh(topic: &str) -> Self {
        Self { transport: TransportKind::Zenoh, topic: topic.to_owned() }
    }

    /// A topic in shared memory.
    pub fn shm(topic: &str) -> Self {
        Self { transport: TransportKind::Shm, topic: topic.to_owned() }
    }

    /// A topic within the process.
    pub fn memory(topic: &str) -> Self {
        Self { transport: TransportKind::Memory, topic: topic.to_owned() }
    }

    /// A link of a node as typed by a user, as [`Link::from_argument`], whose topic may also be relative: to the namespace of
    /// the node (`dds:particles`), or to its name (`dds:~/particles`). The node makes it absolute.
    ///
    /// # Errors
    /// [`InvalidLink`].
    pub fn parse_of_node(text: &str) -> Result<Self, InvalidLink> {
        let invalid = match Self::from_argument(text) {
            Err(invalid @ InvalidLink::Topic { .. }) => invalid,
            parsed => return parsed,
        };
        let Some((transport, topic)) = text.split_once(':') else { return Err(invalid) };
        let relative = topic.strip_prefix("~/").unwrap_or(topic);
        if !is_absolute_name(&format!("/{relative}")) {
            return Err(invalid);
        }
        Ok(Self { transport: transport.parse()?, topic: topic.to_owned() })
    }

    /// Rejects a link that no other process can use.
    ///
    /// # Errors
    /// [`InvalidLink::Memory`].
    pub fn leaves_the_process(&self) -> Result<(), InvalidLink> {
        match self.transport {
            TransportKind::Memory => Err(InvalidLink::Memory { link: self.clone() }),
            _ => Ok(()),
        }
    }

    /// The same transport with another topic.
    pub fn with_topic(&self, topic: &str) -> Self {
        Self { transport: self.transport, topic: topic.to_owned() }
    }
}

impl Link {
    /// A link as typed by a user: a topic without a transport is on the one in the environment variable
    /// `EDDY_TRANSPORT`, Zenoh by default.
    ///
    /// # Errors
    /// As [`Link::from_str`]; [`InvalidLink::Transport`] for an unknown transport in the variable.
    pub fn from_argument(text: &str) -> Result<Self, InvalidLink> {
        if !text.starts_with('/') {
            return text.parse();
        }
        Ok(Self { transport: TransportKind::from_env()?, ..format!("zenoh:{text}").parse()? })
    }
}

impl TryFrom<String> for Link {
    type Error = InvalidLink;

    fn try_from(text: String) -> Result<Self, InvalidLink> {
        text.parse()
    }
}

impl fmt::Display for Link {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}:{}", self.transport, self.topic)
    }
}

impl FromStr for Link {
    type Err = InvalidLink;

    fn from_str(text: &str) -> Result<Self, InvalidLink> {
        let (transport, topic) =
            text.split_once(':').ok_or_else(|| InvalidLink::Form { found: text.to_owned() })?;
        if !is_absolute_name(topic) {
            return Err(InvalidLink::Topic { found: topic.to_owned() });
        }
        Ok(Self { transport: transport.parse()?, topic: topic.to_owned() })
    }
}

/// A hint if only the leading slash is missing.
fn meant(topic: &str) -> String {
    let absolute = format!("/{topic}");
    let alone = is_absolute_name(&absolute);
    if alone { format!("; did you mean {absolute}?") } else { String::new() }
}

/// Whether this is an absolute ROS 2 topic name, <https://design.ros2.org/articles/topic_and_service_names.html>.
pub fn is_absolute_name(topic: &str) -> bool {
    topic.strip_prefix('/').is_some_and(|rest| rest.split('/').all(is_name_token))
}

/// Whether this is a valid part of such a name, or a node name.
pub fn is_name_token(token: &str) -> bool {
    token.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_')
        && token.chars().all(|c| c.is_ascii_alphanumeric() || c == '_')
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_link_is_parsed_from_its_text() {
        for text in ["zenoh:/particles", "shm:/prediction/status", "memory:/a_1", "dds:/a"] {
            assert_eq!(text.parse::<Link>().unwrap().to_string(), text);
            assert_eq!(Link::from_argument(text).unwrap().to_string(), text);
        }
        assert_eq!(Link::from_argument("/a/b").unwrap().topic, "/a/b");
    }

    #[test]
    fn links_of_a_node_may_be_relative() {
        for text in ["zenoh:particles", "shm:a/b", "dds:~/particles", "dds:/a"] {
            assert!(text.parse::<Link>().is_err() || text == "dds:/a", "{text}");
            assert_eq!(Link::parse_of_node(text).unwrap().to_string(), text);
        }
        for text in ["shm:", "shm:9", "shm:~", "shm:~a", "shm:a//b", "zneoh:a", "particles"] {
            assert!(Link::parse_of_node(text).is_err(), "{text}");
        }
    }

    #[test]
    fn invalid_links_are_rejected_with_what_was_expected() {
        let message = |text: &str| text.parse::<Link>().unwrap_err().to_string();
        assert!(message("/particles").starts_with("link: found `/particles`"));
        assert!(message("tcp:/particles").starts_with("link transport: found `tcp`"));
        assert!(message("zneoh:/particles").ends_with("; did you mean zenoh?"));
        assert!(message("shm:particles").ends_with("; did you mean /particles?"));
        for topic in ["particles", "/", "/a//b", "/9lives", "/a b", "/a/"] {
            assert!(message(&format!("shm:{topic}")).starts_with("link topic: found"), "{topic}");
        }
    }
}
