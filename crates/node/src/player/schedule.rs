//! Which message of a bag is due when.

use std::{collections::VecDeque, time::Duration};

use super::{
    CommandOutcome, PlaybackStatus, PlayerCommand, PlayerError, PlayerOptions, Timeline,
    read_ahead::ReadAhead,
};
use eddy_bag::{BagError, BagMessage, BagReader, Selection, TopicInfo};
use eddy_frames::Stamp;

/// Interval at which a bag whose messages have one time is repeated (ns).
const SINGLE_INSTANT_INTERVAL: f64 = 1e9;
/// Factor of one step in rate (as in rosbag2's player).
const RATE_STEP: f64 = 1.1;
/// A pause of this duration (real time) is worth a word.
const LONG_PAUSE: Duration = Duration::from_secs(60);
/// Interval between polls while paused.
const PAUSED_POLL: Duration = Duration::from_millis(20);

/// What a player has to do next.
#[derive(Clone, Debug, PartialEq)]
pub enum Due {
    /// Publish this message.
    Now(BagMessage),
    /// Wait.
    In(Duration),
    /// Nothing: the end of the bag.
    Never,
}

/// Schedules the messages of a bag.
pub struct Player {
    bag: BagReader,
    options: PlayerOptions,
    selection: Selection,
    /// Recorded time at which playback starts (ns).
    begin: i64,
    /// Recorded time of the first message (ns after `begin`).
    first: f64,
    messages: ReadAhead,
    next: Option<BagMessage>,
    /// Messages that transient-local publishers had kept where the pass, or playback after a seek, begins. They are due
    /// there, also while the player is paused.
    kept: VecDeque<BagMessage>,
    /// Damage found while reading the next message.
    fault: Option<BagError>,
    timeline: Timeline,
    pass: Pass,
    /// When to publish the recorded time next (ns).
    next_tick: f64,
}

/// One pass through the bag.
#[derive(Clone, Copy, Debug, Default)]
struct Pass {
    /// Playing time at its start (ns).
    origin: f64,
    /// Messages since the start of the pass, or since the last seek.
    messages: u64,
    /// Recorded time of the first and the last of them (ns after `begin`).
    first: f64,
    last: f64,
}

/// An executed command.
#[derive(Clone, Debug, PartialEq)]
pub struct Executed {
    /// The outcome for the user.
    pub outcome: CommandOutcome,
    /// Messages to publish at once.
    pub messages: Vec<BagMessage>,
}

/// A long wait for the next message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LongPause {
    /// How long (real time).
    pub wait: Duration,
    /// `start-offset` with which playback begins at the next message, or up to a second before (recorded s).
    pub start_offset: f64,
}

