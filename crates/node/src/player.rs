//! Plays a bag: which message is due when, as time passes.

mod options;

use std::time::Duration;

pub use options::{PlayerError, PlayerOptions};

use super::{
    read_ahead::ReadAhead,
    timeline::Timeline,
    wish::{Outcome, Wish},
};
use eddy_bag::{BagError, BagMessage, BagReader, Selection};
use eddy_frames::Stamp;

/// The pause before a bag of one instant starts again (ns).
const LONE_INSTANT: f64 = 1e9;
/// What one wish for more speed multiplies the rate by (rosbag2's player).
const FASTER: f64 = 1.1;
/// While paused, the player looks again so often.
const PAUSED: Duration = Duration::from_millis(20);

/// What a player has to do now.
#[derive(Clone, Debug, PartialEq)]
pub enum Due {
    /// Publish this message.
    Now(BagMessage),
    /// Nothing for so long.
    In(Duration),
    /// Nothing any more.
    Never,
}

/// Tells which message of a bag is due.
pub struct Player {
    bag: BagReader,
    options: PlayerOptions,
    selection: Selection,
    /// The recorded time at which playing starts (ns).
    begin: i64,
    /// The recorded time of the first message (ns after `begin`).
    first: f64,
    messages: ReadAhead,
    next: Option<BagMessage>,
    /// Damage met while looking for the next message.
    fault: Option<BagError>,
    timeline: Timeline,
    round: Round,
    /// When the time is to be told next (ns).
    next_tick: f64,
}

/// One pass through the bag.
#[derive(Clone, Copy, Debug, Default)]
struct Round {
    /// When it started (ns of what is played).
    origin: f64,
    /// Messages since it started, or since the user went elsewhere.
    messages: u64,
    /// Recorded time of the first and of the last of them (ns after `begin`).
    first: f64,
    last: f64,
}

/// What became of a wish.
#[derive(Clone, Debug, PartialEq)]
pub struct Granted {
    /// Whether it was fulfilled, and how the player plays now.
    pub outcome: Outcome,
    /// The message that is due at once.
    pub message: Option<BagMessage>,
}

impl Player {
    /// Plays `bag`, from the first call of [`Player::poll`] on.
    ///
    /// # Errors
    /// [`PlayerError::Option`], [`PlayerError::Topic`], [`PlayerError::Nothing`] when no message is selected,
    /// [`PlayerError::Bag`] when a damaged bag has none.
    pub fn new(bag: &BagReader, options: PlayerOptions) -> Result<Self, PlayerError> {
        options.check()?;
        let nothing = || PlayerError::Nothing { bag: bag.path().display().to_string() };
        if let Some(unknown) = options
            .topics
            .iter()
            .flatten()
            .find(|name| !bag.topics().iter().any(|topic| topic.name == **name))
        {
            let topics = bag.topics().iter().map(|topic| topic.name.clone()).collect();
            return Err(PlayerError::Topic { found: unknown.clone(), topics });
        }
        let begin = bag.start().ok_or_else(nothing)?.0;
        let begin = begin.saturating_add(Stamp::from_seconds(options.start_offset).0);
        let end =
            options.duration.map(|seconds| begin.saturating_add(Stamp::from_seconds(seconds).0));
        let selection = Selection {
            topics: options.topics.clone(),
            from: Some(Stamp(begin)),
            until: end.map(Stamp),
        };
        let mut messages = ReadAhead::start(bag.select(&selection)).map_err(PlayerError::Thread)?;
        let next = messages.next().ok_or_else(nothing)??;
        let first = (next.log_time.0 - begin) as f64;
        let mut timeline = Timeline::new(options.rate);
        timeline.set_paused(options.paused, Duration::ZERO);
        Ok(Self {
            bag: bag.clone(),
            options,
            selection,
            begin,
            first,
            messages,
            next: Some(next),
            fault: None,
            timeline,
            round: Round::default(),
            next_tick: 0.0,
        })
    }

    /// Does what the user wants.
    ///
    /// # Errors
    /// [`BagError`] when the bag can no longer be read.
    pub fn wish(&mut self, wish: Wish, now: Duration) -> Result<Granted, BagError> {
        let line = &mut self.timeline;
        let mut message = None;
        let done = match wish {
            Wish::Look => true,
            Wish::TogglePause => line.set_paused(!line.is_paused(), now),
            Wish::Pause => line.set_paused(true, now),
            Wish::Resume => line.set_paused(false, now),
            Wish::Faster => line.set_rate(line.rate() * FASTER, now),
            Wish::Slower => line.set_rate(line.rate() / FASTER, now),
            Wish::Rate(rate) => line.set_rate(rate, now),
            Wish::Seek(to) => self.seek(to, now)?,
            Wish::Skip(seconds) => {
                let position = line.position(now);
                let to = self.recorded(position).0;
                self.seek(Stamp(to.saturating_add(Stamp::from_seconds(seconds).0)), now)?
            }
            Wish::Next => {
                message = self.step(now);
                message.is_some()
            }
        };
        let (rate, paused) = (self.timeline.rate(), self.timeline.is_paused());
        Ok(Granted { outcome: Outcome { done, rate, paused }, message })
    }

