//! `eddy topic list`

use std::{collections::BTreeSet, thread, time::Duration};

use super::NAP;
use crate::{
    cli::TopicListArgs,
    commands::{Interrupt, leaves_the_process},
};
use eddy::{
    clock::Clock,
    transport::{Link, Transports},
};

pub(super) fn run(
    args: &TopicListArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    for &transport in &args.from {
        leaves_the_process(&Link { transport, topic: "/".to_owned() })?;
    }
    let clock = Clock::start();
    let mut topics = BTreeSet::new();
    loop {
        for &transport in &args.from {
            topics.extend(transports.topics(transport)?);
        }
        if clock.now() >= Duration::from_secs_f64(args.wait) || interrupt.requested() {
            break;
        }
        thread::sleep(NAP);
    }
    let width = topics.iter().map(|topic| topic.link.to_string().len()).max().unwrap_or(0);
    for topic in topics {
        println!("{:width$}  {}", topic.link.to_string(), topic.type_name);
    }
    Ok(())
}
