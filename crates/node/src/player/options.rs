//! How a bag is played, and why it cannot be.

use eddy_bag::BagError;
use eddy_settings::near;

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
    /// The bag does not have a topic.
    #[error(
        "topics: found {found}, expected one of {}{}",
        topics.join(", "),
        near::hint(found, topics.iter().map(String::as_str))
    )]
    Topic {
        /// The topic asked for.
        found: String,
        /// The topics there are.
        topics: Vec<String>,
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

impl PlayerOptions {
    /// Refuses what makes no sense.
    pub(crate) fn check(&self) -> Result<(), PlayerError> {
        let Self { rate, start_offset, duration, clock, .. } = self;
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
}
