//! `eddy record`: topics into a bag, by [`eddy_node::record`].

use std::{
    collections::HashSet,
    mem,
    path::{Path, PathBuf},
    time::Duration,
};

use anyhow::{Context, bail, ensure};
use indicatif::{ProgressBar, ProgressDrawTarget};

use super::{checked_custom_data, counted, has_no_parameters, leaves_the_process};
use crate::cli::RecordArgs;
use eddy_bag::{
    BagSummary, BagWriter, Split, TopicFilter, WriterOptions, WrittenTopic,
    custom_data::{TOPICS_NOT_RECORDED, TOPICS_RECORDED_IN_PART},
};
use eddy_cli::{Interrupt, Output, OutputKind, unused};
use eddy_frames::{
    clock::{self, Clock},
    date::Utc,
};
use eddy_node::{
    Losses, RecordError, Recorder, RecordingOptions, TopicDiscovery, record,
    recorder::{Reasons, TopicOpener},
    ros::RosNode,
};
use eddy_settings::usage::Usage;
use eddy_transport::Transports;

/// Records until a limit, a failure or a signal, and closes the bag in each case.
pub fn run(
    mut args: RecordArgs,
    ros: &RosNode,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    has_no_parameters(ros)?;
    args.links.iter_mut().for_each(|link| *link = ros.link(link));
    check(&args)?;
    let custom_data = checked_custom_data(&args.custom_data)?;
    let transports = Transports::stopped_by(interrupt.shared(), ros.transport_options()?);
    let choice = TopicFilter {
        names: Vec::new(),
        regex: args.regex.clone(),
        exclude: args.exclude.clone(),
        all: args.all,
    };
    let is_search = !choice.is_empty();
    let discovery = discovery(&mut args, &transports, choice)?;
    let place = args.output.clone().unwrap_or_else(default_output);
    let room = Output::at(&place, OutputKind::Bag, args.force, &[])?;
    let mut bag = BagWriter::create(&place, writer_options(&args))?;
    bag.extend_custom_data(custom_data);
    let mut recorder = Recorder::new(bag, clock::wall());
    let clock = Clock::start();
    let line = live_line(quiet);
    println!("recording into {}", place.display());
    let options = RecordingOptions {
        cache_bytes: args.max_cache_size,
        max_messages: args.max_messages,
        stop_after: args.stop_after.map(Duration::from_secs_f64),
        interrupted: interrupt.flag(),
        on_topic: &|topic| println!("recording {} ({})", topic.link, topic.type_name),
        on_waiting: &|links| {
            for link in links {
                println!("waiting for {link}, which is not published yet");
            }
        },
        on_progress: &|messages, time| {
            line.set_message(format!("{messages} messages, {:.0} s", time.as_secs_f64()));
        },
    };
    let (outcome, losses) = record(&mut recorder, &discovery, &options);
    line.finish_and_clear();
    recorder.count_dropped(losses.total());
    let (not_recorded, in_part) = (discovery.not_recorded(), discovery.ended());
    note(&mut recorder, TOPICS_NOT_RECORDED, "not recorded", &not_recorded);
    note(&mut recorder, TOPICS_RECORDED_IN_PART, "recorded in part", &in_part);
    let bag = end(recorder, outcome, &losses, clock.now().as_secs_f64())?;
    room.replaced();
    let shown = bag.directory.display();
    let missing = missing(&bag, &not_recorded, &in_part);
    ensure!(missing.is_empty(), "{shown}: {}", missing.join(", "));
    let from: Vec<_> = args.from.iter().map(ToString::to_string).collect();
    ensure!(
        !is_search || !bag.topics.is_empty(),
        "{shown}: found no topic to record on {}; --from selects transports",
        from.join(", ")
    );
    Ok(())
}

/// Opens the given topics, and searches for those of `choice`.
fn discovery(
    args: &mut RecordArgs,
    transports: &Transports,
    choice: TopicFilter,
) -> anyhow::Result<TopicDiscovery> {
    let overrides = super::qos_overrides(args.qos_profile_overrides_path.as_deref())?;
    let opener =
        TopicOpener::new(transports.clone(), mem::take(&mut args.ament_prefix_path), overrides);
    let discovery = TopicDiscovery::new(opener, args.links.clone(), args.from.clone(), choice);
    discovery.open()?;
    Ok(discovery)
}

