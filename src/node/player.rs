//! Plays a bag: which message is due when, as time passes.

use std::time::Duration;

use crate::{
    bag::{BagError, BagMessage, BagReader, Messages, Selection},
    frame::Stamp,
};

/// The pause before a bag of one instant starts again (ns).
const LONE_INSTANT: f64 = 1e9;

/// How a bag is played.
#[derive(Clone, Debug, PartialEq)]
pub struct PlayerOptions {
    /// How much faster than recorded; 1 by default.
    pub rate: f64,
    /// Recorded seconds that are skipped; 0 by default.
    pub start_offset: f64,
    /// Recorded seconds after which it ends; all of them if `None`.
    pub duration: Option<f64>,
    /// Start again at the end.
    pub looped: bool,
    /// Only these topics; all if `None`.
    pub topics: Option<Vec<String>>,
}

impl Default for PlayerOptions {
    fn default() -> Self {
        Self { rate: 1.0, start_offset: 0.0, duration: None, looped: false, topics: None }
    }
}

/// Why a bag cannot be played.
#[derive(Debug, thiserror::Error)]
pub enum PlayerError {
    /// An option makes no sense.
    #[error("{field}: found {found}, expected {expected}")]
    Option {
        /// The option.
        field: &'static str,
        /// Its value.
        found: String,
        /// What it should be.
        expected: &'static str,
    },
    /// The bag has no message to play.
    #[error("{bag}: found no message of the wanted topics and times, expected at least 1")]
    Nothing {
        /// The bag.
        bag: String,
    },
    /// The bag is damaged before its first message.
    #[error(transparent)]
    Bag(#[from] BagError),
}

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
    messages: Messages,
    next: Option<BagMessage>,
    /// Damage met while reading ahead.
    fault: Option<BagError>,
    round: Round,
}

/// One pass through the bag.
#[derive(Clone, Copy, Debug, Default)]
struct Round {
    /// When it started (ns of playing time).
    origin: f64,
    messages: u64,
    /// Recorded time of the first and of the last message so far (ns after `begin`).
    first: f64,
    last: f64,
}

