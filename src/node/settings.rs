//! How a surrogate node behaves.

use std::ops::RangeInclusive;

use serde::Deserialize;

/// Which of the frames up to the horizon are published.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, clap::ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Publish {
    /// The one at the horizon.
    #[default]
    Last,
    /// Every one.
    All,
}

/// Frames that can be predicted ahead of an observed frame.
pub const HORIZON: RangeInclusive<u32> = 1..=10_000;

/// Settings of a [`SurrogateNode`](super::SurrogateNode).
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NodeSettings {
    /// Frames predicted ahead of each observed frame, in [`HORIZON`].
    pub horizon: u32,
    /// Which of them are published.
    pub publish: Publish,
    /// Observe so many frames of a stream, then simulate it alone. Off if not set.
    pub free_run: Option<u64>,
    /// Missing frames that the model fills with its own prediction; a larger gap resets the stream.
    /// At most 1,000.
    pub max_gap: u64,
    /// Streams kept at the same time; the least recently used goes first. 1 to 65,536.
    pub max_streams: usize,
    /// Frames that wait for the model; 1 to 65,536. What happens when they are too many is the
    /// reliability's choice.
    pub queue: usize,
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
        }
    }
}

/// A setting is out of its range.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("{field}: found {found}, expected {} to {}", range.start(), range.end())]
pub struct InvalidSettings {
    /// The setting.
    pub field: &'static str,
    /// Its value.
    pub found: u64,
    /// The values that make sense.
    pub range: RangeInclusive<u64>,
}

impl NodeSettings {
    /// Checks the ranges.
    ///
    /// # Errors
    /// [`InvalidSettings`] with the first setting that is out of its range.
    pub fn check(&self) -> Result<(), InvalidSettings> {
        let horizons = u64::from(*HORIZON.start())..=u64::from(*HORIZON.end());
        let ranges = [
            ("horizon", u64::from(self.horizon), horizons),
            ("free_run", self.free_run.unwrap_or(1), 1..=u64::MAX),
            ("max_gap", self.max_gap, 0..=1_000),
            ("max_streams", self.max_streams as u64, 1..=65_536),
            ("queue", self.queue as u64, 1..=65_536),
        ];
        match ranges.into_iter().find(|(_, found, range)| !range.contains(found)) {
            None => Ok(()),
            Some((field, found, range)) => Err(InvalidSettings { field, found, range }),
        }
    }
}
