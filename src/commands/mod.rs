//! One file per subcommand: connects parts of the library, adds context to errors, prints.

pub mod bag;
pub mod calibrate;
pub mod completions;
pub mod demo;
pub mod devices;
pub mod eval;
pub mod launch;
pub mod node;
pub mod param;
pub mod predict;
pub mod record;
pub mod replay;
pub mod service;
pub mod simulate;
pub mod tools;
pub mod topic;
pub mod train;

mod keyboard;
mod search;
mod streams;
mod surrogate;

pub(crate) use eddy_frames::counted;

use std::{collections::BTreeSet, path::Path, thread, time::Duration};

use anyhow::{Context as _, bail};
use eddy_bag::{
    QosOverrides,
    custom_data::{CustomData, check_entry},
    read_qos_overrides,
};
use eddy_cli::{Interrupt, terminal};
use eddy_frames::clock::Clock;
use eddy_messages::{Log, Message as _};
use eddy_node::{
    ros::{ROSOUT, ROSOUT_QOS, RosNode, Rosout, RosoutPublisher},
    viewer::LivePage,
};
use eddy_settings::usage::Usage;
use eddy_transport::{Link, Publisher, PublisherOptions, Reliability, TransportKind, Transports};

/// Rejects links that no other process can use.
pub(crate) fn leaves_the_process(link: &Link) -> anyhow::Result<()> {
    Ok(link.leaves_the_process().map_err(Usage::new)?)
}

/// Rejects transports that no other process can use.
pub(crate) fn leave_the_process(transports: &[TransportKind]) -> anyhow::Result<()> {
    let link = |&transport: &TransportKind| Link { transport, topic: "/".to_owned() };
    transports.iter().map(link).try_for_each(|link| leaves_the_process(&link))
}

/// Rejects parameters given to this node, other than those of every node of ROS 2: only `eddy node` has parameters.
pub(crate) fn has_no_parameters(ros: &RosNode) -> anyhow::Result<()> {
    match ros.parameters().iter().find(|given| !given.for_all && !given.is_of_every_node()) {
        Some(given) => bail!(
            "{}: found {}, expected none: this node has no parameters",
            given.argument,
            given.parameter.name
        ),
        None => Ok(()),
    }
}

/// The QoS profiles of `--qos-profile-overrides-path`.
pub(crate) fn qos_overrides(file: Option<&Path>) -> anyhow::Result<QosOverrides> {
    let overrides = file.map(read_qos_overrides).transpose();
    Ok(overrides.context("--qos-profile-overrides-path")?.unwrap_or_default())
}

/// The entries for `custom_data` in `metadata.yaml` that a command was given.
pub(crate) fn checked_custom_data(given: &[(String, String)]) -> anyhow::Result<CustomData> {
    let mut entries = CustomData::new();
    for (key, value) in given {
        let wrong = |expected| {
            Usage::new(format!("--custom-data: found {key}={value}, expected {expected}"))
        };
        check_entry(key, value).map_err(wrong)?;
        if entries.insert(key.clone(), value.clone()).is_some() {
            return Err(wrong("each key once").into());
        }
    }
    Ok(entries)
}

/// Publishes the log of a node on `/rosout` of each transport that ROS uses.
pub(crate) fn publish_log(
    rosout: Option<&Rosout>,
    transports: &Transports,
    ros: &RosNode,
    on: impl IntoIterator<Item = TransportKind>,
) -> anyhow::Result<Option<RosoutPublisher>> {
    let Some(rosout) = rosout else { return Ok(None) };
    let on: BTreeSet<_> = on.into_iter().filter(|transport| transport.is_of_ros()).collect();
    let open = |transport| -> anyhow::Result<_> {
        let link = Link { transport, topic: ros.topic(ROSOUT) };
        let options = PublisherOptions { reliability: Reliability::Drop, qos: Some(ROSOUT_QOS) };
        Ok(transports.publisher(&link, Log::TYPE, options)?)
    };
    let publishers = on.into_iter().map(open).collect::<Result<Vec<_>, _>>()?;
    Ok((!publishers.is_empty()).then(|| rosout.publish(publishers)).transpose()?)
}

/// How long to wait for subscribers.
const MAX_SUBSCRIBER_WAIT: Duration = Duration::from_secs(30);
/// Interval between checks of their number.
pub(crate) const POLL_INTERVAL: Duration = Duration::from_millis(20);
/// Delay before a "waiting for subscribers" warning.
const WARNING_DELAY: Duration = Duration::from_secs(3);

/// Waits until a topic has `wanted` subscribers. Returns `false` when a signal came first.
pub(crate) fn wait_for_subscribers(
    link: &Link,
    publisher: &dyn Publisher,
    wanted: usize,
    interrupt: &Interrupt,
) -> anyhow::Result<bool> {
    let clock = Clock::start();
    let mut warned = false;
    while publisher.subscribers() < wanted {
        if interrupt.requested() {
            return Ok(false);
        }
        if clock.now() > MAX_SUBSCRIBER_WAIT {
            let found = publisher.subscribers();
            bail!("{link}: found {found} subscribers after 30 s, expected {wanted}");
        }
        if !warned && clock.now() > WARNING_DELAY {
            warned = true;
            let found = publisher.subscribers();
            tracing::warn!("{link}: waiting for {wanted} subscribers, {found} so far");
        }
        thread::sleep(POLL_INTERVAL);
    }
    Ok(true)
}

/// Prints the URL of a live page.
pub(crate) fn announce_page(page: &LivePage) {
    println!("page:   {}", page.announcement());
    // A program that starts this one may wait for the line.
    terminal::flush();
}
