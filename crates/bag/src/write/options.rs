//! Options of a new bag.

use std::time::Duration;

/// How chunks are compressed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(feature = "clap", derive(clap::ValueEnum))]
pub enum Compression {
    /// Not compressed.
    None,
    /// LZ4: fast.
    Lz4,
    /// Zstandard, level 3: small.
    #[default]
    Zstd,
}

/// Options of a [`BagWriter`](crate::BagWriter).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct WriterOptions {
    /// Compression of the chunks [default: zstd].
    pub compression: Compression,
    /// Size at which a chunk ends, before compression (bytes) [default: 1 MiB].
    pub chunk_size: u64,
    /// When the bag is split into files [default: never].
    pub split: Split,
}

/// When a bag is split: whichever limit is reached first.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Split {
    /// Largest size of a finished file (bytes). A larger message, together with the channels, gets a file of
    /// its own.
    pub size: Option<u64>,
    /// Longest time from the first message of a file to its last.
    pub duration: Option<Duration>,
}

impl Default for WriterOptions {
    fn default() -> Self {
        let (compression, split) = (Compression::default(), Split::default());
        Self { compression, chunk_size: 1 << 20, split }
    }
}
