//! `eddy replay`: a bag onto topics, at its recorded pace, by the player in [`eddy_node::player`].

use std::{
    io::{IsTerminal as _, stdout},
    time::Duration,
};

use anyhow::{Context as _, bail, ensure};
use indicatif::{HumanCount, HumanDuration};

use super::{
    counted, has_no_parameters, keyboard::Keyboard, leaves_the_process, publish_log,
    wait_for_subscribers,
};
use crate::cli::ReplayArgs;
use eddy_bag::{BagMessage, BagReader};
use eddy_cli::{Interrupt, terminal};
use eddy_frames::{Stamp, clock::Clock};
use eddy_inference::{checkpoint::Checkpoint, engine::Stated};
use eddy_messages::{Message as _, ParticleFrame};
use eddy_node::{
    PendingCommand, PlaybackSink, Player, PlayerOptions, play,
    player::{
        LongPause, OutputOptions, PlannedTopic, PlaybackPlan, PlaybackStatus, PlayerServices,
        TopicOutputs, parse_keys,
    },
    ros::{RosNode, Rosout},
    viewer::BagView,
};
use eddy_transport::{Link, ListenAddress, Transports};

/// Publishes the messages of the bag until its end or a signal.
pub fn run(
    args: ReplayArgs,
    ros: &RosNode,
    rosout: Option<&Rosout>,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    has_no_parameters(ros)?;
    leaves_the_process(&Link { transport: args.to, topic: "/".to_owned() })?;
    let bag = BagReader::open(&args.bag)?;
    let options = OutputOptions {
        transport: args.to,
        topics: args.topics.clone(),
        remap: args.remap.clone(),
        clock: args.clock.is_some(),
        reliability: args.reliability,
        overrides: super::qos_overrides(args.qos_profile_overrides_path.as_deref())?,
    };
    let plan = PlaybackPlan::new(&bag, ros, &options)?;
    let player_options = PlayerOptions {
        rate: args.rate,
        start_offset: args.start_offset,
        duration: args.duration,
        looped: args.looped,
        topics: Some(names(&args, &bag, &plan)?),
        clock: args.clock,
        paused: args.start_paused,
        overrides: options.overrides.clone(),
    };
    let mut player = Player::new(&bag, player_options)?;
    // Sessions end with it, hence it lives until the last message is sent.
    let transports = Transports::stopped_by(interrupt.shared(), ros.transport_options()?);
    let mut outputs = TopicOutputs::open(&transports, &options, plan)?;
    let _log = publish_log(rosout, &transports, ros, [args.to])?;
    show_topics(&bag, &outputs)?;
    for topic in outputs.topics().iter().filter(|topic| !topic.planned.is_aside) {
        let publisher = topic.publisher.as_ref();
        if !wait_for_subscribers(&topic.planned.link, publisher, args.wait_for, interrupt)? {
            return Ok(());
        }
    }
    // Not before the loop runs that executes their commands.
    let services = PlayerServices::offer(&transports, args.to, ros)?;
    let view = args.view.map(|address| serve_page(address, &bag)).transpose()?;
    let keyboard = Keyboard::open();
    ensure!(
        keyboard.is_some() || services.is_some() || view.is_some() || !args.start_paused,
        "--start-paused: nothing can resume playback; run it on a terminal, on a transport with services or with --view"
    );
    if keyboard.is_some() && !quiet {
        println!(
            "keys: space pauses or resumes, right arrow or n plays the next message,\n      \
             up and down change the rate, left arrow or b skips back 5 s, f forward 5 s"
        );
    }
    let clock = Clock::start();
    let line = (!quiet && stdout().is_terminal()).then(|| [bag.start(), bag.end()]);
    let mut session =
        Session { outputs: &mut outputs, keyboard, services, view, line, bag: &bag, interrupt };
    let played = play(&mut player, &clock, &mut session);
    drop(session);
    terminal::clear_status();
    played?;
    outputs.flush()?;
    if !quiet {
        let (bag, sent) = (bag.path().display(), HumanCount(outputs.sent));
        println!("{bag}: {sent} messages in {:.1} s", clock.now().as_secs_f64());
    }
    check_complete(&bag, &outputs)
}

/// Says what is published where.
fn show_topics(bag: &BagReader, outputs: &TopicOutputs) -> anyhow::Result<()> {
    for PlannedTopic { name, link, support, .. } in
        outputs.topics().iter().map(|topic| &topic.planned)
    {
        println!("publishing {} on {link} ({})", name.escape_debug(), support.name);
        if support.name == ParticleFrame::TYPE
            && let Ok(Stated { stiffness: Some(stiffness), .. }) =
                eddy_dataset::stated_by(bag, name)
        {
            println!(
                "  stiffness {stiffness}; frames do not contain it: eddy node --stiffness {stiffness}"
            );
        }
    }
    if outputs.topics().is_empty() {
        let reasons = outputs.left_out().join("; ");
        bail!("{}: no topic can be published: {reasons}", bag.path().display());
    }
    if let Some(link) = outputs.clock() {
        println!("publishing the recorded time on {link}");
    }
    Ok(())
}

