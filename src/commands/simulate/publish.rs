//! A live source: scenes one after the other, each a stream, with `/clock`.

use std::{path::PathBuf, time::Duration};

use anyhow::{Context, bail, ensure};

use super::live_tools::LiveTools;
use crate::{
    cli::SimulateArgs,
    commands::{leaves_the_process, wait_for_subscribers},
};
use eddy_cli::Interrupt;
use eddy_dataset::simulate::{Job, Recording, Store};
use eddy_frames::{Frame, clock::Clock};
use eddy_messages::{self as msg, Message, ParticleFrame, cdr};
use eddy_mpm::{MpmError, Scene, Simulation};
use eddy_node::{
    Pacer,
    ros::RosArguments,
    tools::{ToolTopics, delivered_or_missed},
};
use eddy_transport::{Link, Publisher, TransportError, TransportOptions, Transports};

/// The name of the source on its transport.
const NAME: &str = "eddy_simulate";
/// Minimum number of frames of a scene for a statement about its pace.
const MIN_PACE_FRAMES: u32 = 30;

/// Publishes the planned scenes, and records them if there is a store.
pub(super) fn run(
    job: &Job,
    link: &Link,
    args: &SimulateArgs,
    store: Option<&Store>,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let rate = args.rate;
    leaves_the_process(link)?;
    // Sessions end with it, hence it lives until the last message is sent.
    let transports = Transports::stopped_by(interrupt.shared(), TransportOptions::from_env(NAME)?);
    let ros = RosArguments::default().node(NAME);
    let open = |file: &PathBuf| LiveTools::open(file, &transports, link, &ros);
    let mut live = args.tools.as_ref().map(open).transpose()?;
    let mut topics = Topics::open(&transports, link, args, job)?;
    println!("publishing on {link} at {rate} x real time, simulated time on {}", topics.clock_link);
    let ready = wait_for_subscribers(link, topics.frames.as_ref(), args.wait_for, interrupt)?;
    if !ready {
        return Ok(());
    }
    for planned in job.planned() {
        let name = job.scene_name(planned.start.id);
        let mut scene = planned.clone();
        if let Some(live) = &mut live {
            let Some(tools) = live.begin(interrupt)? else { return Ok(()) };
            scene.start.scene.tools = tools;
        }
        let clock = Clock::start();
        let mut simulation = job.start(&scene).with_context(|| name.clone())?;
        topics.describe(&scene.start.scene)?;
        let mut recording = store.map(|store| Recording::begin(store, &scene.start)).transpose()?;
        let mut frames = 0;
        let stop = || interrupt.requested();
        let mut cancelled = false;
        let next = |simulation: &mut Simulation| {
            next_frame(simulation, live.as_mut(), interrupt, &mut cancelled)
        };
        let complete = Pacer::steady(rate)
            .run(&mut simulation, next, stop, |frame, simulation| {
                topics.publish(frame, simulation)?;
                if let Some(recording) = &mut recording {
                    recording.add(frame, simulation)?;
                }
                frames += 1;
                Ok(())
            })
            .with_context(|| name.clone())?;
        let complete = complete && !cancelled;
        if !quiet {
            let simulated = f64::from(frames) * f64::from(scene.start.scene.frames.interval);
            println!("{name}: {}", pace(frames, simulated, clock.now(), rate));
        }
        if !complete {
            topics.finish()?;
            return match store {
                Some(_) => bail!("interrupted: {name} is incomplete and was discarded"),
                None => Ok(()),
            };
        }
        if let (Some(store), Some(recording)) = (store, recording) {
            store.deliver(&recording.finish(&simulation)?)?;
        }
    }
    topics.finish()
}

/// The next frame, with the tools where messages say. None comes if it is interrupted.
fn next_frame(
    simulation: &mut Simulation,
    live: Option<&mut LiveTools>,
    interrupt: &Interrupt,
    cancelled: &mut bool,
) -> anyhow::Result<Option<Frame>> {
    if let (Some(live), true) = (live, simulation.has_begun()) {
        live.steer(simulation)?;
    }
    match simulation.next_frame_unless(&|| interrupt.requested()) {
        Err(MpmError::Cancelled) => {
            *cancelled = true;
            Ok(None)
        }
        frame => Ok(frame?),
    }
}

/// How many frames of a scene took how long.
fn pace(frames: u32, simulated: f64, real: Duration, rate: f64) -> String {
    let real = real.as_secs_f64();
    let slow = real > 1.1 * simulated / rate && frames > MIN_PACE_FRAMES;
    let slow = if slow { ", slower than requested" } else { "" };
    format!("{frames} frames, {simulated:.1} s simulated in {real:.1} s{slow}")
}

/// The topics of a live source.
struct Topics {
    frames: Box<dyn Publisher>,
    clock: Box<dyn Publisher>,
    clock_link: Link,
    /// Tools, if a scene has any.
    tools: Option<ToolTopics>,
    sent: u64,
    /// Frames that were not delivered to all subscribers.
    undelivered: u64,
}

impl Topics {
    fn open(
        transports: &Transports,
        link: &Link,
        args: &SimulateArgs,
        job: &Job,
    ) -> Result<Self, TransportError> {
        let has_tools = args.tools.is_some()
            || job.planned().iter().any(|scene| !scene.start.scene.tools.is_empty());
        let clock_link = Link { transport: link.transport, topic: "/clock".into() };
        let open = |link: &Link, kind: &str| transports.publisher(link, kind, args.reliability);
        Ok(Self {
            frames: open(link, ParticleFrame::TYPE)?,
            clock: open(&clock_link, msg::Clock::TYPE)?,
            clock_link,
            tools: has_tools
                .then(|| ToolTopics::open(transports, link, args.reliability))
                .transpose()?,
            sent: 0,
            undelivered: 0,
        })
    }

    /// Publishes what the tools of the next scene are.
    fn describe(&mut self, scene: &Scene) -> Result<(), TransportError> {
        match (&mut self.tools, scene.tools_of_stream()) {
            (Some(topics), Some(tools)) => topics.describe(tools),
            _ => Ok(()),
        }
    }

    /// Publishes the time and the tools, then the frame: a subscriber that has the frame has its time and its tools.
    fn publish(&mut self, frame: &Frame, simulation: &Simulation) -> Result<(), TransportError> {
        let time = cdr::encode(&msg::Clock { clock: frame.stamp.into() });
        delivered_or_missed(self.clock.publish_cdr(&time))?;
        if let Some(tools) = &mut self.tools {
            tools.publish(&simulation.tool_frame(frame))?;
        }
        self.sent += 1;
        match self.frames.publish_frame(frame) {
            Err(error) if error.is_missed() => {
                if self.undelivered == 0 {
                    tracing::warn!("{error}");
                }
                self.undelivered += 1;
                Ok(())
            }
            outcome => outcome,
        }
    }

    /// Waits until subscribers have all frames, as far as the transport knows, and fails if they do not.
    fn finish(&mut self) -> anyhow::Result<()> {
        match self.frames.flush() {
            Err(error @ TransportError::Undelivered { messages, .. }) => {
                tracing::warn!("{error}");
                self.undelivered += messages;
            }
            outcome => outcome?,
        }
        let Self { sent, undelivered, .. } = self;
        ensure!(
            *undelivered == 0,
            "{undelivered} of {sent} frames were not delivered to all subscribers"
        );
        Ok(())
    }
}