impl Player {
    /// Plays `bag`, from the first call of [`Player::poll`] on.
    ///
    /// # Errors
    /// [`PlayerError::Option`], [`PlayerError::Nothing`] when no message is selected,
    /// [`PlayerError::Bag`] when a damaged bag has none.
    pub fn new(bag: &BagReader, options: PlayerOptions) -> Result<Self, PlayerError> {
        check(&options)?;
        let nothing = || PlayerError::Nothing { bag: bag.path().display().to_string() };
        if let Some(unknown) = options
            .topics
            .iter()
            .flatten()
            .find(|name| !bag.topics().iter().any(|topic| topic.name == **name))
        {
            return Err(PlayerError::Option {
                field: "topics",
                found: unknown.clone(),
                expected: "a topic of the bag",
            });
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
        let mut messages = bag.select(&selection);
        let next = Some(messages.next().ok_or_else(nothing)??);
        let (bag, round) = (bag.clone(), Round::default());
        Ok(Self { bag, options, selection, begin, messages, next, fault: None, round })
    }

    /// What is due `now` (since the start of playing). A late caller gets every message at once
    /// that has become due in the meantime; none is left out.
    ///
    /// # Errors
    /// [`BagError`] when the bag is damaged, after all messages that are whole.
    pub fn poll(&mut self, now: Duration) -> Result<Due, BagError> {
        let Some(message) = &self.next else {
            return self.fault.take().map_or(Ok(Due::Never), Err);
        };
        let recorded = (message.log_time.0 - self.begin) as f64;
        let due = self.round.origin + recorded / self.options.rate;
        let early = due - now.as_nanos() as f64;
        if early > 0.0 {
            return Ok(Due::In(Duration::from_nanos(early.ceil() as u64)));
        }
        if self.round.messages == 0 {
            self.round.first = recorded;
        }
        self.round.last = recorded;
        self.round.messages += 1;
        let following = self.following().unwrap_or_else(|error| {
            self.fault = Some(error);
            None
        });
        let due = std::mem::replace(&mut self.next, following);
        Ok(due.map_or(Due::Never, Due::Now))
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
        self.round = Round {
            origin: origin + (last + interval - first) / self.options.rate,
            ..Round::default()
        };
        self.messages = self.bag.select(&self.selection);
        self.messages.next().transpose()
    }
}

fn check(options: &PlayerOptions) -> Result<(), PlayerError> {
    let PlayerOptions { rate, start_offset, duration, .. } = options;
    let wrong = |field, found: &f64, expected| {
        Err(PlayerError::Option { field, found: found.to_string(), expected })
    };
    if !(rate.is_finite() && *rate > 0.0) {
        return wrong("rate", rate, "a positive number");
    }
    if !(start_offset.is_finite() && *start_offset >= 0.0) {
        return wrong("start-offset", start_offset, "seconds, 0 or more");
    }
    match duration {
        Some(seconds) if !(seconds.is_finite() && *seconds > 0.0) => {
            wrong("duration", seconds, "seconds, more than 0")
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;
    use crate::{
        bag::{BagWriter, WriterOptions},
        msg::{Message, RosString, cdr},
    };

    const MILLISECOND: i64 = 1_000_000;

    /// A bag with messages on `/a`, at so many milliseconds, each saying when.
    fn bag(directory: &Path, times: &[i64]) -> BagReader {
        let path = directory.join("bag");
        let mut writer = BagWriter::create(&path, WriterOptions::default()).unwrap();
        let topic = writer.topic("/a", RosString::TYPE).unwrap();
        for time in times {
            let stamp = Stamp(time * MILLISECOND);
            let data = cdr::encode(&RosString { data: time.to_string() });
            writer.write(topic, stamp, stamp, &data).unwrap();
        }
        writer.finish().unwrap();
        BagReader::open(&path).unwrap()
    }

    /// Plays for `limit` ms of a clock that jumps to when the next message is due. Gives the
    /// playing time and the recorded time of each message (ms).
    fn play(bag: &BagReader, options: PlayerOptions, limit: u64) -> Vec<(u64, i64)> {
        let mut player = Player::new(bag, options).unwrap();
        let (mut now, mut played) = (Duration::ZERO, Vec::new());
        while now <= Duration::from_millis(limit) {
            match player.poll(now).unwrap() {
                Due::Now(message) => {
                    played.push((now.as_millis() as u64, message.log_time.0 / MILLISECOND));
                }
                Due::In(wait) => now += wait,
                Due::Never => break,
            }
        }
        played
    }

    #[test]
    fn messages_are_due_as_they_were_recorded() {
        let directory = tempfile::tempdir().unwrap();
        let bag = bag(directory.path(), &[1000, 1016, 1100]);
        let played = play(&bag, PlayerOptions::default(), 10_000);
        assert_eq!(played, [(0, 1000), (16, 1016), (100, 1100)]);
    }

    #[test]
    fn rate_offset_and_duration_count_in_recorded_time() {
        let directory = tempfile::tempdir().unwrap();
        let bag = bag(directory.path(), &[1000, 1020, 1040, 1060, 1080]);
        let options = PlayerOptions {
            rate: 2.0,
            start_offset: 0.010,
            duration: Some(0.050),
            ..PlayerOptions::default()
        };
        assert_eq!(play(&bag, options, 10_000), [(5, 1020), (15, 1040), (25, 1060)]);
    }

    #[test]
    fn a_loop_goes_on_at_the_same_pace() {
        let directory = tempfile::tempdir().unwrap();
        let bag = bag(directory.path(), &[500, 520, 540]);
        let options = PlayerOptions { looped: true, ..PlayerOptions::default() };
        let played = play(&bag, options, 100);
        assert_eq!(played, [(0, 500), (20, 520), (40, 540), (60, 500), (80, 520), (100, 540)]);
    }

    #[test]
    fn a_late_caller_gets_everything_that_has_become_due() {
        let directory = tempfile::tempdir().unwrap();
        let bag = bag(directory.path(), &[0, 10, 20, 30]);
        let mut player = Player::new(&bag, PlayerOptions::default()).unwrap();
        let late = Duration::from_millis(25);
        let mut due = || match player.poll(late).unwrap() {
            Due::Now(message) => Some(message.log_time.0 / MILLISECOND),
            _ => None,
        };
        assert_eq!([due(), due(), due(), due()], [Some(0), Some(10), Some(20), None]);
        assert_eq!(player.poll(late).unwrap(), Due::In(Duration::from_millis(5)));
    }

    #[test]
    fn options_that_make_no_sense_are_refused() {
        let directory = tempfile::tempdir().unwrap();
        let bag = bag(directory.path(), &[0]);
        let cases = [
            (
                PlayerOptions { rate: 0.0, ..Default::default() },
                "rate: found 0, expected a positive number",
            ),
            (
                PlayerOptions { start_offset: f64::NAN, ..Default::default() },
                "start-offset: found NaN",
            ),
            (PlayerOptions { duration: Some(-1.0), ..Default::default() }, "duration: found -1"),
            (
                PlayerOptions { topics: Some(vec!["/b".into()]), ..Default::default() },
                "topics: found /b, expected a topic of the bag",
            ),
            (PlayerOptions { start_offset: 9.0, ..Default::default() }, "found no message"),
        ];
        for (options, expected) in cases {
            let message = Player::new(&bag, options).err().unwrap().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }
}
