//! A live source: scenes one after the other, each a stream, and `/clock` with them.

use anyhow::{Context, bail, ensure};

use crate::{
    cli::SimulateArgs,
    commands::{Interrupt, leaves_the_process, pace::Pace, wait_for_subscribers},
};
use eddy_evaluation::dataset::simulate::{Job, Recording, Store};
use eddy_frames::{Frame, clock::Clock};
use eddy_messages::{self as msg, Message, ParticleFrame, cdr};
use eddy_transport::{Link, Publisher, TransportError, TransportOptions, Transports};

/// Frames of a scene that are too few to say whether the machine keeps the pace.
const LATE_FRAMES: u32 = 30;

/// Publishes the planned scenes; records them too where there is a store.
pub(super) fn run(
    job: &Job,
    link: &Link,
    args: &SimulateArgs,
    store: Option<&Store>,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    let rate = args.rate;
    ensure!(rate.is_finite() && rate > 0.0, "rate: found {rate}, expected a positive number");
    leaves_the_process(link)?;
    // Sessions end with it: it stays until the last message is out.
    let transports = Transports::new(TransportOptions::from_env("eddy_simulate")?);
    let mut outlet = Outlet::open(&transports, link, args)?;
    println!(
        "publishing on {link} at {rate} x real time, simulation time on {}",
        outlet.clock_link
    );
    let ready = wait_for_subscribers(link, outlet.frames.as_ref(), args.wait_for, interrupt)?;
    if !ready {
        return Ok(());
    }
    for scene in job.planned() {
        let name = job.scene_name(scene.start.id);
        let clock = Clock::start();
        let mut simulation = job.start(scene).with_context(|| name.clone())?;
        let mut recording = store.map(|store| Recording::begin(store, &scene.start)).transpose()?;
        let mut frames = 0;
        let stop = || interrupt.requested();
        let whole = Pace::steady(rate)
            .run(&mut simulation, stop, |frame, simulation| {
                outlet.publish(frame)?;
                if let Some(recording) = &mut recording {
                    recording.add(frame, simulation.energy())?;
                }
                frames += 1;
                Ok(())
            })
            .with_context(|| name.clone())?;
        if !quiet {
            let real = clock.now().as_secs_f64();
            let simulated = f64::from(frames) * f64::from(scene.start.scene.frames.interval);
            let slow = real > 1.1 * simulated / rate && frames > LATE_FRAMES;
            let slow = if slow { ", slower than asked for" } else { "" };
            println!("{name}: {frames} frames, {simulated:.1} s simulated in {real:.1} s{slow}");
        }
        if !whole && store.is_some() {
            bail!("interrupted: {name} is not finished and was not kept");
        }
        if !whole {
            return Ok(());
        }
        if let (Some(store), Some(recording)) = (store, recording) {
            store.deliver(&recording.finish()?)?;
        }
    }
    Ok(())
}

/// The topics that a scene is published on.
struct Outlet {
    frames: Box<dyn Publisher>,
    clock: Box<dyn Publisher>,
    clock_link: Link,
}

impl Outlet {
    fn open(
        transports: &Transports,
        link: &Link,
        args: &SimulateArgs,
    ) -> Result<Self, TransportError> {
        let clock_link = Link { transport: link.transport, topic: "/clock".into() };
        let open = |link: &Link, kind: &str| transports.publisher(link, kind, args.reliability);
        Ok(Self {
            frames: open(link, ParticleFrame::TYPE)?,
            clock: open(&clock_link, msg::Clock::TYPE)?,
            clock_link,
        })
    }

    /// Publishes a frame, and before it the time that it shows: whoever has the frame knows it.
    fn publish(&mut self, frame: &Frame) -> Result<(), TransportError> {
        self.clock.publish_cdr(&cdr::encode(&msg::Clock { clock: frame.stamp.into() }))?;
        self.frames.publish_frame(frame)
    }
}
