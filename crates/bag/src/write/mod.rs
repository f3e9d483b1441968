//! Writes bags.
//!
//! 1. `options`: compression, chunk size, when to split.
//! 2. `finish`: ends a file whose writer could not: data end, summary section, footer.
//! 3. `file`: one MCAP file, `*.mcap.active` until it is finished.
//! 4. `bag`: topics and messages of a bag, split into files.

pub(crate) mod bag;
pub(crate) mod file;
pub(crate) mod finish;
pub(crate) mod options;
