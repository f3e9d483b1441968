//! `eddy topic echo`

use std::{
    num::NonZeroUsize,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use anyhow::Context;

use super::{MAX_WAIT, find, print};
use crate::{cli::TopicEchoArgs, commands::Interrupt};
use eddy_node::{
    FrameQueue,
    topics::{MAX_FIND_TIME, message_text},
};
use eddy_transport::{Reliability, Subscriber, TransportError, Transports};

/// How long the publisher of a type may take to tell its definition.
const DESCRIPTION_TIMEOUT: Duration = Duration::from_secs(2);
/// Maximum number of messages waiting to be printed; the oldest are dropped.
const QUEUE_MESSAGES: usize = 64;

pub(super) fn run(
    args: &TopicEchoArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let Some(topic) = find(&args.link, transports, MAX_FIND_TIME, interrupt)? else {
        return Ok(());
    };
    let known = topic.type_support();
    let mut subscriber = transports
        .subscriber_of(&topic.link, &known)
        .with_context(|| format!("cannot subscribe to {}", topic.link))?;
    // A type that is not built in is asked for.
    let described = match known.schema.is_empty() {
        true => transports.described_type(&topic, DESCRIPTION_TIMEOUT)?,
        false => None,
    };
    let support = described.unwrap_or(known);
    let queue = FrameQueue::new(QUEUE_MESSAGES, Reliability::Drop);
    let stop = AtomicBool::new(false);
    thread::scope(|scope| {
        // On a thread of its own: a slow terminal must not block the publisher.
        let receiver = scope.spawn(|| receive(subscriber.as_mut(), &queue, &stop));
        let mut left = if args.once { Some(1) } else { args.count.map(NonZeroUsize::get) };
        let mut is_read = true;
        while is_read && left != Some(0) {
            if interrupt.requested() || receiver.is_finished() {
                break;
            }
            if let Some((_, payload)) = queue.pop(MAX_WAIT) {
                let text = message_text(&support, &payload.into_cdr(), args.truncate);
                is_read = print(&format!("{text}---"));
                left = left.map(|left| left - 1);
            }
        }
        stop.store(true, Ordering::Relaxed);
        match receiver.join() {
            Ok(outcome) => outcome?,
            Err(panic) => std::panic::resume_unwind(panic),
        }
        Ok(())
    })
}

fn receive(
    subscriber: &mut dyn Subscriber,
    queue: &FrameQueue,
    stop: &AtomicBool,
) -> Result<(), TransportError> {
    while !stop.load(Ordering::Relaxed) {
        if let Some(payload) = subscriber.receive(MAX_WAIT)? {
            queue.push(Duration::ZERO, payload);
        }
    }
    Ok(())
}
