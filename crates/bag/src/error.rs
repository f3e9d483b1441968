//! Errors of bags.

use std::{io, path::PathBuf};

use eddy_messages::{BadFrame, BadTool, UnknownType};
use eddy_settings::near;

/// `: stream 3, frame 7`, if they are known.
pub(crate) fn in_stream(place: Option<(u64, u64)>) -> String {
    place.map_or_else(String::new, |(stream, frame)| format!(": stream {stream}, frame {frame}"))
}

/// Why a bag cannot be written or read. Paths name the bag, or the file in it.
#[derive(Debug, thiserror::Error)]
#[expect(missing_docs, reason = "the message of each variant says what its fields are")]
pub enum BagError {
    /// The operating system reports an error.
    #[error("{path}: {action}: {reason}", path = .path.display())]
    Io { path: PathBuf, action: &'static str, reason: io::Error },
    /// A new bag would overwrite a file or directory.
    #[error("{path}: already exists; choose another output path or delete it", path = .path.display())]
    Exists { path: PathBuf },
    /// The path is not a bag.
    #[error("{path}: found {found}, expected a bag directory, an .mcap file or an .mcap.active file", path = .path.display())]
    NotABag { path: PathBuf, found: String },
    /// None of the paths contains a bag.
    #[error("{paths}: found no bag, expected bag directories or .mcap files there", paths = .paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", "))]
    NoBags { paths: Vec<PathBuf> },
    /// A field of `metadata.yaml` cannot be used.
    #[error("{path}: {field}: found {found}, expected {expected}", path = .path.display())]
    Metadata { path: PathBuf, field: &'static str, found: String, expected: &'static str },
    /// The file is not an MCAP file; `found` holds its first bytes, at most eight.
    #[error("{path}: found the first bytes {found:02x?}, expected 89 4d 43 41 50 30 0d 0a (MCAP)", path = .path.display())]
    Magic { path: PathBuf, found: Vec<u8> },
    /// The file holds the address of the data, as Git LFS leaves it where the data was not fetched.
    #[error("{path}: found a pointer of Git LFS instead of the data; `git lfs pull` fetches it", path = .path.display())]
    LfsPointer { path: PathBuf },
    /// The file of `size` bytes is truncated; everything before its end is readable.
    #[error("{path}: found the end of the file at byte {size} after {messages} complete messages, expected {expected}", path = .path.display())]
    Truncated { path: PathBuf, size: u64, messages: u64, expected: String },
    /// The record at byte `position` is damaged.
    #[error("{path}: byte {position}: found {found}, expected {expected}", path = .path.display())]
    Corrupt { path: PathBuf, position: u64, found: String, expected: String },
    /// Follows the errors that are listed one by one.
    #[error("{path}: {count} more errors, not listed", path = .path.display())]
    MoreErrors { path: PathBuf, count: u64 },
    /// The MCAP library rejects what is to be written.
    #[error("{path}: writing MCAP: {reason}", path = .path.display())]
    Format { path: PathBuf, reason: String },
    /// A topic has a second type.
    #[error("{path}: topic {topic}: found type {found}, expected {expected}", path = .path.display())]
    TopicType { path: PathBuf, topic: String, found: String, expected: String },
    /// The bag does not have the topic; `found` lists its topics and their types.
    #[error("{path}: topics: found {found}, expected {topic} among them{hint}", path = .path.display(), hint = near::hint(topic, found.split([' ', ','])))]
    NoTopic { path: PathBuf, topic: String, found: String },
    /// The topic has no messages.
    #[error("{path}: topic {topic}: found 0 messages, expected at least 1", path = .path.display())]
    NoMessages { path: PathBuf, topic: String },
    /// A message on a topic of frames is not a valid frame; `message` counts from 0 in log-time order.
    #[error("{path}: topic {topic}, message {message}{}: {reason}", in_stream(*place), path = .path.display())]
    Frame {
        path: PathBuf,
        topic: String,
        message: u64,
        /// Stream id and sequence number, unless the message is too short for them.
        place: Option<(u64, u64)>,
        reason: Box<BadFrame>,
    },
    /// A message on a topic of tools cannot be used; `message` counts from 0 in log-time order.
    #[error("{path}: topic {topic}, message {message}: {reason}", path = .path.display())]
    Tools { path: PathBuf, topic: String, message: u64, reason: Box<BadTool> },
    /// MCAP's times are unsigned; `field` is `log_time` or `publish_time`.
    #[error("{path}: topic {topic}: {field}: found {found} ns, expected 0 or later", path = .path.display())]
    NegativeTime { path: PathBuf, topic: String, field: &'static str, found: i64 },
    /// The new bag would have no messages.
    #[error("{path}: found no messages to write, expected at least 1", path = .path.display())]
    Nothing { path: PathBuf },
    /// The progress callback stopped the operation.
    #[error("{path}: interrupted; nothing was changed", path = .path.display())]
    Interrupted { path: PathBuf },
    /// The progress callback stopped the operation after some files of the bag had been replaced.
    #[error("{path}: interrupted after {summarized} of {expected} files: these have a summary now, the other files and metadata.yaml are unchanged", path = .path.display())]
    PartlyReindexed { path: PathBuf, summarized: usize, expected: usize },
    /// The file is still being written, or its writer was killed.
    #[error("{path}: found an unfinished file, expected finished files", path = .path.display())]
    Unfinished { path: PathBuf },
    /// The message type is not part of eddy-messages.
    #[error("topic {topic}: {reason}")]
    Type { topic: String, reason: UnknownType },
}

impl BagError {
    /// Whether the disk is full, or a quota or file size limit is reached.
    pub fn is_disk_full(&self) -> bool {
        matches!(self, Self::Io { reason, .. } if Self::means_disk_full(reason))
    }

    pub(crate) fn means_disk_full(error: &io::Error) -> bool {
        use io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
        matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge)
    }

    /// Whether the disk reports a bad sector. The bytes beside it may be readable.
    pub(crate) fn is_unreadable(error: &io::Error) -> bool {
        rustix::io::Errno::from_io_error(error) == Some(rustix::io::Errno::IO)
    }

    /// For `map_err`: a [`BagError::Io`] of `action` on `path`.
    pub fn io(path: impl Into<PathBuf>, action: &'static str) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |reason| Self::Io { reason: near::in_folder(&path, reason), path, action }
    }
}
