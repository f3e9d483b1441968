//! Options of a player, and why a bag cannot be played.

use eddy_bag::{BagError, QosOverrides};
use eddy_settings::near;

/// Options of a [`Player`](super::Player).
#[derive(Clone, Debug, PartialEq)]
pub struct PlayerOptions {
    /// Recorded time per real time; 1 by default.
    pub rate: f64,
    /// Recorded time to skip at the start (s); 0 by default.
    pub start_offset: f64,
    /// Recorded time to play (s); to the end if `None`.
    pub duration: Option<f64>,
    /// Restart at the end.
    pub looped: bool,
    /// Topics to play; all if `None`.
    pub topics: Option<Vec<String>>,
    /// Rate of the recorded time on `/clock` (Hz of real time); none if `None`.
    pub clock: Option<f64>,
    /// Start paused.
    pub paused: bool,
    /// Quality of service in place of the recorded one: what transient-local publishers had kept where playback begins is
    /// published first.
    pub overrides: QosOverrides,
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
            overrides: QosOverrides::new(),
        }
    }
}

/// Why a bag cannot be played.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message says what the fields are")]
pub enum PlayerError {
    /// An option is out of range.
    #[error("{field}: found {found}, expected {expected}")]
    Option { field: &'static str, found: String, expected: &'static str },
    /// The bag lacks a topic.
    #[error(
        "topics: found {found}, expected one of {}{}",
        topics.join(", "),
        near::hint(found, topics.iter().map(String::as_str))
    )]
    Topic { found: String, topics: Vec<String> },
    /// No message is selected.
    #[error("{bag}: no messages on the selected topics in the selected time")]
    Nothing { bag: String },
    /// The reading thread cannot be started.
    #[error("cannot start the reading thread: {0}")]
    Thread(std::io::Error),
    /// The bag is damaged before its first message.
    #[error(transparent)]
    Bag(#[from] BagError),
}

impl PlayerOptions {
    /// Checks the ranges.
    pub(crate) fn check(&self) -> Result<(), PlayerError> {
        let Self { rate, start_offset, duration, clock, .. } = self;
        let wrong = |field, found: &f64, expected| {
            Err(PlayerError::Option { field, found: found.to_string(), expected })
        };
        if !(rate.is_finite() && *rate > 0.0) {
            return wrong("rate", rate, "a positive number");
        }
        if !(start_offset.is_finite() && *start_offset >= 0.0) {
            return wrong("start-offset", start_offset, "0 s or more");
        }
        if let Some(clock) = clock.filter(|clock| !(clock.is_finite() && *clock > 0.0)) {
            return wrong("clock", &clock, "a positive frequency (Hz)");
        }
        match duration {
            Some(seconds) if !(seconds.is_finite() && *seconds > 0.0) => {
                wrong("duration", seconds, "more than 0 s")
            }
            _ => Ok(()),
        }
    }
}
