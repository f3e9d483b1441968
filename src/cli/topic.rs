//! `eddy topic`: its subcommands.

use std::{num::NonZeroUsize, path::PathBuf};

use clap::{Args, Subcommand};

use eddy_transport::{Link, TransportKind};

/// `eddy topic`
#[derive(Debug, Args)]
pub struct TopicArgs {
    #[command(subcommand)]
    pub command: TopicCommand,
}

#[derive(Debug, Subcommand)]
pub enum TopicCommand {
    /// List published topics with their types.
    List(TopicListArgs),
    /// Print the messages of a topic as YAML, like `ros2 topic echo`.
    Echo(TopicEchoArgs),
    /// Measure the message rate of a topic, like `ros2 topic hz`.
    Hz(TopicHzArgs),
    /// Print the type of a topic and, on shm, its memory.
    Info {
        /// Topic, for example /particles or shm:/particles.
        #[arg(value_parser = Link::from_argument)]
        link: Link,
    },
}

/// `eddy topic list`
#[derive(Debug, Args)]
pub struct TopicListArgs {
    /// Transports to search; discovery on dds takes several seconds.
    #[arg(long, value_name = "TRANSPORT", value_delimiter = ',', default_values = ["zenoh", "shm"], env = "EDDY_TRANSPORT", hide_env_values = true)]
    pub from: Vec<TransportKind>,
    /// Show the types, which is the default; for commands written for `ros2 topic list`.
    #[arg(long, short = 't', hide = true)]
    pub show_types: bool,
    /// Search time (s).
    #[arg(long, value_name = "SECONDS", default_value_t = 2.0, value_parser = eddy_cli::values::seconds)]
    pub wait: f64,
}

/// `eddy topic echo`
#[derive(Debug, Args)]
pub struct TopicEchoArgs {
    /// Topic, for example /particles or shm:/particles.
    #[arg(value_parser = Link::from_argument)]
    pub link: Link,
    /// Stop after N messages [default: at SIGINT or SIGTERM].
    #[arg(long, short, value_name = "N")]
    pub count: Option<NonZeroUsize>,
    /// Stop after the first message, as --count 1.
    #[arg(long, conflicts_with = "count")]
    pub once: bool,
    /// Maximum number of list items to print; 0 prints all.
    #[arg(long, value_name = "N", default_value_t = 8)]
    pub truncate: usize,
    /// Installations of ROS 2 with definitions of message types, separated by colons [default: none].
    #[arg(
        long,
        value_name = "PATHS",
        env = "AMENT_PREFIX_PATH",
        hide_env_values = true,
        value_delimiter = ':'
    )]
    pub ament_prefix_path: Vec<PathBuf>,
}

/// `eddy topic hz`
#[derive(Debug, Args)]
pub struct TopicHzArgs {
    /// Topic, for example /particles or shm:/particles.
    #[arg(value_parser = Link::from_argument)]
    pub link: Link,
    /// Window size: statistics cover the last N messages.
    #[arg(long, short, value_name = "N", default_value = "10000")]
    pub window: NonZeroUsize,
    /// Stop this time after the start, also if the topic is not published (s) [default: at SIGINT or SIGTERM].
    #[arg(long, value_name = "SECONDS", value_parser = eddy_cli::values::seconds)]
    pub duration: Option<f64>,
}
