//! Plays a bag: which message is due when, as time passes.

use std::time::Duration;

use super::{read_ahead::ReadAhead, timeline::Timeline, wish::Wish};
use crate::{
    bag::{BagError, BagMessage, BagReader, Selection},
    frame::Stamp,
};

/// The pause before a bag of one instant starts again (ns).
const LONE_INSTANT: f64 = 1e9;
/// What one wish for more speed multiplies the rate by (rosbag2's player).
const FASTER: f64 = 1.1;
/// While paused, the player looks again so often.
const PAUSED: Duration = Duration::from_millis(20);

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
    /// How often the time of the recording is told (per second that passes); never if `None`.
    pub clock: Option<f64>,
    /// Wait for the user to begin.
    pub paused: bool,
}

impl Default for PlayerOptions {
    fn default() -> Self {
        Self {
            rate: 1.0,
            start_offset: 0.0,
            duration: None,
            looped: false,
            topics: None,
            clock: None,
            paused: false,
        }
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
    /// The system gave no thread to read the bag.
    #[error("reading ahead: {0}")]
    Thread(std::io::Error),
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
        let mut messages = ReadAhead::start(bag.select(&selection)).map_err(PlayerError::Thread)?;
        let next = Some(messages.next().ok_or_else(nothing)??);
        let mut timeline = Timeline::new(options.rate);
        timeline.set_paused(options.paused, Duration::ZERO);
        Ok(Self {
            bag: bag.clone(),
            options,
            selection,
            begin,
            messages,
            next,
            fault: None,
            timeline,
            round: Round::default(),
            next_tick: 0.0,
        })
    }

    /// How much faster than recorded it plays now.
    pub fn rate(&self) -> f64 {
        self.timeline.rate()
    }

    /// Whether it pauses.
    pub fn is_paused(&self) -> bool {
        self.timeline.is_paused()
    }

    /// Does what the user wants. Gives the message that is then due at once, if any.
    ///
    /// # Errors
    /// As [`Player::poll`].
    pub fn wish(&mut self, wish: Wish, now: Duration) -> Result<Option<BagMessage>, BagError> {
        let rate = self.timeline.rate();
        match wish {
            Wish::Pause => self.timeline.set_paused(!self.timeline.is_paused(), now),
            Wish::Faster => self.timeline.set_rate(rate * FASTER, now),
            Wish::Slower => self.timeline.set_rate(rate / FASTER, now),
            Wish::Next => {
                let Some(due) = self.next_due() else { return Ok(None) };
                self.timeline.jump(due.max(self.timeline.position(now)), now);
                return Ok(self.advance());
            }
        }
        Ok(None)
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
        let played = self.timeline.position(now).min(next) - self.round.origin;
        Some(Stamp(self.begin.saturating_add(played.max(0.0) as i64)))
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
        self.round = Round { origin: origin + last + interval - first, ..Round::default() };
        let selected = self.bag.select(&self.selection);
        self.messages = ReadAhead::start(selected)
            .map_err(BagError::io(self.bag.path(), "starting to read again"))?;
        self.messages.next().transpose()
    }
}

fn check(options: &PlayerOptions) -> Result<(), PlayerError> {
    let PlayerOptions { rate, start_offset, duration, clock, .. } = options;
    let wrong = |field, found: &f64, expected| {
        Err(PlayerError::Option { field, found: found.to_string(), expected })
    };
    if !(rate.is_finite() && *rate > 0.0) {
        return wrong("rate", rate, "a positive number");
    }
    if !(start_offset.is_finite() && *start_offset >= 0.0) {
        return wrong("start-offset", start_offset, "seconds, 0 or more");
    }
    if let Some(clock) = clock.filter(|clock| !(clock.is_finite() && *clock > 0.0)) {
        return wrong("clock", &clock, "a positive number of times a second");
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
    fn a_paused_player_gives_one_message_a_wish_and_goes_on_from_there() {
        let directory = tempfile::tempdir().unwrap();
        let bag = bag(directory.path(), &[0, 100, 200, 300]);
        let options = PlayerOptions { paused: true, ..PlayerOptions::default() };
        let mut player = Player::new(&bag, options).unwrap();
        let at = Duration::from_millis;
        let time = |message: Option<BagMessage>| message.unwrap().log_time.0 / MILLISECOND;
        assert_eq!(player.poll(at(50)).unwrap(), Due::In(PAUSED));
        assert_eq!(time(player.wish(Wish::Next, at(50)).unwrap()), 0);
        assert_eq!(time(player.wish(Wish::Next, at(60)).unwrap()), 100);
        assert_eq!(player.poll(at(5_000)).unwrap(), Due::In(PAUSED));
        assert_eq!(player.wish(Wish::Pause, at(5_000)).unwrap(), None);
        assert_eq!(player.poll(at(5_000)).unwrap(), Due::In(at(100)));
        assert!(matches!(player.poll(at(5_100)).unwrap(), Due::Now(_)));
        player.wish(Wish::Faster, at(5_100)).unwrap();
        assert!((player.rate() - 1.1).abs() < 1e-12);
        let Due::In(wait) = player.poll(at(5_100)).unwrap() else { panic!("too early") };
        assert!((wait.as_secs_f64() - 0.1 / 1.1).abs() < 1e-6, "{wait:?}");
    }

    #[test]
    fn the_clock_tells_the_recorded_time_at_its_own_rate() {
        let directory = tempfile::tempdir().unwrap();
        let bag = bag(directory.path(), &[1_000, 1_500]);
        let options = PlayerOptions { rate: 2.0, clock: Some(10.0), ..PlayerOptions::default() };
        let mut player = Player::new(&bag, options).unwrap();
        let at = Duration::from_millis;
        let tick = |player: &mut Player, now| player.tick(now).map(|stamp| stamp.0 / MILLISECOND);
        assert_eq!(tick(&mut player, at(0)), Some(1_000));
        assert!(matches!(player.poll(at(0)).unwrap(), Due::Now(_)));
        assert_eq!(tick(&mut player, at(99)), None);
        assert_eq!(player.poll(at(99)).unwrap(), Due::In(at(1)));
        assert_eq!(tick(&mut player, at(100)), Some(1_200));
        assert_eq!(tick(&mut player, at(200)), Some(1_400));
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
            (PlayerOptions { clock: Some(0.0), ..Default::default() }, "clock: found 0, expected"),
            (PlayerOptions { start_offset: 9.0, ..Default::default() }, "found no message"),
        ];
        for (options, expected) in cases {
            let message = Player::new(&bag, options).err().unwrap().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }
}
