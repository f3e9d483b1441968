//! Counters, rate and latency as ROS 2 diagnostics.

use std::{collections::BTreeMap, time::Duration};

use hdrhistogram::Histogram;

use super::{Counters, GroupCounts};
use eddy_frames::Stamp;
use eddy_inference::error_model::{ErrorEstimate, UPPER_LEVEL};
use eddy_messages::{DiagnosticArray, DiagnosticStatus, Header, KeyValue};

/// Largest latency in the histogram; longer ones count as this (µs).
const MAX_LATENCY: u64 = 60_000_000;

/// `level` of a `DiagnosticStatus`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
enum Level {
    Ok = 0,
    Warn = 1,
    Error = 2,
}

/// Rate and latency between two reports.
#[derive(Debug)]
pub struct Monitor {
    since: Duration,
    published: u64,
    latency: Histogram<u64>,
    last: Counters,
    rejection: Option<String>,
    /// The largest expected error of the predictions of each stream.
    expected_errors: BTreeMap<u64, ErrorEstimate>,
    /// State of a managed node that is not active.
    idle: Option<&'static str>,
}

/// Rate and latency since the last report.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rates {
    /// Predictions a second.
    pub rate: f64,
    /// Median time from the arrival of a frame to the publication of its predictions.
    pub latency_p50: Duration,
    /// 99th percentile of the same.
    pub latency_p99: Duration,
}

impl Monitor {
    /// Starts at `now`.
    pub fn start(now: Duration) -> Self {
        let latency = Histogram::new_with_bounds(1, MAX_LATENCY, 3)
            .expect("1 to 60 s in microseconds with 3 digits is a valid histogram");
        Self {
            since: now,
            published: 0,
            latency,
            last: Counters::default(),
            rejection: None,
            expected_errors: BTreeMap::new(),
            idle: None,
        }
    }

    /// Records the predictions of one frame.
    pub fn published(&mut self, predictions: u64, latency: Duration) {
        self.published += predictions;
        let microseconds = u64::try_from(latency.as_micros()).unwrap_or(MAX_LATENCY);
        self.latency.saturating_record(microseconds.clamp(1, MAX_LATENCY));
    }

    /// Records why a frame was rejected; the latest reason is reported.
    pub fn rejected(&mut self, reason: String) {
        self.rejection = Some(reason);
    }

    /// Records how far a prediction is expected to be off; the largest of each stream is reported.
    pub fn expects(&mut self, stream: u64, error: ErrorEstimate) {
        let largest = self.expected_errors.entry(stream).or_insert(error);
        if error.expected >= largest.expected {
            *largest = error;
        }
    }

    /// The node is in this state at the next report and does not predict.
    pub fn idle(&mut self, state: &'static str) {
        self.idle = Some(state);
    }

    /// Rate and latency since the last report.
    pub fn rates(&self, now: Duration) -> Rates {
        let seconds = now.saturating_sub(self.since).as_secs_f64().max(1e-9);
        Rates {
            rate: self.published as f64 / seconds,
            latency_p50: Duration::from_micros(self.latency.value_at_quantile(0.5)),
            latency_p99: Duration::from_micros(self.latency.value_at_quantile(0.99)),
        }
    }

    /// Reports the interval since the last report and starts the next one.
    ///
    /// ERROR when a prediction diverged, WARN when a frame was rejected or lost or the error of a prediction is expected to exceed
    /// `max_expected_error` (domain lengths), OK otherwise.
    pub fn report(
        &mut self,
        now: Duration,
        stamp: Stamp,
        name: &str,
        model: &str,
        counters: &Counters,
        max_expected_error: Option<f64>,
    ) -> DiagnosticArray {
        let Rates { rate, latency_p50, latency_p99 } = self.rates(now);
        let expected_errors = self.largest_expected_errors();
        let too_large = max_expected_error
            .filter(|&most| most > 0.0)
            .and_then(|most| above(most, expected_errors.first()?));
        let (level, message) = self.level(counters, too_large);
        let milliseconds = |latency: Duration| format!("{:.3}", latency.as_secs_f64() * 1e3);
        let mut values = vec![
            value("rate (1/s)", format!("{rate:.1}")),
            value("latency p50 (ms)", milliseconds(latency_p50)),
            value("latency p99 (ms)", milliseconds(latency_p99)),
            value("model", model),
        ];
        values.extend(counters.named().map(|(key, count)| value(key, count.to_string())));
        values.extend(losses(counters));
        values.extend(expected(&expected_errors).into_iter().flatten());
        values.extend(group(counters).into_iter().flatten());
        *self = Self { last: counters.clone(), ..Self::start(now) };
        let status = DiagnosticStatus {
            level: level as u8,
            name: name.to_owned(),
            message,
            hardware_id: String::new(),
            values,
        };
        DiagnosticArray {
            header: Header { stamp: stamp.into(), frame_id: String::new() },
            status: vec![status],
        }
    }

