//! The live line of the demo: rate, latency, and the error of the predictions beside that of the best baseline.

use std::{sync::Arc, time::Duration};

use crate::commands::counted;
use eddy_cli::terminal;
use eddy_frames::Frame;
use eddy_messages::PredictionStatus;
use eddy_node::{
    diagnostics::Monitor,
    viewer::{Comparison, PredictionInfo, StatusJoiner},
};

/// Between the parts of the line.
const SEPARATOR: &str = " | ";

/// Compares predictions with the truth as both arrive.
pub(super) struct Live {
    comparison: Comparison,
    joiner: StatusJoiner,
    monitor: Monitor,
    /// Simulated time (s) and time at the last line.
    last: Option<(f64, Duration)>,
}

/// Simulated time per real time below which the line says it.
const SLOW: f64 = 0.95;

impl Live {
    /// Starts at `now`.
    pub(super) fn start(comparison: Comparison, now: Duration) -> Self {
        let (joiner, monitor) = (StatusJoiner::default(), Monitor::start(now));
        Self { comparison, joiner, monitor, last: None }
    }

    /// A prediction has arrived.
    pub(super) fn prediction(&mut self, frame: Frame) {
        let joined = self.joiner.prediction(frame);
        self.compare(joined);
    }

    /// The status of a prediction has arrived.
    pub(super) fn status(&mut self, status: PredictionStatus) {
        let latency = Duration::try_from_secs_f32(status.latency).unwrap_or_default();
        self.monitor.published(1, latency);
        let joined = self.joiner.status(status);
        self.compare(joined);
    }

    fn compare(&mut self, joined: Option<(Frame, PredictionInfo)>) {
        if let Some((frame, info)) = joined {
            self.comparison.prediction(Arc::new(frame), info);
        }
    }

    /// An observed frame has arrived.
    pub(super) fn truth(&mut self, frame: Frame) {
        self.comparison.truth(Arc::new(frame));
    }

    /// The line since the last call. What does not fit into `columns` is left out: first the latencies, last the skill.
    pub(super) fn line(&mut self, now: Duration, columns: usize) -> String {
        let rates = self.monitor.rates(now);
        self.monitor = Monitor::start(now);
        let Some(time) = self.comparison.now() else {
            return "waiting for the first frame".to_owned();
        };
        let pace = self.last.replace((time, now)).map(|(simulated, at)| {
            let real = (now - at).as_secs_f64();
            if real > 0.0 { (time - simulated) / real } else { 1.0 }
        });
        let mut parts = vec![(1, format!("t = {time:6.2} s"))];
        // Another scene may begin at an earlier time.
        if let Some(pace) = pace.filter(|pace| (0.0..SLOW).contains(pace)) {
            parts.push((4, format!("{pace:.1} x real time")));
        }
        let Some(summary) = self.comparison.summary() else {
            parts.push((0, "warming up".to_owned()));
            return terminal::fit(&parts, SEPARATOR, columns);
        };
        let milliseconds = |latency: Duration| latency.as_secs_f64() * 1e3;
        parts.push((3, format!("{:5.1} predictions/s", rates.rate)));
        if rates.rate > 0.0 {
            let [p50, p99] = [rates.latency_p50, rates.latency_p99].map(milliseconds);
            parts.push((5, format!("latency p50 {p50:.1} ms, p99 {p99:.1} ms")));
        }
        parts.push((1, format!("{} ahead", counted(summary.horizon.into(), "frame"))));
        parts.push((0, format!("error {:.1e}", summary.error)));
        if let Some((best, error)) = summary.baseline {
            parts.push((2, format!("{} {error:.1e}", best.name())));
        }
        match summary.skill() {
            Some(skill) => parts.push((0, format!("skill {skill:+.2}"))),
            None if summary.baseline.is_some() => parts.push((0, "at rest".to_owned())),
            None => {}
        }
        terminal::fit(&parts, SEPARATOR, columns)
    }
}