/// Serves the live page.
fn serve_page(address: ListenAddress, bag: &BagReader) -> anyhow::Result<BagView> {
    // Its gravity and walls are those of the baselines beside recorded predictions.
    let model = Checkpoint::shipped().context("the shipped checkpoint")?;
    let view = BagView::serve(address, bag, &model.description).context("--view")?;
    super::announce_page(view.page());
    Ok(view)
}

/// Checks that every message of every topic was delivered.
fn check_complete(bag: &BagReader, outputs: &TopicOutputs) -> anyhow::Result<()> {
    let (bag, TopicOutputs { sent, undelivered, .. }) = (bag.path().display(), outputs);
    let left_out = outputs.left_out();
    for reason in &left_out {
        println!("not published: {reason}");
    }
    ensure!(
        *undelivered == 0,
        "{bag}: {undelivered} of {sent} messages were not delivered to all subscribers"
    );
    let topics = counted(left_out.len() as u64, "topic");
    ensure!(left_out.is_empty(), "{bag}: {topics} not published, or not completely");
    Ok(())
}

/// The topics to play: the planned ones, and those that the bag lacks, which the player rejects.
fn names(args: &ReplayArgs, bag: &BagReader, plan: &PlaybackPlan) -> anyhow::Result<Vec<String>> {
    let is_missing = |name: &&String| !bag.topics().iter().any(|topic| topic.name == **name);
    let mut names: Vec<String> = plan.topics.iter().map(|topic| topic.name.clone()).collect();
    names.dedup();
    names.extend(args.topics.iter().filter(is_missing).cloned());
    if names.is_empty() && !plan.left_out.is_empty() {
        bail!("{}: no topic can be published: {}", args.bag.display(), plan.left_out.join("; "));
    }
    Ok(names)
}

/// Publishes on the outputs; takes commands from keyboard, services and live page.
struct Session<'a> {
    outputs: &'a mut TopicOutputs,
    keyboard: Option<Keyboard>,
    services: Option<PlayerServices>,
    view: Option<BagView>,
    /// Log times of the first and last message, if there is a status line.
    line: Option<[Option<Stamp>; 2]>,
    bag: &'a BagReader,
    interrupt: &'a Interrupt,
}

impl PlaybackSink for Session<'_> {
    type Error = anyhow::Error;

    fn message(&mut self, message: BagMessage, _: Duration) -> anyhow::Result<()> {
        self.outputs.publish(&message);
        if let Some(view) = &mut self.view {
            view.show(&message);
        }
        Ok(())
    }

    fn clock(&mut self, recorded: Stamp) -> anyhow::Result<()> {
        Ok(self.outputs.publish_clock(recorded)?)
    }

    fn commands(&mut self) -> Vec<PendingCommand> {
        let keys = self.keyboard.iter_mut().flat_map(|keyboard| parse_keys(&keyboard.keys()));
        let keys = keys.map(PendingCommand::from);
        let services = self.services.iter().flat_map(PlayerServices::commands);
        keys.chain(services).chain(self.view.iter().flat_map(BagView::commands)).collect()
    }

    fn status(&mut self, status: PlaybackStatus) {
        if let Some([start, end]) = self.line {
            terminal::show_status(&status_line(status, start, end, self.outputs.sent));
        }
    }

    fn long_pause(&mut self, pause: LongPause) {
        tracing::warn!(
            "{}: the next message follows in {}; --start-offset {} begins with it, --rate and the keys shorten the wait",
            self.bag.path().display(),
            HumanDuration(pause.wait),
            pause.start_offset
        );
    }

    fn is_stopped(&self) -> bool {
        self.interrupt.requested()
    }
}

/// Position, rate and number of messages, as wide as the terminal.
fn status_line(
    status: PlaybackStatus,
    start: Option<Stamp>,
    end: Option<Stamp>,
    sent: u64,
) -> String {
    let start = start.unwrap_or_default();
    let since = |time: Stamp| Stamp(time.0.saturating_sub(start.0)).seconds();
    let state = if status.paused { "paused" } else { "playing" };
    let parts = [
        (0, state.to_owned()),
        (0, format!("{:.1} of {:.1} s", since(status.position), since(end.unwrap_or(start)))),
        (1, format!("rate {:.2}", status.rate)),
        (2, format!("{} messages", HumanCount(sent))),
    ];
    terminal::fit(&parts, " | ", terminal::columns())
}
