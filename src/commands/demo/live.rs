//! The demo's live line: rate, latency, and the error of the predictions beside the best baseline's.

use std::{sync::Arc, time::Duration};

use eddy_frames::Frame;
use eddy_messages::PredictionStatus;
use eddy_node::{
    diagnostics::Monitor,
    viewer::{Ahead, Comparison, Explained, Summary},
};

/// Errors of the best baseline below this mean that nothing moves (domain lengths).
const AT_REST: f64 = 1e-4;

/// Compares predictions with the truth as it arrives.
pub(super) struct Live {
    comparison: Comparison,
    explained: Explained,
    monitor: Monitor,
}

impl Live {
    /// Starts at `now`.
    pub(super) fn start(comparison: Comparison, now: Duration) -> Self {
        Self { comparison, explained: Explained::default(), monitor: Monitor::start(now) }
    }

    /// A prediction came.
    pub(super) fn prediction(&mut self, frame: Frame) {
        let joined = self.explained.prediction(frame);
        self.compare(joined);
    }

    /// How one of these came to be.
    pub(super) fn status(&mut self, status: PredictionStatus) {
        let latency = Duration::try_from_secs_f32(status.latency).unwrap_or_default();
        self.monitor.published(1, latency);
        let joined = self.explained.status(status);
        self.compare(joined);
    }

    fn compare(&mut self, joined: Option<(Frame, Ahead)>) {
        if let Some((frame, ahead)) = joined {
            self.comparison.prediction(Arc::new(frame), ahead);
        }
    }

    /// The truth came.
    pub(super) fn truth(&mut self, frame: Frame) {
        self.comparison.truth(Arc::new(frame));
    }

    /// The line; starts the next interval of rate and latency.
    pub(super) fn line(&mut self, now: Duration) -> String {
        let rates = self.monitor.rates(now);
        self.monitor = Monitor::start(now);
        let Some(time) = self.comparison.now() else {
            return "waiting for the first frame".to_owned();
        };
        let mut line = format!("t = {time:6.2} s");
        let Some(Summary { frames, error, baseline }) = self.comparison.summary() else {
            return line + " | warming up";
        };
        let milliseconds = |latency: Duration| latency.as_secs_f64() * 1e3;
        line += &format!(" | {:5.1} predictions/s", rates.rate);
        if rates.rate > 0.0 {
            line += &format!(
                " | latency p50 {:.1} ms, p99 {:.1} ms",
                milliseconds(rates.latency_p50),
                milliseconds(rates.latency_p99)
            );
        }
        line += &format!(" | error {error:.1e}");
        if let Some((best, of_best)) = baseline {
            line += &format!(", {} {of_best:.1e}", best.name());
            // Where everything rests the best baseline is exact, and a ratio to it says nothing.
            if of_best > AT_REST {
                line += &format!(", skill {:+.2}", 1.0 - (error / of_best).powi(2));
            }
        }
        if frames > 1 {
            line += &format!(", {frames} frames ahead");
        }
        line
    }
}
