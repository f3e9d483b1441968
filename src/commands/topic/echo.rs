//! `eddy topic echo`

use std::{
    num::NonZeroUsize,
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use anyhow::Context;

use super::{MAX_WAIT, find, print};
use crate::cli::TopicEchoArgs;
use eddy_bag::QosOverrides;
use eddy_cli::Interrupt;
use eddy_node::{
    FrameQueue,
    recorder::{OpenTopic, TopicOpener},
    topics::{MAX_FIND_TIME, message_text},
};
use eddy_transport::{Reliability, Subscriber, TransportError, Transports};

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
    let link = topic.link.clone();
    // Definitions are found as for a recording.
    let opener =
        TopicOpener::new(transports.clone(), args.ament_prefix_path.clone(), QosOverrides::new());
    let OpenTopic { topic, mut subscriber } =
        opener.open(topic).with_context(|| format!("cannot subscribe to {link}"))?;
    // Messages wait in the queue of the subscriber.
    let support = opener.type_of(&topic, interrupt.flag());
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
