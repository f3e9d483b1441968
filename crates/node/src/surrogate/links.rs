//! Input and outputs of a node.

use eddy_transport::{InvalidLink, Link, TransportKind};

use crate::ros::RosNode;

/// Input and outputs of a node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NodeLinks {
    /// Where frames come from.
    pub input: Link,
    /// Where predictions go.
    pub outputs: Vec<Link>,
}

/// Links that a node cannot use together.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum InvalidLinks {
    /// One of them cannot be used.
    #[error(transparent)]
    Link(#[from] InvalidLink),
    /// Two outputs are the same.
    #[error("output: found {link} twice, expected once")]
    Twice { link: Link },
    /// The node would predict from its own predictions.
    #[error("output: found {link}, which is the input, expected another topic")]
    Loop { link: Link },
    /// The members of a group could not see each other.
    #[error(
        "group: found the input {link}, expected one on zenoh, whose liveliness tokens say who is alive"
    )]
    Group { link: Link },
    /// Nobody could manage the node.
    #[error(
        "--lifecycle: found links on shm only, expected one on zenoh or dds, whose services manage the node"
    )]
    Unmanageable,
}

impl NodeLinks {
    /// The given links; by default `particles` and `prediction` below the namespace of the node, on the transport of the
    /// environment.
    ///
    /// # Errors
    /// [`InvalidLink::Transport`] when the environment names another transport.
    pub fn new(input: Option<Link>, outputs: Vec<Link>) -> Result<Self, InvalidLink> {
        let transport = TransportKind::from_env()?;
        let relative = |topic: &str| Link { transport, topic: topic.to_owned() };
        let outputs = if outputs.is_empty() { vec![relative("prediction")] } else { outputs };
        Ok(Self { input: input.unwrap_or(relative("particles")), outputs })
    }

    /// The links with the names of a node, which are absolute.
    pub fn renamed(&self, ros: &RosNode) -> Self {
        let outputs = self.outputs.iter().map(|link| ros.link(link));
        Self { input: ros.link(&self.input), outputs: outputs.collect() }
    }

    /// Checks renamed links, of a managed node or one that is always active, in a group or on its own.
    ///
    /// # Errors
    /// [`InvalidLinks`].
    pub fn check(&self, is_managed: bool, is_in_group: bool) -> Result<(), InvalidLinks> {
        self.all().try_for_each(Link::leaves_the_process)?;
        if is_in_group && self.input.transport != TransportKind::Zenoh {
            return Err(InvalidLinks::Group { link: self.input.clone() });
        }
        if is_managed && !self.all().any(|link| link.transport.is_of_ros()) {
            return Err(InvalidLinks::Unmanageable);
        }
        for (index, link) in self.outputs.iter().enumerate() {
            if self.outputs[..index].contains(link) {
                return Err(InvalidLinks::Twice { link: link.clone() });
            }
            if *link == self.input {
                return Err(InvalidLinks::Loop { link: link.clone() });
            }
        }
        Ok(())
    }

    /// One link for each transport, the input's first.
    pub(super) fn one_per_transport(&self) -> Vec<&Link> {
        let mut links: Vec<&Link> = Vec::new();
        for link in self.all() {
            if links.iter().all(|other| other.transport != link.transport) {
                links.push(link);
            }
        }
        links
    }

    /// The input, then the outputs.
    pub fn all(&self) -> impl Iterator<Item = &Link> {
        [&self.input].into_iter().chain(&self.outputs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::RosArguments;

    fn link(text: &str) -> Link {
        Link::parse_of_node(text).unwrap()
    }

    fn check(input: &str, outputs: &[&str]) -> Result<(), String> {
        let outputs = outputs.iter().map(|text| link(text)).collect();
        let links = NodeLinks { input: link(input), outputs };
        let words = ["-r", "__ns:=/robot1"].map(str::to_owned);
        let ros = RosArguments::parse(&words).unwrap().node("eddy_node");
        links.renamed(&ros).check(false, false).map_err(|error| error.to_string())
    }

    #[test]
    fn links_that_cannot_be_used_together_are_named() {
        assert_eq!(check("shm:particles", &["shm:prediction", "dds:prediction"]), Ok(()));
        assert_eq!(check("shm:a", &["dds:a"]), Ok(()), "another transport is another topic");
        for (input, outputs, expected) in [
            (
                "shm:a",
                &["shm:b", "shm:/robot1/b"][..],
                "output: found shm:/robot1/b twice, expected once",
            ),
            (
                "shm:a",
                &["shm:/robot1/a"],
                "output: found shm:/robot1/a, which is the input, expected another topic",
            ),
            ("memory:a", &["shm:b"], "memory:/robot1/a: found memory, expected shm, zenoh or dds"),
        ] {
            let message = check(input, outputs).unwrap_err();
            assert!(message.starts_with(expected), "{message}");
        }
    }

    #[test]
    fn a_group_needs_an_input_on_zenoh() {
        let check = |input| {
            let links = NodeLinks { input: link(input), outputs: vec![link("shm:/b")] };
            links.check(false, true).map_err(|error| error.to_string())
        };
        assert_eq!(check("zenoh:/a"), Ok(()));
        let message = check("dds:/a").unwrap_err();
        assert!(
            message.starts_with("group: found the input dds:/a, expected one on zenoh"),
            "{message}"
        );
    }

    #[test]
    fn topics_of_the_whole_node_are_on_each_transport_once() {
        let links = NodeLinks {
            input: link("shm:/a"),
            outputs: vec![link("zenoh:/b"), link("shm:/c"), link("zenoh:/d")],
        };
        let found: Vec<_> = links.one_per_transport().iter().map(|link| link.to_string()).collect();
        assert_eq!(found, ["shm:/a", "zenoh:/b"]);
    }
}
