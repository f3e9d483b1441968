//! `eddy topic`: its subcommands.

use std::num::NonZeroUsize;

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
    /// Prints the topics that are published, with their types.
    List(TopicListArgs),
    /// Prints the messages of a topic as YAML, like `ros2 topic echo`.
    Echo(TopicEchoArgs),
    /// Prints how many messages a second a topic has, like `ros2 topic hz`.
    Hz(TopicHzArgs),
    /// Prints the type of a topic's messages, and the memory it takes on shm.
    Info {
        /// The topic, for example zenoh:/particles.
        link: Link,
    },
}

/// `eddy topic list`
#[derive(Debug, Args)]
pub struct TopicListArgs {
    /// Where to look; others only answer once they are found, which takes dds some seconds.
    #[arg(long, value_delimiter = ',', default_values = ["zenoh", "shm"])]
    pub from: Vec<TransportKind>,
    /// How long to look (s).
    #[arg(long, default_value_t = 2.0, value_parser = super::seconds)]
    pub wait: f64,
}

/// `eddy topic echo`
#[derive(Debug, Args)]
pub struct TopicEchoArgs {
    /// The topic, for example zenoh:/particles.
    pub link: Link,
    /// End after so many messages; at SIGINT or SIGTERM if not given.
    #[arg(long, short)]
    pub count: Option<NonZeroUsize>,
    /// Numbers of a list that are printed; all with 0.
    #[arg(long, default_value_t = 8)]
    pub truncate: usize,
}

/// `eddy topic hz`
#[derive(Debug, Args)]
pub struct TopicHzArgs {
    /// The topic, for example zenoh:/particles.
    pub link: Link,
    /// Messages that the figures are of, the last ones.
    #[arg(long, short, default_value = "10000")]
    pub window: NonZeroUsize,
    /// End after so many seconds; at SIGINT or SIGTERM if not given.
    #[arg(long, value_parser = super::seconds)]
    pub duration: Option<f64>,
}