impl Player {
    /// Starts at the first call of [`Player::poll`].
    ///
    /// # Errors
    /// [`PlayerError`] when an option is out of range, a topic is unknown, or no message is selected.
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
        let kept = kept_at(bag, &options, begin);
        Ok(Self {
            bag: bag.clone(),
            options,
            selection,
            begin,
            first,
            messages,
            next: Some(next),
            kept,
            fault: None,
            timeline,
            pass: Pass::default(),
            next_tick: 0.0,
        })
    }

    /// Executes a command.
    ///
    /// # Errors
    /// [`BagError`] when the bag can no longer be read.
    pub fn execute(&mut self, command: PlayerCommand, now: Duration) -> Result<Executed, BagError> {
        let line = &mut self.timeline;
        let mut messages = Vec::new();
        let done = match command {
            PlayerCommand::Status => true,
            PlayerCommand::TogglePause => line.set_paused(!line.is_paused(), now),
            PlayerCommand::Pause => line.set_paused(true, now),
            PlayerCommand::Resume => line.set_paused(false, now),
            PlayerCommand::Faster => line.set_rate(line.rate() * RATE_STEP, now),
            PlayerCommand::Slower => line.set_rate(line.rate() / RATE_STEP, now),
            PlayerCommand::Rate(rate) => line.set_rate(rate, now),
            PlayerCommand::Seek(to) => self.seek(to, now)?,
            PlayerCommand::Skip(seconds) => {
                let position = line.position(now);
                let to = self.recorded(position).0;
                self.seek(Stamp(to.saturating_add(Stamp::from_seconds(seconds).0)), now)?
            }
            PlayerCommand::Next => {
                messages.extend(self.kept.drain(..));
                let message = self.step(now);
                let done = message.is_some();
                messages.extend(message);
                done
            }
        };
        let (rate, paused) = (self.timeline.rate(), self.timeline.is_paused());
        Ok(Executed { outcome: CommandOutcome { done, rate, paused }, messages })
    }

    /// Takes the next message before it is due.
    fn step(&mut self, now: Duration) -> Option<BagMessage> {
        let due = self.next_due()?;
        self.timeline.jump(due.max(self.timeline.position(now)), now);
        self.advance()
    }

    /// Continues at a recorded time, or at the beginning if that is later. Returns `false` and changes nothing if no
    /// message follows.
    fn seek(&mut self, to: Stamp, now: Duration) -> Result<bool, BagError> {
        let to = to.0.max(self.begin);
        let mut messages = self.read(to)?;
        // Damage is reported when playback reaches it.
        let Some(Ok(next)) = messages.next() else { return Ok(false) };
        (self.messages, self.next, self.fault) = (messages, Some(next), None);
        self.kept = kept_at(&self.bag, &self.options, to);
        self.pass = Pass { origin: self.pass.origin, ..Pass::default() };
        self.timeline.jump(self.pass.origin + (to - self.begin) as f64, now);
        Ok(true)
    }

    /// The selected messages from a recorded time (ns).
    fn read(&self, from: i64) -> Result<ReadAhead, BagError> {
        let selection = Selection { from: Some(Stamp(from)), ..self.selection.clone() };
        ReadAhead::start(self.bag.select(&selection))
            .map_err(BagError::io(self.bag.path(), "restarting the reading thread"))
    }

    /// The recorded time at a playing time (ns).
    fn recorded(&self, position: f64) -> Stamp {
        Stamp(self.begin.saturating_add((position - self.pass.origin).max(0.0) as i64))
    }

    /// How long nothing is published from `now` on, if that is long.
    pub fn long_pause(&self, now: Duration) -> Option<LongPause> {
        let (next, due) = (self.next.as_ref()?, self.next_due()?);
        // Paused by the user if there is no end.
        let wait = Duration::try_from_secs_f64(self.timeline.until(due, now)? * 1e-9).ok()?;
        let start = self.bag.start().unwrap_or_default();
        let start_offset = Stamp(next.log_time.0.saturating_sub(start.0)).seconds().floor();
        (wait >= LONG_PAUSE).then_some(LongPause { wait, start_offset })
    }

    /// The state of the player `now`.
    pub fn status(&self, now: Duration) -> PlaybackStatus {
        // Never beyond the next message, nor the last one.
        let next = self.next_due().unwrap_or(self.pass.origin + self.pass.last);
        PlaybackStatus {
            position: self.recorded(self.timeline.position(now).min(next)),
            rate: self.timeline.rate(),
            paused: self.timeline.is_paused(),
        }
    }

    /// The recorded time, if it is to be published `now`. Ticks missed by a late call are skipped.
    pub fn tick(&mut self, now: Duration) -> Option<Stamp> {
        let interval = 1e9 / self.options.clock?;
        let now_ns = now.as_nanos() as f64;
        if now_ns < self.next_tick {
            return None;
        }
        self.next_tick = (self.next_tick + interval).max(now_ns);
        // Never beyond the next message, nor the last one.
        let next = self.next_due().unwrap_or(self.pass.origin + self.pass.last);
        Some(self.recorded(self.timeline.position(now).min(next)))
    }

    /// Playing time at which the next message is due (ns).
    fn next_due(&self) -> Option<f64> {
        let message = self.next.as_ref()?;
        Some(self.pass.origin + (message.log_time.0 - self.begin) as f64)
    }

    /// What is due `now` (real time since the start). After a late call, all messages due in the meantime are returned
    /// by the following calls without delay.
    ///
    /// # Errors
    /// [`BagError`] when the bag is damaged, after all readable messages.
    pub fn poll(&mut self, now: Duration) -> Result<Due, BagError> {
        if self.timeline.position(now) >= self.pass.origin
            && let Some(kept) = self.kept.pop_front()
        {
            return Ok(Due::Now(kept));
        }
        let Some(due) = self.next_due() else {
            return self.fault.take().map_or(Ok(Due::Never), Err);
        };
        let until_tick = self.options.clock.map(|_| self.next_tick - now.as_nanos() as f64);
        let early = self.timeline.until(due, now).unwrap_or(PAUSED_POLL.as_nanos() as f64);
        if early > 0.0 {
            let wait = until_tick.map_or(early, |tick| early.min(tick.max(0.0)));
            return Ok(Due::In(Duration::from_nanos(wait.ceil() as u64)));
        }
        Ok(self.advance().map_or(Due::Never, Due::Now))
    }

    /// Takes the next message and reads the one after it.
    fn advance(&mut self) -> Option<BagMessage> {
        let recorded =
            self.next.as_ref().map(|message| (message.log_time.0 - self.begin) as f64)?;
        if self.pass.messages == 0 {
            self.pass.first = recorded;
        }
        self.pass.last = recorded;
        self.pass.messages += 1;
        let following = self.following().unwrap_or_else(|error| {
            self.fault = Some(error);
            None
        });
        std::mem::replace(&mut self.next, following)
    }

    /// Reads the message after the next one; at the end of a looped bag, the first of the next pass.
    fn following(&mut self) -> Result<Option<BagMessage>, BagError> {
        if let Some(message) = self.messages.next().transpose()? {
            return Ok(Some(message));
        }
        if !self.options.looped {
            return Ok(None);
        }
        // The next pass starts one mean interval after the last message of this one.
        let Pass { origin, messages, first, last } = self.pass;
        let interval = if last > first {
            (last - first) / (messages - 1) as f64
        } else {
            SINGLE_INSTANT_INTERVAL
        };
        self.pass = Pass { origin: origin + last + interval - self.first, ..Pass::default() };
        self.messages = self.read(self.begin)?;
        self.kept = kept_at(&self.bag, &self.options, self.begin);
        self.messages.next().transpose()
    }
}

/// The messages that transient-local publishers of the played topics had kept at a recorded time (ns), with this time as
/// their log time.
fn kept_at(bag: &BagReader, options: &PlayerOptions, at: i64) -> VecDeque<BagMessage> {
    let depth_of = |topic: &TopicInfo| {
        let is_played = options.topics.as_ref().is_none_or(|topics| topics.contains(&topic.name));
        match options.overrides.get(&topic.name) {
            _ if !is_played => 0,
            Some(offered) => offered.kept(),
            None => topic.kept(),
        }
    };
    let mut kept = VecDeque::new();
    for message in bag.kept_at(Stamp(at), depth_of) {
        match message {
            Ok(message) => kept.push_back(BagMessage { log_time: Stamp(at), ..message }),
            Err(error) => tracing::warn!("messages kept before the start may be missing: {error}"),
        }
    }
    kept
}

#[cfg(test)]
mod tests;
