//! `eddy topic hz`

use std::time::Duration;

use anyhow::Context;

use super::{MAX_WAIT, find, print};
use crate::cli::TopicHzArgs;
use eddy_cli::Interrupt;
use eddy_frames::clock::Clock;
use eddy_node::topics::{MAX_FIND_TIME, Rate};
use eddy_transport::Transports;

/// Interval between two reports.
const REPORT_INTERVAL: Duration = Duration::from_secs(1);

pub(super) fn run(
    args: &TopicHzArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let clock = Clock::start();
    let end = args.duration.map(Duration::from_secs_f64);
    let timeout = end.unwrap_or(MAX_FIND_TIME).min(MAX_FIND_TIME);
    let Some(topic) = find(&args.link, transports, timeout, interrupt)? else { return Ok(()) };
    let mut subscriber = transports
        .subscriber(&topic.link, &topic.type_support())
        .with_context(|| format!("cannot subscribe to {}", topic.link))?;
    let (mut rate, mut reported, mut has_new) = (Rate::new(args.window), clock.now(), false);
    loop {
        if subscriber.receive(MAX_WAIT)?.is_some() {
            rate.arrived(clock.now());
            has_new = true;
        }
        let ends = interrupt.requested() || end.is_some_and(|end| clock.now() >= end);
        if ends || clock.now() - reported >= REPORT_INTERVAL {
            reported = clock.now();
            let statistics = rate.statistics().filter(|_| std::mem::take(&mut has_new));
            let line = statistics.map_or("no new messages".to_owned(), |s| s.to_string());
            if !print(&line) || ends {
                return Ok(());
            }
        }
    }
}