    fn level(&self, counters: &Counters, too_large: Option<String>) -> (Level, String) {
        if counters.diverged > self.last.diverged {
            (Level::Error, "a prediction was not finite; its stream was reset".to_owned())
        } else if let Some(reason) = &self.rejection {
            (Level::Warn, format!("frame rejected: {reason}"))
        } else if counters.skipped_in_free_run > self.last.skipped_in_free_run {
            let skipped = counters.skipped_in_free_run - self.last.skipped_in_free_run;
            (
                Level::Warn,
                format!(
                    "free runs skipped {skipped} frames: the time jumped ahead, or the model is too slow"
                ),
            )
        } else if counters.lost() > self.last.lost() {
            (Level::Warn, "frames were lost".to_owned())
        } else if let Some(message) = too_large {
            (Level::Warn, message)
        } else {
            (Level::Ok, self.idle.unwrap_or("predicting").to_owned())
        }
    }

    /// Streams in descending order of their expected errors.
    fn largest_expected_errors(&self) -> Vec<(u64, ErrorEstimate)> {
        let mut errors: Vec<_> =
            self.expected_errors.iter().map(|(&id, &error)| (id, error)).collect();
        errors.sort_by(|(_, a), (_, b)| b.expected.total_cmp(&a.expected));
        errors
    }
}

/// A warning if the expected error of a stream is above `most` (domain lengths).
fn above(most: f64, (stream, error): &(u64, ErrorEstimate)) -> Option<String> {
    let ErrorEstimate { horizon, expected, .. } = error;
    (f64::from(*expected) > most).then(|| {
        format!(
            "stream {stream}: the error {horizon} frames ahead is expected to be {expected:.4} domain lengths, above \
             max_expected_error {most}"
        )
    })
}

/// The largest expected error, and those of several streams with their horizons.
fn expected(errors: &[(u64, ErrorEstimate)]) -> Option<[KeyValue; 2]> {
    let (_, largest) = errors.first()?;
    let named = errors.iter().take(NAMED).map(|(stream, error)| {
        let ErrorEstimate { horizon, expected, upper, worse_than_ballistic } = error;
        let [level, worse] = [UPPER_LEVEL, *worse_than_ballistic].map(|share| 100.0 * share);
        format!(
            "{stream}: {expected:.4} at {horizon} ({level:.0} % below {upper:.4}, {worse:.0} % worse than ballistic)"
        )
    });
    Some([
        value("largest expected error (domain lengths)", format!("{:.4}", largest.expected)),
        value(
            "expected error (domain lengths) at frames ahead, by stream",
            named.collect::<Vec<_>>().join(", "),
        ),
    ])
}

/// Streams that a report names at most.
const NAMED: usize = 8;

/// The streams that lost most frames because the node is too slow, in descending order.
fn losses(counters: &Counters) -> Option<KeyValue> {
    let mut losses: Vec<_> = counters.dropped_by_stream.iter().collect();
    losses.sort_by_key(|&(_, lost)| std::cmp::Reverse(lost));
    let named = losses.iter().take(NAMED).map(|(stream, lost)| format!("{stream}: {lost}"));
    let named = named.collect::<Vec<_>>().join(", ");
    (!losses.is_empty()).then(|| value("lost_in_queue, by stream", named))
}

/// Members and streams of the group.
fn group(counters: &Counters) -> Option<[KeyValue; 3]> {
    let GroupCounts { members, owned_streams, foreign_streams } = counters.group?;
    Some([
        value("group, members", members.to_string()),
        value("group, owned streams", owned_streams.to_string()),
        value("group, foreign streams", foreign_streams.to_string()),
    ])
}

