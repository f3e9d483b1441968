//! Plays: sleeps until something is due, publishes it, listens to its users meanwhile.

use std::{thread, time::Duration};

use super::{Asked, Due, Player};
use eddy_bag::{BagError, BagMessage};
use eddy_frames::{Stamp, clock::Clock};

/// Longest sleep, so that a signal or a key is soon obeyed.
const NAP: Duration = Duration::from_millis(20);

/// Where a player plays to.
pub trait Stage {
    /// Why a stage fails.
    type Error: From<BagError>;

    /// A message is due: `now` at the latest, since the start of playing.
    ///
    /// # Errors
    /// What ends the playing.
    fn message(&mut self, message: BagMessage, now: Duration) -> Result<(), Self::Error>;

    /// The time of the recording, as often as the player was asked for it.
    ///
    /// # Errors
    /// What ends the playing.
    fn clock(&mut self, recorded: Stamp) -> Result<(), Self::Error>;

    /// What was asked for since the last look.
    fn wishes(&mut self) -> Vec<Asked>;

    /// Whether the user wants no more.
    fn is_over(&self) -> bool;
}

/// Plays to the end of the bag, or until the stage is over.
///
/// # Errors
/// Damage of the bag, and what the stage gives.
pub fn play<S: Stage>(player: &mut Player, clock: &Clock, stage: &mut S) -> Result<(), S::Error> {
    while !stage.is_over() {
        for asked in stage.wishes() {
            let Some((wish, reply)) = asked.begin() else { continue };
            let granted = player.wish(wish, clock.now())?;
            if let Some(message) = granted.message {
                stage.message(message, clock.now())?;
            }
            reply.send(granted.outcome);
        }
        if let Some(recorded) = player.tick(clock.now()) {
            stage.clock(recorded)?;
        }
        let now = clock.now();
        match player.poll(now)? {
            Due::Now(message) => stage.message(message, now)?,
            Due::In(wait) => thread::sleep(wait.min(NAP)),
            Due::Never => break,
        }
    }
    Ok(())
}
