//! The loop of a player: waits until a message is due, publishes it, carries out commands meanwhile.

use std::{thread, time::Duration};

use super::{Due, LongPause, PendingCommand, Player};
use eddy_bag::{BagError, BagMessage};
use eddy_frames::{Stamp, clock::Clock};

/// Interval between two calls of [`PlaybackSink::status`].
const STATUS_INTERVAL: Duration = Duration::from_millis(100);
/// Longest sleep, so that signals and commands take effect soon.
const MAX_SLEEP: Duration = Duration::from_millis(20);

/// Where a player publishes, and where its commands come from.
pub trait PlaybackSink {
    /// The error that ends playback.
    type Error: From<BagError>;

    /// Publishes a message that is due `now` (since the start of playback) at the latest.
    ///
    /// # Errors
    /// An error that ends playback.
    fn message(&mut self, message: BagMessage, now: Duration) -> Result<(), Self::Error>;

    /// Publishes the recorded time, at the rate in [`PlayerOptions`](super::PlayerOptions).
    ///
    /// # Errors
    /// An error that ends playback.
    fn clock(&mut self, recorded: Stamp) -> Result<(), Self::Error>;

    /// The commands since the last call.
    fn commands(&mut self) -> Vec<PendingCommand>;

    /// Shows the state of the player to the user: ten times a second, and after every command.
    fn status(&mut self, status: PlaybackStatus) {
        let _ = status;
    }

    /// Tells the user that nothing is published for long; called once.
    fn long_pause(&mut self, pause: LongPause) {
        let _ = pause;
    }

    /// Whether to end playback.
    fn is_stopped(&self) -> bool;
}

/// The state of a player.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaybackStatus {
    /// Recorded time.
    pub position: Stamp,
    /// Recorded time per real time.
    pub rate: f64,
    /// Whether the player is paused.
    pub paused: bool,
}

/// Plays to the end of the bag, or until the sink is stopped.
///
/// # Errors
/// [`BagError`] for a damaged bag, and the errors of the sink.
pub fn play<S: PlaybackSink>(
    player: &mut Player,
    clock: &Clock,
    sink: &mut S,
) -> Result<(), S::Error> {
    let (mut shown, mut has_told_pause): (Option<Duration>, _) = (None, false);
    while !sink.is_stopped() {
        for pending in sink.commands() {
            let Some((command, responder)) = pending.accept() else { continue };
            let executed = player.execute(command, clock.now())?;
            for message in executed.messages {
                sink.message(message, clock.now())?;
            }
            responder.send(executed.outcome);
            shown = None;
        }
        let now = clock.now();
        if shown.is_none_or(|shown| now - shown >= STATUS_INTERVAL) {
            shown = Some(now);
            sink.status(player.status(now));
        }
        if let Some(recorded) = player.tick(clock.now()) {
            sink.clock(recorded)?;
        }
        let now = clock.now();
        match player.poll(now)? {
            Due::Now(message) => sink.message(message, now)?,
            Due::In(wait) => {
                if !has_told_pause && let Some(pause) = player.long_pause(now) {
                    has_told_pause = true;
                    sink.long_pause(pause);
                }
                thread::sleep(wait.min(MAX_SLEEP));
            }
            Due::Never => break,
        }
    }
    Ok(())
}