fn value(key: &str, value: impl Into<String>) -> KeyValue {
    KeyValue { key: key.to_owned(), value: value.into() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn report(monitor: &mut Monitor, seconds: u64, counters: &Counters) -> DiagnosticStatus {
        let now = Duration::from_secs(seconds);
        monitor.report(now, Stamp(0), "eddy", "abc", counters, Some(0.05)).status.remove(0)
    }

    #[test]
    fn a_report_has_rate_latency_and_every_counter() {
        let mut monitor = Monitor::start(Duration::ZERO);
        for _ in 0..50 {
            monitor.published(1, Duration::from_millis(2));
        }
        let counters = Counters { published: 50, ..Counters::default() };
        let status = report(&mut monitor, 2, &counters);
        let found = |key: &str| {
            status.values.iter().find(|v| v.key == key).map(|v| v.value.clone()).unwrap()
        };
        assert_eq!(found("rate (1/s)"), "25.0");
        assert_eq!(found("latency p50 (ms)"), "2.000");
        assert_eq!(found("published"), "50");
        assert_eq!(status.level, Level::Ok as u8);
        assert_eq!(status.values.len(), 4 + counters.named().len());
    }

    #[test]
    fn the_streams_that_lost_most_frames_are_named_in_descending_order() {
        let counters = Counters {
            dropped_by_stream: (0..20).map(|n| (n, n)).collect(),
            ..Counters::default()
        };
        let named = report(&mut Monitor::start(Duration::ZERO), 1, &counters).values.pop().unwrap();
        assert_eq!(named.key, "lost_in_queue, by stream");
        assert_eq!(named.value, "19: 19, 18: 18, 17: 17, 16: 16, 15: 15, 14: 14, 13: 13, 12: 12");
    }

    #[test]
    fn members_and_streams_of_a_group_are_reported() {
        let group = Some(GroupCounts { members: 3, owned_streams: 33, foreign_streams: 67 });
        let counters = Counters { group, ..Counters::default() };
        let status = report(&mut Monitor::start(Duration::ZERO), 1, &counters);
        let values = status.values.iter().filter(|value| value.key.starts_with("group, "));
        let found: Vec<_> = values.map(|value| value.value.as_str()).collect();
        assert_eq!(found, ["3", "33", "67"]);
        assert_eq!(status.level, Level::Ok as u8);
    }

    #[test]
    fn a_prediction_that_is_expected_to_be_far_off_is_a_warning_with_its_stream() {
        let estimate = |expected: f32, horizon| ErrorEstimate {
            horizon,
            expected,
            upper: 2.0 * expected,
            worse_than_ballistic: 0.25,
        };
        let mut monitor = Monitor::start(Duration::ZERO);
        for (stream, expected, horizon) in [(1, 0.02, 20), (2, 0.0625, 9), (2, 0.04, 10)] {
            monitor.expects(stream, estimate(expected, horizon));
        }
        let status = report(&mut monitor, 1, &Counters::default());
        assert_eq!(status.level, Level::Warn as u8);
        assert_eq!(
            status.message,
            "stream 2: the error 9 frames ahead is expected to be 0.0625 domain lengths, above max_expected_error 0.05"
        );
        let [largest, by_stream] = &status.values[status.values.len() - 2..] else { panic!() };
        assert_eq!(largest.value, "0.0625");
        assert_eq!(
            by_stream.value,
            "2: 0.0625 at 9 (90 % below 0.1250, 25 % worse than ballistic), \
             1: 0.0200 at 20 (90 % below 0.0400, 25 % worse than ballistic)"
        );
        monitor.expects(1, estimate(0.02, 20));
        assert_eq!(report(&mut monitor, 2, &Counters::default()).level, Level::Ok as u8);
        assert_eq!(
            report(&mut monitor, 3, &Counters::default()).values.len(),
            status.values.len() - 2
        );
    }

    #[test]
    fn the_level_covers_the_last_interval_only() {
        let mut monitor = Monitor::start(Duration::ZERO);
        let diverged = Counters { diverged: 1, ..Counters::default() };
        assert_eq!(report(&mut monitor, 1, &diverged).level, Level::Error as u8);
        assert_eq!(report(&mut monitor, 2, &diverged).level, Level::Ok as u8);
        let late = Counters { late: 1, ..diverged };
        assert_eq!(report(&mut monitor, 3, &late).level, Level::Warn as u8);
    }
}
