//! `eddy topic`: looks at topics, without ROS.

mod echo;
mod hz;
mod list;

use std::{
    io::{self, ErrorKind, Write as _},
    thread,
    time::Duration,
};

use anyhow::bail;

use super::{Interrupt, leaves_the_process};
use crate::cli::{TopicArgs, TopicCommand};
use eddy_frames::clock::Clock;
use eddy_transport::{Link, SeenTopic, TransportOptions, Transports};

/// This process in the ROS graph.
const NAME: &str = "eddy_topic";
/// How long a topic is waited for.
const WAIT_LIMIT: Duration = Duration::from_secs(30);
/// How long it is waited for without a word.
const WAIT_UNTOLD: Duration = Duration::from_secs(3);
/// Between two looks at what there is.
const NAP: Duration = Duration::from_millis(50);
/// How long a wait for a message may last before signals are looked at.
const PATIENCE: Duration = Duration::from_millis(100);

/// Runs the subcommand.
pub fn run(args: TopicArgs, interrupt: &Interrupt) -> anyhow::Result<()> {
    let transports = Transports::new(TransportOptions::from_env(NAME)?);
    match args.command {
        TopicCommand::List(args) => list::run(&args, &transports, interrupt),
        TopicCommand::Echo(args) => echo::run(&args, &transports, interrupt),
        TopicCommand::Hz(args) => hz::run(&args, &transports, interrupt),
        TopicCommand::Info { link } => {
            if let Some(SeenTopic { type_name, hash, .. }) = find(&link, &transports, interrupt)? {
                let hash = hash.as_deref().unwrap_or("not told");
                print(&format!("Type: {type_name}\nType hash: {hash}"))?;
                if let Some(memory) = transports.shared_memory(&link, &type_name)? {
                    print(&format!("Shared memory: {memory}"))?;
                }
            }
            Ok(())
        }
    }
}

/// Prints a line, or several. `false` when nobody reads any more, as behind `| head`.
fn print(text: &str) -> io::Result<bool> {
    match writeln!(io::stdout(), "{text}") {
        Ok(()) => Ok(true),
        Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(false),
        Err(error) => Err(error),
    }
}

/// Waits for a topic to be published. `None` when a signal came first.
fn find(
    link: &Link,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<Option<SeenTopic>> {
    leaves_the_process(link)?;
    let clock = Clock::start();
    let mut told = false;
    loop {
        let topics = transports.topics(link.transport)?;
        if let Some(topic) = topics.iter().find(|topic| topic.link == *link) {
            return Ok(Some(topic.clone()));
        }
        if interrupt.requested() {
            return Ok(None);
        }
        if clock.now() > WAIT_LIMIT {
            let others: Vec<_> = topics.iter().map(|topic| topic.link.topic.as_str()).collect();
            let others = if others.is_empty() { "none".to_owned() } else { others.join(", ") };
            bail!(
                "{link}: found nobody who publishes it within 30 s; on {} there are: {others}",
                link.transport
            );
        }
        if !told && clock.now() > WAIT_UNTOLD {
            told = true;
            tracing::warn!("{link}: waiting for somebody who publishes it");
        }
        thread::sleep(NAP);
    }
}
