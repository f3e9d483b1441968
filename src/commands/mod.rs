//! One file a subcommand: wires parts of the library together, adds the context to errors, prints.

pub mod bag;
pub mod completions;
pub mod demo;
pub mod eval;
pub mod lab;
pub mod launch;
pub mod node;
pub mod predict;
pub mod record;
pub mod replay;
pub mod simulate;
pub mod topic;
pub mod train;

mod interrupt;
mod pace;
mod page;
mod pages;
mod progress;
mod surrogate;

pub use interrupt::Interrupt;
pub(crate) use progress::TerminalProgress;

use std::{thread, time::Duration};

use anyhow::{bail, ensure};
use eddy_frames::clock::Clock;
use eddy_node::ros::RosNode;
use eddy_transport::{Link, Publisher, TransportError, TransportKind, TransportOptions};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// Refuses a link on which no other process can be met.
pub(crate) fn leaves_the_process(link: &Link) -> anyhow::Result<()> {
    ensure!(
        link.transport != TransportKind::Memory,
        "{link}: found memory, expected shm, zenoh or dds: memory links stay within one process"
    );
    Ok(())
}

/// How this process appears on its transports.
pub(crate) fn transport_options(ros: &RosNode) -> Result<TransportOptions, TransportError> {
    let options = TransportOptions::from_env(ros.name())?;
    Ok(TransportOptions { namespace: ros.namespace().to_owned(), ..options })
}

/// Refuses parameters that were given to this very command, which has none.
pub(crate) fn has_no_parameters(ros: &RosNode) -> anyhow::Result<()> {
    match ros.parameters().iter().find(|given| !given.for_all) {
        Some(given) => bail!(
            "{}: found {}, expected none: there are no parameters here",
            given.argument,
            given.parameter.name
        ),
        None => Ok(()),
    }
}

/// How long subscribers are waited for.
const WAIT_LIMIT: Duration = Duration::from_secs(30);
/// Time between two looks at how many there are.
const WAIT_NAP: Duration = Duration::from_millis(20);
/// How long somebody is waited for without a word.
const WAIT_UNTOLD: Duration = Duration::from_secs(3);

/// Waits until a topic has `wanted` subscribers. `false` when a signal came first.
pub(crate) fn wait_for_subscribers(
    link: &Link,
    publisher: &dyn Publisher,
    wanted: usize,
    interrupt: &Interrupt,
) -> anyhow::Result<bool> {
    let clock = Clock::start();
    let mut told = false;
    while publisher.subscribers() < wanted {
        if interrupt.requested() {
            return Ok(false);
        }
        if clock.now() > WAIT_LIMIT {
            let found = publisher.subscribers();
            bail!("{link}: found {found} subscribers after 30 s, expected {wanted}");
        }
        if !told && clock.now() > WAIT_UNTOLD {
            told = true;
            let found = publisher.subscribers();
            tracing::warn!("{link}: waiting for {wanted} subscribers, {found} so far");
        }
        thread::sleep(WAIT_NAP);
    }
    Ok(true)
}

/// A progress bar with the time left; hidden without a terminal or when `quiet`.
pub(crate) fn progress_bar(length: u64, what: &str, quiet: bool) -> ProgressBar {
    let bar = if quiet {
        ProgressBar::with_draw_target(Some(length), ProgressDrawTarget::hidden())
    } else {
        ProgressBar::new(length)
    };
    let template = format!("{{bar:30}} {{pos}}/{{len}} {what}, {{eta}} left  {{wide_msg}}");
    bar.with_style(ProgressStyle::with_template(&template).unwrap_or(ProgressStyle::default_bar()))
}
