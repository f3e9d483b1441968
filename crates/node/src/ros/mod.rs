//! `--ros-args`: who a process is to ROS, from its command line
//! (<https://design.ros2.org/articles/ros_command_line_arguments.html>).
//!
//! 1. [`arguments`](RosArguments): the words after `--ros-args`.
//! 2. `remap`: `from:=to` (<https://design.ros2.org/articles/static_remapping.html>).
//! 3. `parameters`: `name:=value`, and files of parameters.
//! 4. `yaml`: values as ROS reads them.
//! 5. [`node`](RosNode): what of all this counts for one node: its name, its topics, its parameters.

mod arguments;
mod node;
mod parameters;
mod remap;
mod yaml;

pub use arguments::RosArguments;
pub use node::RosNode;
pub use parameters::Given;

/// An argument of ROS that cannot be used.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{argument}: found {found}, expected {expected}")]
pub struct InvalidArgument {
    /// The argument as it was given, or the file and the place in it.
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
