//! Repairs bags.
//!
//! 1. `recover`: copies what can be read of a damaged bag into a new one.
//! 2. `reindex`: writes missing and wrong summary sections and `metadata.yaml`; `indexes`: copies a file with new message indexes.

mod indexes;
mod recover;
mod reindex;

pub use recover::{Recovered, Recovery};
pub use reindex::{Reindexed, Reindexing};
