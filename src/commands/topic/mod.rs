//! `eddy topic`: topics, without ROS.

mod echo;
mod hz;
mod list;

use std::{
    io::{self, ErrorKind, Write as _},
    time::Duration,
};

use super::{Interrupt, leaves_the_process};
use crate::cli::{TopicArgs, TopicCommand};
use eddy_node::topics::{MAX_FIND_TIME, find_topic};
use eddy_transport::{Link, SeenTopic, TransportOptions, Transports};

/// Name of this process in the ROS graph.
const NAME: &str = "eddy_topic";
/// Longest wait for a message before signals are checked.
const MAX_WAIT: Duration = Duration::from_millis(100);

/// Runs the subcommand.
pub fn run(args: TopicArgs, interrupt: &Interrupt) -> anyhow::Result<()> {
    let transports = Transports::new(TransportOptions::from_env(NAME)?);
    match args.command {
        TopicCommand::List(args) => list::run(&args, &transports, interrupt),
        TopicCommand::Echo(args) => echo::run(&args, &transports, interrupt),
        TopicCommand::Hz(args) => hz::run(&args, &transports, interrupt),
        TopicCommand::Info { link } => {
            if let Some(SeenTopic { type_name, hash, .. }) = find(&link, &transports, interrupt)? {
                let hash = hash.as_deref().unwrap_or("unknown");
                print(&format!("Type: {type_name}\nType hash: {hash}"))?;
                if let Some(memory) = transports.shared_memory(&link, &type_name)? {
                    print(&format!("Shared memory: {memory}"))?;
                }
            }
            Ok(())
        }
    }
}

/// Prints a line, or several. Returns `false` when the reader is gone, as behind `| head`.
fn print(text: &str) -> io::Result<bool> {
    match writeln!(io::stdout(), "{text}") {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error),
    }
}

/// Waits until a topic is published. `None` when a signal came first.
fn find(
    link: &Link,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<Option<SeenTopic>> {
    leaves_the_process(link)?;
    Ok(find_topic(transports, link, MAX_FIND_TIME, || interrupt.requested())?)
}
