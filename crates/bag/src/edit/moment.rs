//! A point in time of a bag, as users write it.

use std::str::FromStr;

use eddy_frames::Stamp;

/// A point in time of a bag: `2.5` (seconds after its start) or `1700000000000000000ns` (log time).
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum BagTime {
    /// Time after the first message (s).
    After(f64),
    /// Log time.
    At(Stamp),
}

/// A text that is not a [`BagTime`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "time: found `{found}`, expected seconds from the start, such as 2.5, or a log time, such as 1700000000000000000ns"
)]
pub struct InvalidBagTime {
    /// The text.
    pub found: String,
}

impl BagTime {
    /// The log time in a bag that starts at `start`.
    pub fn in_bag(self, start: Stamp) -> Stamp {
        match self {
            Self::After(seconds) => Stamp(start.0.saturating_add(Stamp::from_seconds(seconds).0)),
            Self::At(time) => time,
        }
    }
}

impl FromStr for BagTime {
    type Err = InvalidBagTime;

    fn from_str(text: &str) -> Result<Self, InvalidBagTime> {
        let invalid = || InvalidBagTime { found: text.to_owned() };
        if let Some(nanoseconds) = text.strip_suffix("ns") {
            let time = nanoseconds.parse().ok().filter(|&time: &i64| time >= 0);
            return time.map(|time| Self::At(Stamp(time))).ok_or_else(invalid);
        }
        let seconds =
            text.parse().ok().filter(|seconds: &f64| seconds.is_finite() && *seconds >= 0.0);
        seconds.map(Self::After).ok_or_else(invalid)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn seconds_count_from_the_start_and_nanoseconds_from_the_epoch() {
        let at = |text: &str| text.parse::<BagTime>().unwrap().in_bag(Stamp(1_000));
        assert_eq!(at("0"), Stamp(1_000));
        assert_eq!(at("2.5"), Stamp(2_500_001_000));
        assert_eq!(at("1700000000000000000ns"), Stamp(1_700_000_000_000_000_000));
    }

    #[test]
    fn other_texts_are_rejected_with_what_was_expected() {
        for text in ["", "-1", "soon", "1e999", "-5ns", "2.5ns"] {
            let message = text.parse::<BagTime>().unwrap_err().to_string();
            assert!(message.starts_with(&format!("time: found `{text}`, expected")), "{message}");
        }
    }
}
