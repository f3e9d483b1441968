//! `eddy record`: topics into a bag.

use std::{
    collections::HashSet,
    sync::{
        atomic::{AtomicBool, Ordering},
        mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

use anyhow::{Context, bail, ensure};
use indicatif::{ProgressBar, ProgressDrawTarget};

use super::{Interrupt, leaves_the_process};
use crate::cli::{CompressionArg, RecordArgs};
use eddy::{
    bag::{BagError, BagSummary, BagWriter, Compression, TopicId, WriterOptions},
    clock::{self, Clock},
    frame::Stamp,
    msg::topic_type,
    node::Recorder,
    transport::{Payload, Subscriber, TransportError, TransportOptions, Transports},
};

/// Messages that wait to be written; when so many wait, the receivers wait.
const QUEUE: usize = 256;
/// How long a wait may last before the end of the recording is looked for.
const PATIENCE: Duration = Duration::from_millis(100);
/// How long messages that had arrived at the end are still taken, from a publisher that goes on.
const LAST_ARRIVALS: Duration = Duration::from_secs(1);

/// What a receiver hands over.
enum Received {
    Message(TopicId, Payload, Stamp),
    Failed(TransportError),
}

/// Records until a limit, a failure or a signal; closes the bag in each case.
pub fn run(args: RecordArgs, quiet: bool, interrupt: &Interrupt) -> anyhow::Result<()> {
    let mut topics = HashSet::new();
    if let Some(twice) = args.links.iter().find(|link| !topics.insert(&link.topic)) {
        bail!("{twice}: found topic {} twice, expected each topic once in a bag", twice.topic);
    }
    args.links.iter().try_for_each(leaves_the_process)?;
    ensure!(
        args.max_duration.is_none_or(|seconds| seconds.is_finite() && seconds > 0.0),
        "--max-duration: found {}, expected a positive number of seconds",
        args.max_duration.unwrap_or_default()
    );
    let transports = Transports::new(TransportOptions::from_env("eddy_record")?);
    let subscribers = args
        .links
        .iter()
        .map(|link| transports.subscriber(link, topic_type(&link.topic)))
        .collect::<Result<Vec<_>, _>>()?;
    let options =
        WriterOptions { compression: compression(args.compression), ..Default::default() };
    let mut recorder = Recorder::new(BagWriter::create(&args.output, options)?, clock::wall());
    let mut inputs = Vec::new();
    for (link, subscriber) in args.links.iter().zip(subscribers) {
        let type_name = topic_type(&link.topic);
        inputs.push((recorder.topic(&link.topic, type_name)?, subscriber));
        println!("recording {link} ({type_name}) into {}", args.output.display());
    }
    let unfinished = recorder.bag().active_file().to_owned();
    let clock = Clock::start();
    let (outcome, refused) = record(&mut recorder, inputs, &args, &clock, quiet, interrupt);
    let seconds = clock.now().as_secs_f64();
    let kept = || format!("what was written stays in {}", unfinished.display());
    let written = match &outcome {
        // Nothing can follow a failed write; what came before it is in the file.
        Err(Failure::Bag(_)) => None,
        _ => Some(recorder.finish().with_context(kept)?),
    };
    if let Some(bag) = &written {
        report(bag, seconds, refused);
    }
    match outcome {
        Ok(()) => Ok(()),
        Err(Failure::Bag(error)) => Err(error).with_context(kept),
        Err(Failure::Transport(error)) => Err(error).context("the recording ended early"),
    }
}

/// Why a recording ended that should have gone on.
enum Failure {
    Bag(BagError),
    Transport(TransportError),
}

/// Writes what the subscribers receive. Gives the outcome, and how many messages the transports
/// could not deliver.
fn record(
    recorder: &mut Recorder,
    inputs: Vec<(TopicId, Box<dyn Subscriber>)>,
    args: &RecordArgs,
    clock: &Clock,
    quiet: bool,
    interrupt: &Interrupt,
) -> (Result<(), Failure>, u64) {
    let stop = AtomicBool::new(false);
    let (sender, receiver) = sync_channel(QUEUE);
    thread::scope(|scope| {
        let receivers: Vec<_> = inputs
            .into_iter()
            .map(|(topic, subscriber)| {
                let (sender, stop) = (sender.clone(), &stop);
                scope.spawn(move || receive(topic, subscriber, &sender, stop))
            })
            .collect();
        drop(sender);
        let outcome = write(recorder, receiver, args, clock, quiet, interrupt, &stop);
        stop.store(true, Ordering::Relaxed);
        let refused = receivers.into_iter().map(|receiver| match receiver.join() {
            Ok(refused) => refused,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        (outcome, refused.sum())
    })
}

/// Hands over what a subscriber receives, at the end also what had arrived by then. Gives how many
/// messages it could not deliver.
fn receive(
    topic: TopicId,
    mut subscriber: Box<dyn Subscriber>,
    sender: &SyncSender<Received>,
    stop: &AtomicBool,
) -> u64 {
    let mut stopped: Option<Clock> = None;
    loop {
        if stopped.is_none() && stop.load(Ordering::Relaxed) {
            stopped = Some(Clock::start());
        }
        if stopped.is_some_and(|clock| clock.now() > LAST_ARRIVALS) {
            break;
        }
        let received = match subscriber.receive(stopped.map_or(PATIENCE, |_| Duration::ZERO)) {
            Ok(None) if stopped.is_some() => break,
            Ok(None) => continue,
            Ok(Some(payload)) => Received::Message(topic, payload, clock::wall()),
            Err(error) => Received::Failed(error),
        };
        let failed = matches!(received, Received::Failed(_));
        if sender.send(received).is_err() || failed {
            break;
        }
    }
    subscriber.refused()
}

/// The writing loop. Raises `stop` when the recording is to end, then writes what has arrived.
fn write(
    recorder: &mut Recorder,
    receiver: Receiver<Received>,
    args: &RecordArgs,
    clock: &Clock,
    quiet: bool,
    interrupt: &Interrupt,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let line = live_line(quiet);
    let limit = args.max_messages.unwrap_or(u64::MAX);
    let mut failure = None;
    loop {
        let timed_out = args.max_duration.is_some_and(|s| clock.now().as_secs_f64() >= s);
        if timed_out || interrupt.requested() || failure.is_some() {
            stop.store(true, Ordering::Relaxed);
        }
        match receiver.recv_timeout(PATIENCE) {
            Ok(Received::Message(topic, payload, arrived)) => {
                recorder.on_message(topic, payload, arrived).map_err(Failure::Bag)?;
            }
            Ok(Received::Failed(error)) => failure = Some(Failure::Transport(error)),
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => break,
        }
        recorder.on_tick(clock::wall()).map_err(Failure::Bag)?;
        let messages = recorder.bag().messages();
        line.set_message(format!("{messages} messages, {:.0} s", clock.now().as_secs_f64()));
        if messages >= limit {
            break;
        }
    }
    line.finish_and_clear();
    failure.map_or(Ok(()), Err)
}

fn live_line(quiet: bool) -> ProgressBar {
    let line = ProgressBar::new_spinner();
    if quiet {
        line.set_draw_target(ProgressDrawTarget::hidden());
    }
    line
}

fn report(bag: &BagSummary, seconds: f64, refused: u64) {
    for topic in &bag.topics {
        println!("{}: {} messages", topic.name, topic.messages);
    }
    if refused > 0 {
        println!("not recorded: {refused} messages that were no frames");
    }
    println!("{}: {} messages in {seconds:.1} s", bag.directory.display(), bag.messages);
}

fn compression(arg: CompressionArg) -> Compression {
    match arg {
        CompressionArg::None => Compression::None,
        CompressionArg::Lz4 => Compression::Lz4,
        CompressionArg::Zstd => Compression::Zstd,
    }
}
