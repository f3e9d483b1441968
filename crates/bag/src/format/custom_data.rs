//! `custom_data` in `metadata.yaml`, and its keys.

use std::collections::BTreeMap;

/// The entries.
pub type CustomData = BTreeMap<String, String>;

/// Young's modulus of all matter in the bag (density x velocity^2).
pub const STIFFNESS: &str = "eddy_stiffness";
/// Gravity along y in the bag: negative is down (domain lengths per s^2).
pub const GRAVITY: &str = "eddy_gravity";
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
/// What was expected instead: another key, if eddy writes this one itself, or a number in the range of its [`Quantity`].
pub fn check_entry(key: &str, value: &str) -> Result<(), &'static str> {
    if LOSSES.contains(&key) {
        return Err("another key: eddy writes this one");
    }
    match Quantity::ALL.into_iter().find(|quantity| quantity.key() == key) {
        Some(quantity) if quantity.parse(value).is_none() => Err(quantity.expected()),
        _ => Ok(()),
    }
}

/// A number about the matter in a bag that its frames do not show.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// [`STIFFNESS`].
    Stiffness,
    /// [`GRAVITY`].
    Gravity,
}

impl Quantity {
    /// All of them.
    pub const ALL: [Self; 2] = [Self::Stiffness, Self::Gravity];

    /// Its key.
    pub fn key(self) -> &'static str {
        match self {
            Self::Stiffness => STIFFNESS,
            Self::Gravity => GRAVITY,
        }
    }

    /// What its value must be.
    pub fn expected(self) -> &'static str {
        match self {
            Self::Stiffness => "a positive number",
            Self::Gravity => "a number: gravity along y, negative is down",
        }
    }

    /// Whether a number can be its value.
    pub fn holds(self, number: f32) -> bool {
        number.is_finite() && (self == Self::Gravity || number > 0.0)
    }

    /// Its value in a text; `None` unless the text is a number in its range.
    pub fn parse(self, text: &str) -> Option<f32> {
        text.parse().ok().filter(|&number| self.holds(number))
    }

    /// Its value in these entries, if they have one.
    ///
    /// # Errors
    /// The entry, unless it is a number in its range.
    pub fn stated_in(self, entries: &CustomData) -> Result<Option<f32>, &str> {
        let Some(text) = entries.get(self.key()) else { return Ok(None) };
        self.parse(text).map(Some).ok_or(text)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn entries_about_the_matter_are_numbers_in_their_ranges() {
        let accepted = [
            (STIFFNESS, "1e5"),
            (GRAVITY, "-9.8"),
            (GRAVITY, "0"),
            (GRAVITY, "1.6"),
            ("run", "seven"),
        ];
        for (key, value) in accepted {
            assert_eq!(check_entry(key, value), Ok(()), "{key}={value}");
        }
        let rejected = [
            (STIFFNESS, "0"),
            (STIFFNESS, "-1"),
            (GRAVITY, "down"),
            (GRAVITY, "inf"),
            (LOSSES[0], "1"),
        ];
        for (key, value) in rejected {
            assert!(check_entry(key, value).is_err(), "{key}={value}");
        }
        let entries = CustomData::from([(GRAVITY.to_owned(), "-1.6".to_owned())]);
        assert_eq!(Quantity::Gravity.stated_in(&entries), Ok(Some(-1.6)));
        assert_eq!(Quantity::Stiffness.stated_in(&entries), Ok(None));
        let entries = CustomData::from([(GRAVITY.to_owned(), "-1,6".to_owned())]);
        assert_eq!(Quantity::Gravity.stated_in(&entries), Err("-1,6"));
    }
}
