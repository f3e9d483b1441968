//! `eddy topic list`

use std::{collections::BTreeSet, thread, time::Duration};

use super::print;
use crate::{
    cli::TopicListArgs,
    commands::{Interrupt, leaves_the_process},
    terminal::on_one_line,
};
use eddy_frames::clock::Clock;
use eddy_transport::{Link, SeenTopic, Transports};

/// Interval between searches.
const SEARCH_INTERVAL: Duration = Duration::from_millis(50);

pub(super) fn run(
    args: &TopicListArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    for &transport in &args.from {
        leaves_the_process(&Link { transport, topic: "/".to_owned() })?;
    }
    let mut topics = BTreeSet::new();
    let mut search = || -> anyhow::Result<()> {
        for &transport in &args.from {
            topics.extend(transports.topics(transport)?);
        }
        Ok(())
    };
    // Before the clock starts: opening a transport takes time.
    search()?;
    let clock = Clock::start();
    loop {
        search()?;
        if clock.now() >= Duration::from_secs_f64(args.wait) || interrupt.requested() {
            break;
        }
        thread::sleep(SEARCH_INTERVAL);
    }
    if topics.is_empty() {
        let transports: Vec<_> = args.from.iter().map(ToString::to_string).collect();
        let transports = transports.join(", ");
        tracing::warn!(
            "no topics on {transports} within {} s; --from selects transports",
            args.wait
        );
    }
    let link = |topic: &SeenTopic| on_one_line(&topic.link.to_string()).into_owned();
    let width = topics.iter().map(|topic| link(topic).chars().count()).max().unwrap_or(0);
    for topic in &topics {
        let type_name = on_one_line(&topic.type_name);
        if !print(&format!("{:width$}  {type_name}", link(topic))) {
            break;
        }
    }
    Ok(())
}
