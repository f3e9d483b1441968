//! `eddy topic echo`

use std::{
    sync::atomic::{AtomicBool, Ordering},
    thread,
    time::Duration,
};

use anyhow::Context;

use super::{PATIENCE, find, print};
use crate::{cli::TopicEchoArgs, commands::Interrupt};
use eddy_messages::{
    Clock, DiagnosticArray, Message, ParameterEvent, ParticleFrame, PointCloud2, PredictionStatus,
    RosString, cdr,
};
use eddy_node::FrameQueue;
use eddy_transport::{Payload, Reliability, Subscriber, TransportError, Transports};

/// Messages that wait to be printed; of more the oldest go.
const WAITING: usize = 64;

pub(super) fn run(
    args: &TopicEchoArgs,
    transports: &Transports,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let Some(topic) = find(&args.link, transports, interrupt)? else { return Ok(()) };
    let mut subscriber = transports
        .subscriber_of(&topic.link, &topic.type_support())
        .with_context(|| format!("cannot subscribe to {}", topic.link))?;
    let (queue, stop) = (FrameQueue::new(WAITING, Reliability::Drop), AtomicBool::new(false));
    thread::scope(|scope| {
        // A slow terminal must not hold back who publishes.
        let receiver = scope.spawn(|| receive(subscriber.as_mut(), &queue, &stop));
        let mut left = args.count.map(std::num::NonZeroUsize::get);
        let mut printed = Ok(true);
        while matches!(printed, Ok(true)) && left != Some(0) {
            if interrupt.requested() || receiver.is_finished() {
                break;
            }
            if let Some((_, payload)) = queue.pop(PATIENCE) {
                let text = text(&topic.type_name, payload, args.truncate);
                printed = text.and_then(|text| Ok(print(&format!("{text}---"))?));
                left = left.map(|left| left - 1);
            }
        }
        stop.store(true, Ordering::Relaxed);
        match receiver.join() {
            Ok(outcome) => outcome?,
            Err(panic) => std::panic::resume_unwind(panic),
        }
        printed.map(|_| ())
    })
}

fn receive(
    subscriber: &mut dyn Subscriber,
    queue: &FrameQueue,
    stop: &AtomicBool,
) -> Result<(), TransportError> {
    while !stop.load(Ordering::Relaxed) {
        if let Some(payload) = subscriber.receive(PATIENCE)? {
            queue.push(Duration::ZERO, payload);
        }
    }
    Ok(())
}

/// A message as YAML; of types that are not known here only the size.
fn text(type_name: &str, payload: Payload, truncate: usize) -> anyhow::Result<String> {
    let bytes = payload.into_cdr();
    let yaml = match type_name {
        ParticleFrame::TYPE => yaml::<ParticleFrame>(&bytes),
        PredictionStatus::TYPE => yaml::<PredictionStatus>(&bytes),
        DiagnosticArray::TYPE => yaml::<DiagnosticArray>(&bytes),
        Clock::TYPE => yaml::<Clock>(&bytes),
        ParameterEvent::TYPE => yaml::<ParameterEvent>(&bytes),
        PointCloud2::TYPE => yaml::<PointCloud2>(&bytes),
        RosString::TYPE => yaml::<RosString>(&bytes),
        _ => return Ok(format!("# {} bytes of {type_name}\n", bytes.len())),
    };
    Ok(match yaml {
        Ok(yaml) => shorten(&yaml, truncate),
        Err(error) => format!("# no {type_name}: {error}\n"),
    })
}

fn yaml<M: Message>(bytes: &[u8]) -> anyhow::Result<String> {
    Ok(serde_saphyr::to_string(&cdr::decode::<M>(bytes)?)?)
}

/// Leaves so many of the numbers or words of each list, and says how many there were; all with 0.
fn shorten(yaml: &str, most: usize) -> String {
    let mut text = String::new();
    let (mut count, mut indent) = (0, "");
    for line in yaml.lines().chain([""]) {
        let bare = line.trim_start();
        let is_item = bare
            .strip_prefix("- ")
            .is_some_and(|item| !item.contains(": ") && !item.ends_with(':'));
        if is_item {
            count += 1;
            indent = &line[..line.len() - bare.len()];
        } else {
            if most > 0 && count > most {
                text.push_str(&format!("{indent}- ... of {count}\n"));
            }
            count = 0;
        }
        if !line.is_empty() && (!is_item || most == 0 || count <= most) {
            text.push_str(line);
            text.push('\n');
        }
    }
    text
}
