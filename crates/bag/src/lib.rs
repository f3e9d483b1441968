//! Bags: MCAP files as rosbag2 writes them, in a directory with `metadata.yaml` or alone.
//!
//! Writing:
//! 1. `layout`: which files a bag has, where bags are.
//! 2. `channel`: a topic as its writer described it.
//! 3. `writer`: messages into a bag, split into files.
//! 4. `part`: one file: messages into chunks; `*.mcap.active` until it is finished.
//! 5. `summary`: the end of a file whose writer could not write it.
//! 6. `qos`, `metadata`: `metadata.yaml`, version 9.
//!
//! Reading:
//! 7. `record`: the records of a file, one after the other; `parse`: what is in them; `extra`: those
//!    beside messages.
//! 8. `index`: where messages lie in a file: from its summary, or by a `walk` through the file;
//!    `resync` finds where to go on behind damage.
//! 9. `segment`: one piece of a file, decompressed and checked; `faults`: what is found wrong.
//! 10. `messages`: the pieces of all files, merged by time.
//! 11. `reader`: topics, messages and frames of a bag.
//! 12. `survey`: everything that can be wrong with a bag.
//!
//! Bags from bags:
//! 13. `draft`: a new bag that appears when it is whole.
//! 14. `edit`: extract, merge, recover, clouds, reindex.
//!
//! Sources: MCAP specification (<https://mcap.dev/spec>), rosbag2's MCAP storage plugin
//! (`rosbag2_storage_mcap`) and its metadata (`rosbag2_storage/src/.../metadata_io.cpp`).

mod channel;
mod draft;
mod edit;
mod error;
mod extra;
mod faults;
mod index;
mod layout;
mod messages;
mod metadata;
mod parse;
mod part;
mod qos;
mod reader;
mod record;
mod resync;
mod segment;
mod summary;
mod survey;
mod walk;
mod writer;

pub use channel::{Channel, Schema};
pub use edit::{
    CopyOptions, InvalidMoment, Moment, Recovered, Recovery, Reindexed, Reindexing, TopicChoice,
    clouds, extract, merge, without_cloud,
};
pub use error::BagError;
pub use layout::find_bags;
pub use messages::{BagMessage, Messages, Selection};
pub use reader::{BagReader, Frames, TopicInfo};
pub use survey::{StreamSurvey, Survey, TopicSurvey};
pub use writer::{
    BagSummary, BagWriter, Compression, Split, TopicId, WriterOptions, WrittenFile, WrittenTopic,
};

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
