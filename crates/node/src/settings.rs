//! How a surrogate node behaves.

use std::ops::RangeInclusive;

use serde::Deserialize;

use super::parameters::PARAMETERS;
use eddy_settings::near;

/// Which of the frames up to the horizon are published.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
#[serde(rename_all = "lowercase")]
pub enum Publish {
    /// The one at the horizon.
    #[default]
    Last,
    /// Every one.
    All,
}

impl Publish {
    /// Their words.
    pub const NAMES: [&str; 2] = ["last", "all"];

    /// Its word.
    pub fn name(self) -> &'static str {
        Self::NAMES[self as usize]
    }

    /// The one with this word.
    pub fn named(word: &str) -> Option<Self> {
        [Self::Last, Self::All].into_iter().find(|publish| publish.name() == word)
    }
}

/// Settings of a [`SurrogateNode`](super::SurrogateNode). Each is a ROS parameter of the same name;
/// [`PARAMETERS`] has their ranges.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NodeSettings {
    /// Frames predicted ahead of each observed frame.
    pub horizon: u32,
    /// Which of them are published.
    pub publish: Publish,
    /// Observe so many frames of a stream, then simulate it alone. Off if not set.
    pub free_run: Option<u64>,
    /// Missing frames that the model fills with its own prediction; a larger gap resets the stream.
    pub max_gap: u64,
    /// Streams kept at the same time; the least recently used goes first.
    pub max_streams: usize,
    /// Frames that wait for the model. What happens when they are too many is the reliability's
    /// choice.
    pub queue: usize,
    /// Whether observed and predicted frames are also published as point clouds.
    pub cloud: bool,
    /// Whether free runs and stamps follow `/clock` ([`RosTime`](super::RosTime)).
    pub use_sim_time: bool,
}

impl Default for NodeSettings {
    fn default() -> Self {
        Self {
            horizon: 1,
            publish: Publish::Last,
            free_run: None,
            max_gap: 3,
            max_streams: 64,
            queue: 64,
            cloud: false,
            use_sim_time: false,
        }
    }
}

/// A setting that makes no sense.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum InvalidSettings {
    /// There is none of this name.
    #[error(
        "parameter: found {found}, expected one of {}{}",
        PARAMETERS.each_ref().map(|spec| spec.name).join(", "),
        near::hint(found, PARAMETERS.each_ref().map(|spec| spec.name))
    )]
    Unknown {
        /// The name.
        found: String,
    },
    /// It is of the wrong kind.
    #[error("{field}: found {found}, expected {expected}")]
    Kind {
        /// The setting.
        field: &'static str,
        /// The kind of the value.
        found: &'static str,
        /// The kind it should have.
        expected: &'static str,
    },
    /// It is out of its range.
    #[error("{field}: found {found}, expected {} to {}", range.start(), range.end())]
    Range {
        /// The setting.
        field: &'static str,
        /// Its value.
        found: i64,
        /// The values that make sense.
        range: RangeInclusive<i64>,
    },
    /// It is none of its words.
    #[error("{field}: found `{found}`, expected {expected}")]
    Word {
        /// The setting.
        field: &'static str,
        /// Its value.
        found: String,
        /// The words.
        expected: String,
    },
    /// There is no simulated time to follow.
    #[error("use_sim_time: found no /clock ({reason}), expected one to follow")]
    Clock {
        /// Why it cannot be subscribed to.
        reason: String,
    },
    /// It counts at the start only.
    #[error("{field}: found a value for a running node, expected it at the start (read-only)")]
    ReadOnly {
        /// The setting.
        field: &'static str,
    },
}

impl NodeSettings {
    /// Checks the ranges.
    ///
    /// # Errors
    /// [`InvalidSettings`] with the first setting that is out of its range.
    pub fn check(&self) -> Result<(), InvalidSettings> {
        // As a parameter, 0 stands for none; as a number of frames it makes no sense.
        if self.free_run == Some(0) {
            let range = 1..=i64::MAX;
            return Err(InvalidSettings::Range { field: "free_run", found: 0, range });
        }
        PARAMETERS.iter().try_for_each(|spec| spec.check(&spec.get(self)))
    }
}
