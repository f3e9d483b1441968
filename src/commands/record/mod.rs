//! `eddy record`: topics into a bag.
//!
//! 1. [`discover`]: which topics there are, now and later.
//! 2. [`intake`]: what arrives, into a queue of bounded size; what had to be given up is counted.
//! 3. Here: out of the queue into the bag.

mod discover;
mod intake;

use std::{
    collections::HashSet,
    sync::{
        Mutex,
        atomic::{AtomicBool, Ordering},
    },
    thread,
    time::Duration,
};

use anyhow::{Context, bail, ensure};
use indicatif::{ProgressBar, ProgressDrawTarget};

use super::{Interrupt, has_no_parameters, leaves_the_process, transport_options};
use crate::cli::RecordArgs;
use discover::{Found, Reasons, Search};
use eddy::{
    bag::{BagError, BagSummary, BagWriter, Split, TopicChoice, WriterOptions},
    clock::{self, Clock},
    msg::topic_type,
    node::{Cache, Recorder, Taken},
    ros::RosNode,
    transport::{SeenTopic, Subscriber, TransportError, Transports},
};
use intake::{Losses, Received, receive};

/// How long a wait may last before the end of the recording is looked for.
const PATIENCE: Duration = Duration::from_millis(100);

/// Key in `custom_data` of `metadata.yaml`: topics that were found and could not be recorded.
const TOPICS_NOT_RECORDED: &str = "eddy_topics_not_recorded";
/// The same for topics that could be recorded for a part of the time only.
const TOPICS_RECORDED_IN_PART: &str = "eddy_topics_recorded_in_part";

/// Records until a limit, a failure or a signal; closes the bag in each case.
pub fn run(
    mut args: RecordArgs,
    ros: &RosNode,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    has_no_parameters(ros)?;
    // What a topic carries its own name says, not the one it is given.
    let types: Vec<_> = args.links.iter().map(|link| topic_type(&link.topic).to_owned()).collect();
    args.links.iter_mut().for_each(|link| *link = ros.link(link));
    check(&args)?;
    let transports = Transports::new(transport_options(ros)?);
    let known = args.links.iter().map(|link| link.topic.clone()).collect();
    let search = Search {
        transports: transports.clone(),
        from: args.from.clone(),
        found: Mutex::new(Found::knowing(known)),
        choice: TopicChoice {
            names: Vec::new(),
            regex: args.regex.clone(),
            exclude: args.exclude.clone(),
            all: args.all,
        },
    };
    let mut inputs = Vec::new();
    for (link, type_name) in args.links.iter().zip(types) {
        let topic = SeenTopic { link: link.clone(), type_name, hash: None, kept: 0 };
        let subscriber = transports.subscriber_of(link, &topic.type_support())?;
        inputs.push(Received::Opened(topic, subscriber));
    }
    let split = Split {
        size: args.max_bag_size,
        duration: args.max_bag_duration.map(Duration::from_secs_f64),
    };
    let compression = args.compression.into();
    let options = WriterOptions { compression, split, ..WriterOptions::default() };
    let mut recorder = Recorder::new(BagWriter::create(&args.output, options)?, clock::wall());
    let clock = Clock::start();
    let terms = Terms { args: &args, clock: &clock, quiet, interrupt };
    let (outcome, losses) = record(&mut recorder, inputs, &search, &terms);
    recorder.note_not_given(losses.total());
    let failed = search.failed().into_values().flatten().collect();
    note(&mut recorder, TOPICS_NOT_RECORDED, "not recorded", &failed);
    note(&mut recorder, TOPICS_RECORDED_IN_PART, "recorded in part", &search.ended());
    end(recorder, outcome, &losses, clock.now().as_secs_f64())
}

/// Says of links what was not recorded from them and why, here and in the bag.
fn note(recorder: &mut Recorder, key: &str, what: &str, links: &Reasons) {
    if !links.is_empty() {
        recorder.note(key, links.keys().cloned().collect::<Vec<_>>().join(" "));
    }
    for (link, reason) in links {
        println!("{what}: {link}: {reason}");
    }
}

fn check(args: &RecordArgs) -> anyhow::Result<()> {
    let mut topics = HashSet::new();
    if let Some(twice) = args.links.iter().find(|link| !topics.insert(&link.topic)) {
        bail!("{twice}: found topic {} twice, expected each topic once in a bag", twice.topic);
    }
    args.links.iter().try_for_each(leaves_the_process)?;
    for (option, seconds) in
        [("--stop-after", args.stop_after), ("--max-bag-duration", args.max_bag_duration)]
    {
        ensure!(
            seconds.is_none_or(|seconds| Duration::try_from_secs_f64(seconds).is_ok() && seconds > 0.0),
            "{option}: found {}, expected a positive number of seconds",
            seconds.unwrap_or_default()
        );
    }
    Ok(())
}

/// Why a recording ended that should have gone on.
enum Failure {
    Bag(BagError),
    Transport(TransportError),
}

/// Closes the bag and says what is in it.
fn end(
    recorder: Recorder,
    outcome: Result<(), Failure>,
    losses: &Losses,
    seconds: f64,
) -> anyhow::Result<()> {
    let unfinished = recorder.bag().active_file().to_owned();
    let kept = || format!("what was written stays in {}", unfinished.display());
    let failure = match outcome {
        // Nothing can follow a failed write; what came before it is in the file.
        Err(Failure::Bag(error)) if !error.is_no_room() => return Err(error).with_context(kept),
        Err(Failure::Bag(error)) => Some(error.into()),
        Err(Failure::Transport(error)) => {
            Some(anyhow::Error::from(error).context("the recording ended early"))
        }
        Ok(()) => None,
    };
    let bag = recorder.finish().with_context(kept)?;
    report(&bag, losses, seconds);
    match failure {
        None if bag.lost > 0 => bail!(no_room(&bag, losses)),
        Some(failure) if bag.lost > 0 => Err(failure).context(no_room(&bag, losses)),
        Some(failure) => Err(failure),
        None => Ok(()),
    }
}

