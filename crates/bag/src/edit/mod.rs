//! Edits bags; every edit writes a new bag. Messages keep their bytes, sequence numbers and times, and their channels stay as they
//! are. All attachments and metadata records are copied, except those with which rosbag2 describes the old file.
//!
//! 1. `topic_filter`: selects topics by name and by pattern.
//! 2. `moment`: a point in time of a bag, as users write it.
//! 3. `staged`: a new bag that appears when it is complete; `copy`: copies messages into it.
//! 4. `extract`: topics and times of a bag; `merge`: several bags; `clouds`: frames also as point clouds.

mod clouds;
pub(crate) mod copy;
mod extract;
mod merge;
mod moment;
mod staged;
mod topic_filter;

pub use clouds::{clouds, topics_without_cloud};
pub use copy::CopyOptions;
pub use extract::extract;
pub use merge::{MergedBag, merge};
pub use moment::{BagTime, InvalidBagTime};
pub use topic_filter::TopicFilter;
