//! `eddy topic hz`

use std::time::Duration;

use anyhow::Context;

use super::{PATIENCE, find, print};
use crate::{cli::TopicHzArgs, commands::Interrupt};
use eddy_frames::clock::Clock;
use eddy_node::Rate;
use eddy_transport::Transports;

/// Between two lines.
const INTERVAL: Duration = Duration::from_secs(1);

pub(super) fn run(
    args: &TopicHzArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let Some(topic) = find(&args.link, transports, interrupt)? else { return Ok(()) };
    let mut subscriber = transports
        .subscriber_of(&topic.link, &topic.type_support())
        .with_context(|| format!("cannot subscribe to {}", topic.link))?;
    let clock = Clock::start();
    let end = args.duration.map(Duration::from_secs_f64);
    let (mut rate, mut told, mut news) = (Rate::new(args.window), Duration::ZERO, false);
    loop {
        if subscriber.receive(PATIENCE)?.is_some() {
            rate.arrived(clock.now());
            news = true;
        }
        let ends = interrupt.requested() || end.is_some_and(|end| clock.now() >= end);
        if ends || clock.now() - told >= INTERVAL {
            told = clock.now();
            let figures = rate.figures().filter(|_| std::mem::take(&mut news));
            let line = figures.map_or("no new messages".to_owned(), |figures| figures.to_string());
            if !print(&line)? || ends {
                return Ok(());
            }
        }
    }
}
