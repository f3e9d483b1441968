//! `--ros-args`: names and parameters of a node, from the command line
//! (<https://design.ros2.org/articles/ros_command_line_arguments.html>).
//!
//! 1. `yaml`: values as ROS parses them.
//! 2. `remap`: `from:=to` (<https://design.ros2.org/articles/static_remapping.html>).
//! 3. `parameters`: `name:=value`, and parameter files.
//! 4. [`arguments`](RosArguments): the arguments after `--ros-args`.
//! 5. [`node`](RosNode): what applies to one node: its name, topics and parameters. [`qos`](TopicQos): QoS of single
//!    topics.
//! 6. [`rosout`](Rosout): the log as a topic.

mod arguments;
mod node;
mod parameters;
mod qos;
mod remap;
mod rosout;
pub(crate) mod yaml;

pub use arguments::RosArguments;
pub use node::RosNode;
pub use parameters::ParameterOverride;
pub(crate) use parameters::parse as parse_parameter;
pub use qos::TopicQos;
pub use rosout::{ROSOUT, ROSOUT_QOS, Rosout, RosoutPublisher};

/// An invalid ROS argument.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{argument}: found {found}, expected {expected}")]
pub struct InvalidArgument {
    /// The argument, or the file and the place in it.
    pub argument: String,
    /// What was found there.
    pub found: String,
    /// What was expected.
    pub expected: String,
}

impl InvalidArgument {
    fn new(argument: &str, found: impl Into<String>, expected: impl Into<String>) -> Self {
        Self { argument: argument.to_owned(), found: found.into(), expected: expected.into() }
    }
}
