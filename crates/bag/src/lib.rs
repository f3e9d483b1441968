//! Bags: MCAP files as rosbag2 writes them, in a directory with `metadata.yaml` or alone.
//!
//! Imports run one way, from the end of this list to its start:
//! 1. `format`: channels, QoS profiles, `metadata.yaml`, the files of a bag.
//! 2. `read`: indexes files, also damaged ones, and reads their messages in the order of time.
//! 3. `write`: writes messages into a bag, split into files.
//! 4. `edit`: makes bags from bags: extract, merge, point clouds.
//! 5. `repair`: recovers damaged bags, reindexes files.
//!
//! Sources: MCAP specification (<https://mcap.dev/spec>), rosbag2's MCAP storage plugin
//! (`rosbag2_storage_mcap`) and its metadata (`rosbag2_storage/src/.../metadata_io.cpp`).

mod edit;
mod error;
mod format;
mod read;
mod repair;
mod write;

pub use edit::{
    BagTime, CopyOptions, InvalidBagTime, MergedBag, TopicFilter, clouds, extract, merge,
    topics_without_cloud,
};
pub use error::BagError;
pub use format::{
    channel::{Channel, Schema},
    custom_data,
    layout::find_bags,
    qos::{QosOverrides, read_qos_overrides},
    summary::{BagSummary, WrittenFile, WrittenTopic},
};
pub use read::{
    contents::TopicInfo,
    messages::{BagMessage, Messages, Selection},
    reader::{BagReader, Frames},
    survey::{Finding, StreamSurvey, Survey, TopicSurvey},
    tools::RecordedTools,
};
pub use repair::{Recovered, Recovery, Reindexed, Reindexing};
pub use write::{
    bag::{BagWriter, TopicId},
    file::is_being_written,
    options::{Compression, Split, WriterOptions},
};

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