fn writer_options(args: &RecordArgs) -> WriterOptions {
    let split = Split {
        size: args.max_bag_size,
        duration: args.max_bag_duration.map(Duration::from_secs_f64),
    };
    WriterOptions { compression: args.compression, split, ..WriterOptions::default() }
}

/// How many topics the bag lacks, or has in part.
fn missing(bag: &BagSummary, not_recorded: &Reasons, in_part: &Reasons) -> Vec<String> {
    let undefined = bag.topics.iter().filter(|topic| !topic.has_definition()).count();
    let lacking = [
        (not_recorded.len(), "not recorded"),
        (in_part.len(), "recorded in part"),
        (undefined, "recorded without a definition"),
    ];
    let lacking = lacking.into_iter().filter(|(topics, _)| *topics > 0);
    lacking.map(|(topics, what)| format!("{} {what}", counted(topics as u64, "topic"))).collect()
}

/// A bag named after the time, as rosbag2 does.
fn default_output() -> PathBuf {
    unused(Path::new(&format!("eddy_{}", Utc::of(clock::wall()).file_name())))
}

/// Reports links that were not recorded, or not to the end, and notes them in the bag.
fn note(recorder: &mut Recorder, key: &str, what: &str, links: &Reasons) {
    if !links.is_empty() {
        recorder.set_custom_data(key, links.keys().cloned().collect::<Vec<_>>().join(" "));
    }
    for (link, reason) in links {
        println!("{what}: {link}: {reason}");
    }
}

fn check(args: &RecordArgs) -> anyhow::Result<()> {
    let mut topics = HashSet::new();
    if let Some(twice) = args.links.iter().find(|link| !topics.insert(&link.topic)) {
        let message = format!(
            "{twice}: found topic {} twice, expected each topic once in a bag",
            twice.topic
        );
        return Err(Usage::new(message).into());
    }
    args.links.iter().try_for_each(leaves_the_process)?;
    super::leave_the_process(&args.from)
}

/// Closes the bag and prints a summary.
fn end(
    recorder: Recorder,
    outcome: Result<(), RecordError>,
    losses: &Losses,
    seconds: f64,
) -> anyhow::Result<BagSummary> {
    let unfinished = recorder.bag().active_file().to_owned();
    let kept = || format!("recorded data stays in {}", unfinished.display());
    let failure = match outcome {
        // Nothing can be written after a failed write; earlier messages are in the file.
        Err(RecordError::Bag(error)) if !error.is_disk_full() => {
            return Err(error).with_context(kept);
        }
        Err(RecordError::Bag(error)) => Some(error.into()),
        Err(RecordError::Transport(error)) => {
            Some(anyhow::Error::from(error).context("the recording ended early"))
        }
        Ok(()) => None,
    };
    let bag = recorder.finish().with_context(kept)?;
    report(&bag, losses, seconds);
    match failure {
        None if bag.lost > 0 => bail!(disk_full(&bag, losses)),
        Some(failure) if bag.lost > 0 => Err(failure).context(disk_full(&bag, losses)),
        Some(failure) => Err(failure),
        None => Ok(bag),
    }
}

fn disk_full(bag: &BagSummary, losses: &Losses) -> String {
    format!(
        "disk full: the bag was closed with {} messages, {} more were lost",
        bag.messages,
        bag.lost + losses.unwritten
    )
}

fn report(bag: &BagSummary, losses: &Losses, seconds: f64) {
    for topic in &bag.topics {
        println!("{}: {} messages", topic.name, topic.messages);
    }
    let undefined = bag.topics.iter().filter(|topic| !topic.has_definition());
    for WrittenTopic { name, type_name, .. } in undefined {
        println!("no definition: {name} ({type_name})");
    }
    if losses.in_transport > 0 {
        println!("not recorded: {} messages dropped by the transport", losses.in_transport);
    }
    if losses.queue_full > 0 {
        println!("not recorded: {} messages dropped because the queue was full", losses.queue_full);
    }
    if losses.unwritten > 0 {
        println!("not recorded: {} messages still in the queue", losses.unwritten);
    }
    let files = match bag.files.len() {
        1 => String::new(),
        files => format!(" in {files} files"),
    };
    println!("{}: {} messages{files} in {seconds:.1} s", bag.directory.display(), bag.messages);
}

fn live_line(quiet: bool) -> ProgressBar {
    let line = ProgressBar::new_spinner();
    if quiet {
        line.set_draw_target(ProgressDrawTarget::hidden());
    }
    line
}
