//! `eddy replay`: a bag onto topics, at its recorded pace.
//!
//! 1. [`outputs`]: a publisher for every topic, and one for the clock.
//! 2. [`keyboard`]: what the user wants, where standard input is a terminal.
//! 3. [`control`]: what others want, where the transport has services.
//! 4. [`screen`]: what the live page shows of it.

mod control;
mod keyboard;
mod outputs;
mod screen;

use anyhow::{bail, ensure};
use indicatif::HumanCount;

use super::{Interrupt, has_no_parameters, transport_options};
use crate::cli::ReplayArgs;
use control::RemoteControl;
use eddy_bag::BagReader;
use eddy_frames::clock::Clock;
use eddy_node::{Asked, Player, PlayerOptions, Stage, play, ros::RosNode};
use eddy_transport::Transports;
use keyboard::Keyboard;
use outputs::Outputs;
use screen::Screen;

/// Publishes the bag's messages until its end or a signal.
pub fn run(
    args: ReplayArgs,
    ros: &RosNode,
    quiet: bool,
    interrupt: &Interrupt,
) -> anyhow::Result<()> {
    has_no_parameters(ros)?;
    let bag = BagReader::open(&args.bag)?;
    let playable = outputs::playable(&bag, &args)?;
    let mut player = Player::new(
        &bag,
        PlayerOptions {
            rate: args.rate,
            start_offset: args.start_offset,
            duration: args.duration,
            looped: args.looped,
            topics: Some(outputs::names(&playable, &bag, &args)),
            clock: args.clock,
            paused: args.start_paused,
        },
    )?;
    // Sessions end with it: it stays until the last message is out.
    let transports = Transports::new(transport_options(ros)?);
    let mut outputs = Outputs::open(&transports, ros, &args, &bag, &playable)?;
    if !outputs.wait_for(args.wait_for, interrupt)? {
        return Ok(());
    }
    // Not before there is somebody who does what they ask.
    let control = RemoteControl::offer(&transports, args.to, ros)?;
    let screen = args.view.map(|address| Screen::open(address, &bag)).transpose()?;
    let keyboard = Keyboard::open();
    ensure!(
        keyboard.is_some() || control.is_some() || screen.is_some() || !args.start_paused,
        "--start-paused: found no terminal on standard input, no services on {} and no --view, expected one of them \
         to go on from",
        args.to
    );
    if keyboard.is_some() && !quiet {
        println!(
            "space: pause or go on, right arrow or n: next message, up and down: faster and slower, \
             left arrow or b: 5 s back, f: 5 s on"
        );
    }
    let clock = Clock::start();
    let mut theatre = Theatre { outputs: &mut outputs, keyboard, control, screen, interrupt };
    play(&mut player, &clock, &mut theatre)?;
    drop(theatre);
    if !quiet {
        let seconds = clock.now().as_secs_f64();
        println!(
            "{}: {} messages in {seconds:.1} s",
            bag.path().display(),
            HumanCount(outputs.sent)
        );
    }
    if outputs.refused > 0 {
        bail!(
            "{}: {} messages that are no frames were left out",
            bag.path().display(),
            outputs.refused
        );
    }
    Ok(())
}

/// Plays to the outputs, as the keyboard, the services and the signals say.
struct Theatre<'a> {
    outputs: &'a mut Outputs,
    keyboard: Option<Keyboard>,
    control: Option<RemoteControl>,
    screen: Option<Screen>,
    interrupt: &'a Interrupt,
}

impl Stage for Theatre<'_> {
    type Error = anyhow::Error;

    fn message(
        &mut self,
        message: eddy_bag::BagMessage,
        _: std::time::Duration,
    ) -> anyhow::Result<()> {
        self.outputs.publish(&message)?;
        if let Some(screen) = &mut self.screen {
            screen.show(&message);
        }
        Ok(())
    }

    fn clock(&mut self, recorded: eddy_frames::Stamp) -> anyhow::Result<()> {
        self.outputs.tell(recorded)
    }

    fn wishes(&mut self) -> Vec<Asked> {
        let typed = self.keyboard.as_mut().map(Keyboard::wishes).unwrap_or_default();
        let mut wishes: Vec<Asked> = typed.into_iter().map(Asked::from).collect();
        wishes.extend(self.control.iter().flat_map(RemoteControl::wishes));
        wishes.extend(self.screen.iter().flat_map(Screen::wishes));
        wishes
    }

    fn is_over(&self) -> bool {
        self.interrupt.requested()
    }
}
