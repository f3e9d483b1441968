//! What bags consist of.
//!
//! 1. `channel`, `qos`: channels and schemas, QoS profiles.
//! 2. `parse`: bodies of records, with their lengths checked.
//! 3. `summary`: a finished bag, its files and topics.
//! 4. `description`: what a bag says of itself; `metadata`: `metadata.yaml`, version 9; `custom_data`: its free entries.
//! 5. `layout`: which files a bag has, where bags are.

pub(crate) mod channel;
pub mod custom_data;
pub(crate) mod description;
pub(crate) mod layout;
pub(crate) mod metadata;
pub(crate) mod parse;
pub(crate) mod qos;
pub(crate) mod summary;
