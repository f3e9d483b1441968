//! What tools are and where their poses come from: the TOML file of `eddy tools`.

use eddy_frames::tool::{self, Contact, InvalidTool, Outline};
use eddy_transport::is_absolute_name;
use serde::Deserialize;

use crate::ros::RosNode;

/// The file of `eddy tools`.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ToolsFile {
    /// Tools, at most eight.
    pub tools: Vec<FollowedTool>,
}

/// A tool whose poses are messages.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FollowedTool {
    /// Its name, different from those of the other tools.
    pub name: String,
    /// Its outline, relative to its position.
    pub shape: Outline,
    /// What matter does at its surface; slips by default.
    #[serde(default)]
    pub contact: Contact,
    /// Topic of its poses (`geometry_msgs/msg/PoseStamped`), if it has no `frame`.
    pub pose: Option<String>,
    /// Its coordinate frame on `/tf` and `/tf_static`, if it has no `pose`.
    pub frame: Option<String>,
    /// The coordinate frame of the particles, in which its poses are; `world` by default.
    #[serde(default = "world")]
    pub parent: String,
}

/// The coordinate frame that eddy writes.
fn world() -> String {
    "world".to_owned()
}

/// Where the poses of a tool come from.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum PoseSource {
    /// A topic.
    Topic(String),
    /// A coordinate frame.
    Frame(String),
}

impl FollowedTool {
    /// What it is, without its poses.
    pub(super) fn body(&self) -> tool::Tool {
        let Self { name, shape, contact, .. } = self.clone();
        tool::Tool { name, shape, contact }
    }

    /// Where its poses come from.
    fn source(&self, field: &str) -> Result<PoseSource, InvalidTool> {
        match (&self.pose, &self.frame) {
            (Some(topic), None) if is_absolute_name(topic) => Ok(PoseSource::Topic(topic.clone())),
            (Some(topic), None) => {
                let expected = "the name of a topic, such as /cup/pose";
                Err(InvalidTool::new(format!("{field}.pose"), format!("{topic:?}"), expected))
            }
            (None, Some(frame)) if !frame.is_empty() && *frame != self.parent => {
                Ok(PoseSource::Frame(frame.clone()))
            }
            (None, Some(frame)) => {
                let expected = format!("a frame other than its parent {:?}", self.parent);
                Err(InvalidTool::new(format!("{field}.frame"), format!("{frame:?}"), expected))
            }
            (found, _) => {
                let found = if found.is_some() { "pose and frame" } else { "no pose and no frame" };
                Err(InvalidTool::new(field, found, "one of them"))
            }
        }
    }
}

impl ToolsFile {
    /// The same with the topics of a node, which are absolute.
    #[must_use]
    pub fn renamed(mut self, ros: &RosNode) -> Self {
        for tool in &mut self.tools {
            tool.pose = tool.pose.as_deref().map(|topic| ros.topic(topic));
        }
        self
    }

    /// Where the poses of each tool come from.
    ///
    /// # Errors
    /// [`InvalidTool`] for no tools, and for the first that cannot be.
    pub(super) fn sources(&self) -> Result<Vec<PoseSource>, InvalidTool> {
        if self.tools.is_empty() {
            return Err(InvalidTool::new("tools", "none", "at least one"));
        }
        let bodies: Vec<tool::Tool> = self.tools.iter().map(FollowedTool::body).collect();
        tool::check(&bodies)?;
        let named = |(index, tool): (usize, &FollowedTool)| {
            let field = format!("tools[{index}]");
            match tool.parent.is_empty() {
                true => Err(InvalidTool::new(format!("{field}.parent"), "\"\"", "a frame")),
                false => tool.source(&field),
            }
        };
        self.tools.iter().enumerate().map(named).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::RosArguments;

    fn file(keys: &str) -> Result<ToolsFile, String> {
        let text = format!("[[tools]]\nname = \"cup\"\nshape.disc.radius = 0.1\n{keys}\n");
        toml::from_str(&text).map_err(|error| error.to_string())
    }

    #[test]
    fn a_tool_has_a_topic_or_a_frame() {
        let topic = file("pose = \"/cup/pose\"").unwrap();
        assert_eq!(topic.tools[0].contact, Contact::Slip);
        assert_eq!(topic.sources(), Ok(vec![PoseSource::Topic("/cup/pose".into())]));
        let frame = file("frame = \"cup_link\"\ncontact.friction = 0.5").unwrap();
        assert_eq!(frame.tools[0].parent, "world");
        assert_eq!(frame.sources(), Ok(vec![PoseSource::Frame("cup_link".into())]));
    }

    #[test]
    fn topics_are_those_of_the_node() {
        let words = ["-r", "__ns:=/left", "-r", "pose:=/cup/pose"].map(str::to_owned);
        let ros = RosArguments::parse(&words).unwrap().node("eddy_tools");
        for (topic, expected) in [("pose", "/cup/pose"), ("other", "/left/other"), ("/a", "/a")] {
            let renamed = file(&format!("pose = {topic:?}")).unwrap().renamed(&ros);
            assert_eq!(renamed.tools[0].pose.as_deref(), Some(expected));
        }
    }

    #[test]
    fn files_that_cannot_be_used_are_refused_with_found_and_expected() {
        for (keys, expected) in [
            ("", "tools[0]: found no pose and no frame, expected one of them"),
            (
                "pose = \"/a\"\nframe = \"b\"",
                "tools[0]: found pose and frame, expected one of them",
            ),
            ("pose = \"a b\"", "tools[0].pose: found \"a b\", expected the name of a topic"),
            ("frame = \"world\"", "tools[0].frame: found \"world\", expected a frame other than"),
            ("frame = \"a\"\nparent = \"\"", "tools[0].parent: found \"\", expected a frame"),
            (
                "pose = \"/a\"\ncontact.friction = -1",
                "tools[0].contact.friction: found -1, expected a number from 0 to 1000",
            ),
        ] {
            let error = file(keys).unwrap().sources().unwrap_err().to_string();
            assert!(error.starts_with(expected), "{error}, expected {expected}");
        }
        let none = ToolsFile::default().sources().unwrap_err().to_string();
        assert_eq!(none, "tools: found none, expected at least one");
        let keyframes = file("keyframes = []").unwrap_err();
        assert!(keyframes.contains("unknown field `keyframes`"), "{keyframes}");
    }
}