    /// Takes the next message before its time.
    fn step(&mut self, now: Duration) -> Option<BagMessage> {
        let due = self.next_due()?;
        self.timeline.jump(due.max(self.timeline.position(now)), now);
        self.advance()
    }

    /// Goes on at a recorded time, or at the beginning if that is later. `false`, and nothing changes, where
    /// no message follows.
    fn seek(&mut self, to: Stamp, now: Duration) -> Result<bool, BagError> {
        let to = to.0.max(self.begin);
        let mut messages = self.read(to)?;
        // Damage is told when it is met in playing.
        let Some(Ok(next)) = messages.next() else { return Ok(false) };
        (self.messages, self.next, self.fault) = (messages, Some(next), None);
        self.round = Round { origin: self.round.origin, ..Round::default() };
        self.timeline.jump(self.round.origin + (to - self.begin) as f64, now);
        Ok(true)
    }

    /// The selected messages from a recorded time on (ns).
    fn read(&self, from: i64) -> Result<ReadAhead, BagError> {
        let selection = Selection { from: Some(Stamp(from)), ..self.selection.clone() };
        ReadAhead::start(self.bag.select(&selection))
            .map_err(BagError::io(self.bag.path(), "starting to read again"))
    }

    /// The recorded time at a position of what is played (ns).
    fn recorded(&self, position: f64) -> Stamp {
        Stamp(self.begin.saturating_add((position - self.round.origin).max(0.0) as i64))
    }

    /// The recorded time, if it is to be told `now`; late calls are not made up for.
    pub fn tick(&mut self, now: Duration) -> Option<Stamp> {
        let interval = 1e9 / self.options.clock?;
        let now_ns = now.as_nanos() as f64;
        if now_ns < self.next_tick {
            return None;
        }
        self.next_tick = (self.next_tick + interval).max(now_ns);
        // Never past a message that has yet to be sent.
        let next = self.next_due().unwrap_or(f64::INFINITY);
        Some(self.recorded(self.timeline.position(now).min(next)))
    }

    /// When the next message is due (ns of what is played).
    fn next_due(&self) -> Option<f64> {
        let message = self.next.as_ref()?;
        Some(self.round.origin + (message.log_time.0 - self.begin) as f64)
    }

    /// What is due `now` (since the start of playing). A late caller gets every message at once
    /// that has become due in the meantime; none is left out.
    ///
    /// # Errors
    /// [`BagError`] when the bag is damaged, after all messages that are whole.
    pub fn poll(&mut self, now: Duration) -> Result<Due, BagError> {
        let Some(due) = self.next_due() else {
            return self.fault.take().map_or(Ok(Due::Never), Err);
        };
        let until_tick = self.options.clock.map(|_| self.next_tick - now.as_nanos() as f64);
        let early = self.timeline.until(due, now).unwrap_or(PAUSED.as_nanos() as f64);
        if early > 0.0 {
            let wait = until_tick.map_or(early, |tick| early.min(tick.max(0.0)));
            return Ok(Due::In(Duration::from_nanos(wait.ceil() as u64)));
        }
        Ok(self.advance().map_or(Due::Never, Due::Now))
    }

    /// Takes the next message and looks for the one after it.
    fn advance(&mut self) -> Option<BagMessage> {
        let recorded =
            self.next.as_ref().map(|message| (message.log_time.0 - self.begin) as f64)?;
        if self.round.messages == 0 {
            self.round.first = recorded;
        }
        self.round.last = recorded;
        self.round.messages += 1;
        let following = self.following().unwrap_or_else(|error| {
            self.fault = Some(error);
            None
        });
        std::mem::replace(&mut self.next, following)
    }

    /// The message after the next one; starts the next round if there is one.
    fn following(&mut self) -> Result<Option<BagMessage>, BagError> {
        if let Some(message) = self.messages.next().transpose()? {
            return Ok(Some(message));
        }
        if !self.options.looped {
            return Ok(None);
        }
        // The next round's first message comes one mean interval after this round's last.
        let Round { origin, messages, first, last } = self.round;
        let interval =
            if last > first { (last - first) / (messages - 1) as f64 } else { LONE_INSTANT };
        self.round = Round { origin: origin + last + interval - self.first, ..Round::default() };
        self.messages = self.read(self.begin)?;
        self.messages.next().transpose()
    }
}

#[cfg(test)]
mod tests;
