//! `custom_data` in `metadata.yaml`, and its keys.

use std::collections::BTreeMap;

/// The entries.
pub type CustomData = BTreeMap<String, String>;

/// Young's modulus of all matter in the bag (density x velocity^2).
pub const STIFFNESS: &str = "eddy_stiffness";
/// Number of received messages that are not in the bag.
pub const MESSAGES_NOT_RECORDED: &str = "eddy_messages_not_recorded";
/// Links that could not be recorded.
pub const TOPICS_NOT_RECORDED: &str = "eddy_topics_not_recorded";
/// Links that failed while they were recorded.
pub const TOPICS_RECORDED_IN_PART: &str = "eddy_topics_recorded_in_part";
/// What a recording has lost. Copies do not keep it: it need not be true of a part of a bag, or of several bags together.
pub const LOSSES: [&str; 3] = [MESSAGES_NOT_RECORDED, TOPICS_NOT_RECORDED, TOPICS_RECORDED_IN_PART];

/// Checks an entry that somebody gives a new bag.
///
/// # Errors
/// What was expected instead: another key, if eddy writes this one itself, or a positive number for [`STIFFNESS`].
pub fn check_entry(key: &str, value: &str) -> Result<(), &'static str> {
    if LOSSES.contains(&key) {
        return Err("another key: eddy writes this one");
    }
    if key == STIFFNESS && parse_stiffness(value).is_none() {
        return Err("a positive number");
    }
    Ok(())
}

/// A stiffness (density x velocity^2); `None` unless it is a positive number.
pub fn parse_stiffness(text: &str) -> Option<f32> {
    text.parse().ok().filter(|&stiffness| is_stiffness(stiffness))
}

/// Whether a number can be a stiffness: it is positive and finite.
pub fn is_stiffness(number: f32) -> bool {
    number.is_finite() && number > 0.0
}
