//! Calendar dates of times since the Unix epoch.

use std::fmt;

use crate::Stamp;

const NANOSECONDS: i64 = 1_000_000_000;
/// Seconds of a day.
const DAY: i64 = 86_400;

/// Date and time in UTC, to the second.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Utc {
    /// Year of the Gregorian calendar.
    pub year: i64,
    /// Month, from 1.
    pub month: i64,
    /// Day of the month, from 1.
    pub day: i64,
    /// Hour, minute and second.
    pub time: [i64; 3],
}

impl Utc {
    /// The date of a time since the Unix epoch. Days are counted from 1 March 0000, so that the leap day is the last of
    /// a year (H. Hinnant, "chrono-Compatible Low-Level Date Algorithms", `civil_from_days`).
    pub fn of(time: Stamp) -> Self {
        let seconds = time.0.div_euclid(NANOSECONDS);
        let (days, second) = (seconds.div_euclid(DAY) + 719_468, seconds.rem_euclid(DAY));
        let era = days.div_euclid(146_097);
        let day_of_era = days.rem_euclid(146_097);
        let year_of_era =
            (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
        let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
        let march_month = (5 * day_of_year + 2) / 153;
        let month = if march_month < 10 { march_month + 3 } else { march_month - 9 };
        Self {
            year: 400 * era + year_of_era + i64::from(month <= 2),
            month,
            day: day_of_year - (153 * march_month + 2) / 5 + 1,
            time: [second / 3600, second / 60 % 60, second % 60],
        }
    }

    /// The time of a date as this type displays it, also with a fraction of a second, a space instead of `T`, or without the `Z`;
    /// `None` for other texts, and for times that a [`Stamp`] cannot hold.
    pub fn parse(text: &str) -> Option<Stamp> {
        let text = text.strip_suffix('Z').unwrap_or(text);
        let (date, time) = text.split_once(['T', ' '])?;
        let number = |digits: &str, count: usize| {
            let is_number = digits.len() == count && digits.bytes().all(|b| b.is_ascii_digit());
            is_number.then(|| digits.parse::<i64>().ok())?
        };
        let (time, fraction) = time.split_once('.').unwrap_or((time, "0"));
        let [year, month, day] = date.splitn(3, '-').collect::<Vec<_>>().try_into().ok()?;
        let [hour, minute, second] = time.splitn(3, ':').collect::<Vec<_>>().try_into().ok()?;
        let (year, month, day) = (number(year, 4)?, number(month, 2)?, number(day, 2)?);
        let time @ [hour, minute, second] =
            [number(hour, 2)?, number(minute, 2)?, number(second, 2)?];
        let nanoseconds = number(&format!("{fraction:0<9}"), 9)?;
        // The inverse of `Utc::of` (`days_from_civil`).
        let year_from_march = year - i64::from(month <= 2);
        let era = year_from_march.div_euclid(400);
        let year_of_era = year_from_march.rem_euclid(400);
        let day_of_year = (153 * ((month + 9) % 12) + 2) / 5 + day - 1;
        let day_of_era = 365 * year_of_era + year_of_era / 4 - year_of_era / 100 + day_of_year;
        let days = 146_097 * era + day_of_era - 719_468;
        let seconds = days * DAY + 3600 * hour + 60 * minute + second;
        let stamp = Stamp(seconds.checked_mul(NANOSECONDS)?.checked_add(nanoseconds)?);
        // Not 30 February, and not 25 o'clock.
        (Self::of(stamp) == Self { year, month, day, time }).then_some(stamp)
    }

    /// The date for names of files, as in rosbag2: `2024_01_31-12_05_59`.
    pub fn file_name(self) -> String {
        let Self { year, month, day, time: [hour, minute, second] } = self;
        format!("{year:04}_{month:02}_{day:02}-{hour:02}_{minute:02}_{second:02}")
    }
}

/// ISO 8601: `2024-01-31T12:05:59Z`.
impl fmt::Display for Utc {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { year, month, day, time: [hour, minute, second] } = self;
        write!(f, "{year:04}-{month:02}-{day:02}T{hour:02}:{minute:02}:{second:02}Z")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_match_the_gregorian_calendar() {
        // From `date -u -d @SECONDS +%FT%TZ`.
        for (seconds, expected) in [
            (0, "1970-01-01T00:00:00Z"),
            (951_782_399, "2000-02-28T23:59:59Z"),
            (951_782_400, "2000-02-29T00:00:00Z"),
            (1_709_251_199, "2024-02-29T23:59:59Z"),
            (4_107_542_400, "2100-03-01T00:00:00Z"),
            (-1, "1969-12-31T23:59:59Z"),
        ] {
            assert_eq!(Utc::of(Stamp(seconds * NANOSECONDS)).to_string(), expected);
        }
        for (text, expected) in [
            ("2000-02-29T00:00:00Z", Some(951_782_400_000_000_000)),
            ("2000-02-29 00:00:00", Some(951_782_400_000_000_000)),
            ("2023-11-14T22:13:20.000000001Z", Some(1_700_000_000_000_000_001)),
            ("2023-11-14T22:13:20.5", Some(1_700_000_000_500_000_000)),
            ("2001-02-29T00:00:00Z", None),
            ("2000-13-01T00:00:00Z", None),
            ("2000-00-01T00:00:00Z", None),
            ("2000-01-01T24:00:00Z", None),
            ("2000-01-01T00:00Z", None),
            ("2000-01-01", None),
            ("2000-01-01T00:00:00.1234567890Z", None),
            ("20a0-01-01T00:00:00Z", None),
            ("9999-01-01T00:00:00Z", None),
        ] {
            assert_eq!(Utc::parse(text), expected.map(Stamp), "{text}");
        }
        for days in (0..60_000).step_by(17) {
            let stamp = Stamp(days * DAY * NANOSECONDS);
            assert_eq!(Utc::parse(&Utc::of(stamp).to_string()), Some(stamp));
        }
        let leap = Utc::of(Stamp(951_782_400 * NANOSECONDS + 999_999_999));
        assert_eq!(leap.file_name(), "2000_02_29-00_00_00");
    }
}
