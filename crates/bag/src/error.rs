//! What can be wrong with a bag.

use std::{io, path::PathBuf};

use eddy_messages::{BadFrame, UnknownType};
use eddy_settings::near;

/// Why a bag could not be written or read. Paths name the bag or the file in it that is concerned.
#[derive(Debug, thiserror::Error)]
pub enum BagError {
    /// The operating system refused.
    #[error("{path}: {action}: {reason}", path = .path.display())]
    Io {
        /// The file or directory.
        path: PathBuf,
        /// What was tried.
        action: &'static str,
        /// What the system said.
        reason: io::Error,
    },
    /// A new bag would overwrite something.
    #[error("{path}: found something of that name, expected a bag directory that does not exist yet", path = .path.display())]
    Exists {
        /// The directory asked for.
        path: PathBuf,
    },
    /// The path is no bag.
    #[error("{path}: found {found}, expected a bag directory, an .mcap file or an .mcap.active file", path = .path.display())]
    NotABag {
        /// The path.
        path: PathBuf,
        /// What is there.
        found: String,
    },
    /// No bag lies beneath any of the paths.
    #[error("{paths}: found no bag, expected bag directories or .mcap files there", paths = .paths.iter().map(|path| path.display().to_string()).collect::<Vec<_>>().join(", "))]
    NoBags {
        /// Where was searched.
        paths: Vec<PathBuf>,
    },
    /// `metadata.yaml` cannot be used.
    #[error("{path}: {field}: found {found}, expected {expected}", path = .path.display())]
    Metadata {
        /// The file `metadata.yaml`.
        path: PathBuf,
        /// The key in it.
        field: &'static str,
        /// What it holds.
        found: String,
        /// What it should hold.
        expected: &'static str,
    },
    /// The file is no MCAP.
    #[error("{path}: found the first bytes {found:02x?}, expected 89 4d 43 41 50 30 0d 0a (MCAP)", path = .path.display())]
    Magic {
        /// The file.
        path: PathBuf,
        /// Its first bytes, at most eight.
        found: Vec<u8>,
    },
    /// The file ends too early. Everything before the cut was readable.
    #[error("{path}: found the end of the file at byte {size}, {messages} whole messages before it, expected {expected}", path = .path.display())]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Length of the file (bytes).
        size: u64,
        /// Whole messages before the end.
        messages: u64,
        /// What should have come.
        expected: String,
    },
    /// Bytes in the file are not what they should be.
    #[error("{path}: byte {position}: found {found}, expected {expected}", path = .path.display())]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// Where the record starts that is concerned.
        position: u64,
        /// What is there.
        found: String,
        /// What should be there.
        expected: String,
    },
    /// More is wrong with the bag than is said one by one.
    #[error("{path}: found {faults} more faults, expected none", path = .path.display())]
    FurtherFaults {
        /// The bag.
        path: PathBuf,
        /// How many.
        faults: u64,
    },
    /// The writer of the file format refused.
    #[error("{path}: writing MCAP: {reason}", path = .path.display())]
    Format {
        /// The file.
        path: PathBuf,
        /// Why.
        reason: String,
    },
    /// A topic was given a second type.
    #[error("{path}: topic {topic}: found type {found}, expected {expected}", path = .path.display())]
    TopicType {
        /// The bag.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// Its type here.
        found: String,
        /// The type it should have.
        expected: String,
    },
    /// The bag does not have the topic.
    #[error("{path}: topics: found {found}, expected {topic} among them{hint}", path = .path.display(), hint = near::hint(topic, found.split([' ', ','])))]
    NoTopic {
        /// The bag.
        path: PathBuf,
        /// The topic asked for.
        topic: String,
        /// The topics there are, with their types.
        found: String,
    },
    /// The topic is there, but not one message of it.
    #[error("{path}: topic {topic}: found 0 messages, expected at least 1", path = .path.display())]
    NoMessages {
        /// The bag.
        path: PathBuf,
        /// The topic.
        topic: String,
    },
    /// A message of a topic of frames is no usable frame.
    #[error("{path}: topic {topic}, message {message}: {reason}", path = .path.display())]
    Frame {
        /// The bag.
        path: PathBuf,
        /// The topic.
        topic: String,
        /// Number of the message on its topic, from 0, in log-time order.
        message: u64,
        /// What is wrong with it.
        reason: BadFrame,
    },
    /// MCAP counts nanoseconds from 0 upwards.
    #[error("{path}: topic {topic}: {field}: found {found} ns, expected 0 or later", path = .path.display())]
    NegativeTime {
        /// The bag.
        path: PathBuf,
        /// The topic of the message.
        topic: String,
        /// `log_time` or `publish_time`.
        field: &'static str,
        /// The time (ns).
        found: i64,
    },
    /// There is no message that a new bag could have.
    #[error("{path}: found no message to write into it, expected at least 1", path = .path.display())]
    Nothing {
        /// The bag that was not written.
        path: PathBuf,
    },
    /// The user wanted no more.
    #[error("{path}: interrupted before the work was done, nothing was changed", path = .path.display())]
    Interrupted {
        /// The bag that was not written, or the file that was being read.
        path: PathBuf,
    },
    /// The user wanted no more when some files of a bag had been replaced.
    #[error("{path}: interrupted after {summarized} of {expected} files: they have a summary now, the other files and metadata.yaml are as they were", path = .path.display())]
    PartlyReindexed {
        /// The bag.
        path: PathBuf,
        /// How many files have a summary now that had none.
        summarized: usize,
        /// How many had none.
        expected: usize,
    },
    /// A file is still being written, or was left so.
    #[error("{path}: found a file that was never closed, expected finished files", path = .path.display())]
    Unfinished {
        /// The file.
        path: PathBuf,
    },
    /// The topic's message type is not one of ours.
    #[error("topic {topic}: {reason}")]
    Type {
        /// The topic.
        topic: String,
        /// The name that is not known.
        reason: UnknownType,
    },
}

impl BagError {
    /// Whether it happened because the disk is full, or because the file or its owner reached a limit.
    pub fn is_no_room(&self) -> bool {
        matches!(self, Self::Io { reason, .. } if Self::is_out_of_room(reason))
    }

    pub(super) fn is_out_of_room(error: &io::Error) -> bool {
        use io::ErrorKind::{FileTooLarge, QuotaExceeded, StorageFull};
        matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge)
    }

    /// Whether the disk has these bytes but cannot read them: a bad sector. What is beside them may be
    /// readable.
    pub(super) fn is_unreadable(error: &io::Error) -> bool {
        rustix::io::Errno::from_io_error(error) == Some(rustix::io::Errno::IO)
    }

    /// For `map_err`: an [`BagError::Io`] of `action` on `path`.
    pub fn io(path: impl Into<PathBuf>, action: &'static str) -> impl FnOnce(io::Error) -> Self {
        let path = path.into();
        move |reason| Self::Io { reason: near::in_folder(&path, reason), path, action }
    }
}
