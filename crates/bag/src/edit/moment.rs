//! A point in time of a bag, as users write it.

use std::str::FromStr;

use eddy_frames::{Stamp, date::Utc};

/// A point in time of a bag: `2.5` (seconds after its start), or a log time as `eddy bag info` prints it, `2023-11-14T22:13:20Z` or
/// `1700000000.25` (seconds since the Unix epoch, from a year on), or `1700000000250000000ns`.
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
    "time: found `{found}`, expected seconds from the start, such as 2.5, or a log time, such as 2023-11-14T22:13:20Z, 1700000000.25 or 1700000000250000000ns"
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
        if let Some(date) = Utc::parse(text) {
            return Ok(Self::At(date));
        }
        let seconds =
            text.parse().ok().filter(|seconds: &f64| seconds.is_finite() && *seconds >= 0.0);
        match seconds {
            // No bag is as long.
            Some(seconds) if seconds >= YEAR => since_epoch(text).map(Self::At),
            seconds => seconds.map(Self::After),
        }
        .ok_or_else(invalid)
    }
}

/// Seconds of a year.
const YEAR: f64 = 365.25 * 86_400.0;

/// Seconds since the epoch to the nanosecond, which a floating-point number would round.
fn since_epoch(text: &str) -> Option<Stamp> {
    let (seconds, fraction) = text.split_once('.').unwrap_or((text, ""));
    let fraction: i64 = format!("{fraction:0<9}").get(..9)?.parse().ok()?;
    Some(Stamp(seconds.parse::<i64>().ok()?.checked_mul(1_000_000_000)?.checked_add(fraction)?))
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
    fn times_are_read_as_info_prints_them() {
        let at = |text: &str| text.parse::<BagTime>().unwrap().in_bag(Stamp(1_000));
        for (text, expected) in [
            ("2023-11-14T22:13:20Z", 1_700_000_000_000_000_000),
            ("1700000000.000000057", 1_700_000_000_000_000_057),
            ("1700000000", 1_700_000_000_000_000_000),
            ("1700000000.25", 1_700_000_000_250_000_000),
        ] {
            assert_eq!(at(text), Stamp(expected), "{text}");
        }
    }

    #[test]
    fn other_texts_are_rejected_with_what_was_expected() {
        for text in
            ["", "-1", "soon", "1e999", "-5ns", "2.5ns", "2023-02-30T00:00:00Z", "99999999999"]
        {
            let message = text.parse::<BagTime>().unwrap_err().to_string();
            assert!(message.starts_with(&format!("time: found `{text}`, expected")), "{message}");
        }
    }
}
