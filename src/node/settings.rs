//! How a surrogate node behaves.

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

/// Settings of a [`SurrogateNode`](super::SurrogateNode).
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct NodeSettings {
    /// Frames predicted ahead of each observed frame; at least 1.
    pub horizon: u32,
    /// Which of them are published.
    pub publish: Publish,
    /// Observe so many frames of a stream, then simulate it alone. Off if not set.
    pub free_run: Option<u64>,
    /// Missing frames that the model fills with its own prediction; a larger gap resets the stream.
    pub max_gap: u64,
    /// Streams kept at the same time; the least recently used goes first. At least 1.
    pub max_streams: usize,
    /// Frames that wait for the model; at least 1. What happens when they are too many is the
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
#[error("{field}: found {found}, expected at least {least}")]
pub struct InvalidSettings {
    /// The setting.
    pub field: &'static str,
    /// Its value.
    pub found: u64,
    /// The smallest value that makes sense.
    pub least: u64,
}

impl NodeSettings {
    /// Checks the ranges.
    ///
    /// # Errors
    /// [`InvalidSettings`] with the first setting that is too small.
    pub fn check(&self) -> Result<(), InvalidSettings> {
        let at_least_one = [
            ("horizon", u64::from(self.horizon)),
            ("max_streams", self.max_streams as u64),
            ("queue", self.queue as u64),
            ("free_run", self.free_run.unwrap_or(1)),
        ];
        match at_least_one.into_iter().find(|&(_, value)| value == 0) {
            None => Ok(()),
            Some((field, found)) => Err(InvalidSettings { field, found, least: 1 }),
        }
    }
}
