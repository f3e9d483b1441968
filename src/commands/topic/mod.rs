//! `eddy topic`: topics, without ROS.

mod echo;
mod hz;
mod list;

use std::time::Duration;

use super::leaves_the_process;
use crate::cli::{TopicArgs, TopicCommand};
use eddy_cli::{
    Interrupt,
    terminal::{self, on_one_line},
};
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
            let found = find(&link, &transports, MAX_FIND_TIME, interrupt)?;
            if let Some(SeenTopic { type_name, hash, .. }) = found {
                let hash = hash.as_deref().unwrap_or("unknown");
                println!("Type: {}\nType hash: {}", on_one_line(&type_name), on_one_line(hash));
                if let Some(memory) = transports.shared_memory(&link, &type_name)? {
                    println!("Shared memory: {memory}");
                }
            }
            Ok(())
        }
    }
}

/// Prints a line, or several. Returns `false` when nobody reads them any more, as behind `| head`.
fn print(text: &str) -> bool {
    println!("{text}");
    !terminal::is_closed() && terminal::failure().is_none()
}

/// Waits until a topic is published. `None` when a signal came first.
fn find(
    link: &Link,
    transports: &Transports,
    timeout: Duration,
    interrupt: &Interrupt,
) -> anyhow::Result<Option<SeenTopic>> {
    leaves_the_process(link)?;
    Ok(find_topic(transports, link, timeout, || interrupt.requested())?)
}
