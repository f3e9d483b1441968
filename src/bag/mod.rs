//! Bags: MCAP files as rosbag2 writes them, in a directory with `metadata.yaml` or alone.
//!
//! Writing:
//! 1. `layout`: which files a bag has, where bags are.
//! 2. `writer`: messages into chunks; `*.mcap.active` until it is finished.
//! 3. `metadata`: `metadata.yaml`, version 9.
//!
//! Reading:
//! 4. `record`: the records of a file, one after the other.
//! 5. `index`: where messages lie in a file: from its summary, or by walking through the file.
//! 6. `segment`: one piece of a file, decompressed and checked.
//! 7. `messages`: the pieces of all files, merged by time.
//! 8. `reader`: topics, messages and frames of a bag.
//! 9. `survey`: everything that can be wrong with a bag.
//!
//! Sources: MCAP specification (<https://mcap.dev/spec>), rosbag2's MCAP storage plugin
//! (`rosbag2_storage_mcap`) and its metadata (`rosbag2_storage/src/.../metadata_io.cpp`).

mod error;
mod index;
mod layout;
mod messages;
mod metadata;
mod reader;
mod record;
mod segment;
mod survey;
mod writer;

pub use error::BagError;
pub use layout::find_bags;
pub use messages::{BagMessage, Messages, Selection};
pub use reader::{BagReader, Frames, TopicInfo};
pub use survey::{StreamSurvey, Survey, TopicSurvey};
pub use writer::{BagSummary, BagWriter, Compression, TopicId, WriterOptions, WrittenTopic};