fn no_room(bag: &BagSummary, losses: &Losses) -> String {
    format!(
        "no room was left: the bag is closed with {} messages, {} more were lost",
        bag.messages,
        bag.lost + losses.unwritten
    )
}

fn report(bag: &BagSummary, losses: &Losses, seconds: f64) {
    for topic in &bag.topics {
        println!("{}: {} messages", topic.name, topic.messages);
    }
    if losses.refused > 0 {
        println!("not recorded: {} messages that the transport gave up", losses.refused);
    }
    if losses.no_room > 0 {
        println!("not recorded: {} messages that found no room in the queue", losses.no_room);
    }
    if losses.unwritten > 0 {
        println!("not recorded: {} messages that waited in the queue at the end", losses.unwritten);
    }
    let files = match bag.files.len() {
        1 => String::new(),
        files => format!(" in {files} files"),
    };
    println!("{}: {} messages{files} in {seconds:.1} s", bag.directory.display(), bag.messages);
}

/// Writes what the subscribers receive. Gives the outcome, and what is not in the bag.
fn record(
    recorder: &mut Recorder,
    inputs: Vec<Received>,
    search: &Search,
    terms: &Terms<'_>,
) -> (Result<(), Failure>, Losses) {
    let args = terms.args;
    let stop = AtomicBool::new(false);
    let cache = Cache::new(args.max_cache_size);
    thread::scope(|scope| {
        let (stop, mut receivers) = (&stop, Vec::new());
        let mut open = |recorder: &mut Recorder, topic: SeenTopic, subscriber| {
            let id = recorder.topic_of(&topic.link.topic, &topic.type_support(), topic.kept)?;
            let (link, output) = (&topic.link, args.output.display());
            println!("recording {link} ({}) into {output}", topic.type_name);
            let producer = cache.producer();
            let link = topic.link;
            receivers.push(scope.spawn(move || receive(&link, id, subscriber, &producer, stop)));
            Ok(())
        };
        let mut begun = Ok(());
        for input in inputs {
            if let (Received::Opened(topic, subscriber), true) = (input, begun.is_ok()) {
                begun = open(recorder, topic, subscriber);
            }
        }
        if !search.choice.is_empty() {
            let producer = cache.producer();
            scope.spawn(move || search.run(&producer, stop));
        }
        let outcome = begun.and_then(|()| write(recorder, &cache, &mut open, search, terms, stop));
        stop.store(true, Ordering::Relaxed);
        let waited = cache.close().into_iter();
        let waited = waited.filter(|item| matches!(item, Received::Message(..))).count() as u64;
        let losses = receivers.into_iter().map(|receiver| match receiver.join() {
            Ok(losses) => losses,
            Err(panic) => std::panic::resume_unwind(panic),
        });
        let mut losses: Losses = losses.sum();
        losses.unwritten += waited;
        if outcome.is_ok() {
            // What came after the last message that was wanted is no loss.
            losses.unwritten = 0;
        }
        (outcome, losses)
    })
}

/// When a recording ends, and who looks on.
struct Terms<'a> {
    args: &'a RecordArgs,
    clock: &'a Clock,
    quiet: bool,
    interrupt: &'a Interrupt,
}

/// Begins to record a topic.
type Open<'a> =
    dyn FnMut(&mut Recorder, SeenTopic, Box<dyn Subscriber>) -> Result<(), Failure> + 'a;

/// The writing loop. Raises `stop` when the recording is to end, then writes what has arrived.
fn write(
    recorder: &mut Recorder,
    cache: &Cache<Received>,
    open: &mut Open<'_>,
    search: &Search,
    terms: &Terms<'_>,
    stop: &AtomicBool,
) -> Result<(), Failure> {
    let Terms { args, clock, quiet, interrupt } = *terms;
    let line = live_line(quiet);
    let limit = args.max_messages.unwrap_or(u64::MAX);
    let mut failure = None;
    loop {
        let timed_out = args.stop_after.is_some_and(|s| clock.now().as_secs_f64() >= s);
        if timed_out || interrupt.requested() || failure.is_some() {
            stop.store(true, Ordering::Relaxed);
        }
        match cache.take(PATIENCE) {
            Taken::Item(Received::Message(topic, payload, arrived)) => {
                recorder.on_message(topic, payload, arrived).map_err(Failure::Bag)?;
            }
            Taken::Item(Received::Opened(topic, subscriber)) => {
                let link = topic.link.clone();
                match open(recorder, topic, subscriber) {
                    Err(Failure::Bag(error @ BagError::TopicType { .. })) => {
                        search.fails(&link, &error);
                    }
                    opened => opened?,
                }
            }
            // Who asks for a topic by its link wants it; of all topics those that can be had.
            Taken::Item(Received::Failed(link, error)) if !args.links.contains(&link) => {
                search.ends(&link, &error);
            }
            Taken::Item(Received::Failed(_, error)) => failure = Some(Failure::Transport(error)),
            Taken::Nothing => {}
            Taken::Ended => break,
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

impl From<BagError> for Failure {
    fn from(error: BagError) -> Self {
        Self::Bag(error)
    }
}
