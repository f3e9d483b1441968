//! Reads bags.
//!
//! 1. `records`: steps through the records of a file; `resync`: finds where to continue after damage.
//! 2. `block`: a chunk or consecutive messages outside chunks, decompressed and checked.
//! 3. `auxiliary`: attachments and metadata records.
//! 4. `index`: where the messages of a file are; read from its `summary` section or made by a `scan` of the whole
//!    file, as `open` decides; `confirm` asks the message indexes whether the summary is right, `statements` compares what a file
//!    says twice with its messages. `error_log`: the damage.
//! 5. `contents`: files and topics of an open bag; `messages`: its messages, merged by time.
//!    `kept`: those that publishers have kept for late subscribers at a moment.
//! 6. `reader`: topics, messages and frames of a bag.
//!    `tools`: the tools of its streams.
//! 7. `survey`: a check of everything in a bag; `agreement`: of what `metadata.yaml` says.

mod agreement;
pub(crate) mod auxiliary;
pub(crate) mod block;
mod confirm;
pub(crate) mod contents;
pub(crate) mod error_log;
pub(crate) mod index;
mod kept;
pub(crate) mod messages;
pub(crate) mod open;
pub(crate) mod reader;
pub(crate) mod records;
mod resync;
mod scan;
mod statements;
mod summary;
pub(crate) mod survey;
pub(crate) mod tools;
