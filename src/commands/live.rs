//! The demo's live line: rate, latency, and the error of the next frame beside the baselines'.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use eddy::{
    dataset::State,
    eval::{Baseline, mean_squared_distance},
    frame::Frame,
    model::Ballistic,
    node::diagnostics::Monitor,
};

/// Frames that the shown errors are averaged over: one second.
const AVERAGED: usize = 62;

/// Errors of the best baseline below this mean that nothing moves (domain lengths).
const AT_REST: f64 = 1e-4;

/// Mean squared position errors of one frame ahead: the model's, then each baseline's.
type SquaredErrors = [f64; 1 + Baseline::ALL.len()];

/// Compares predictions with the truth as it arrives.
pub(super) struct Live {
    ballistic: Ballistic,
    last: Option<Frame>,
    /// What waits for its counterpart, by sequence: whichever of truth and prediction came first.
    truths: BTreeMap<u64, (State, Frame)>,
    predicted: BTreeMap<u64, Frame>,
    recent: VecDeque<SquaredErrors>,
    monitor: Monitor,
}

impl Live {
    /// Starts at `now` with the baselines' gravity, interval and walls.
    pub(super) fn start(ballistic: Ballistic, now: Duration) -> Self {
        Self {
            ballistic,
            last: None,
            truths: BTreeMap::new(),
            predicted: BTreeMap::new(),
            recent: VecDeque::new(),
            monitor: Monitor::start(now),
        }
    }

    /// A prediction came.
    pub(super) fn prediction(&mut self, frame: Frame) {
        self.predicted.insert(frame.sequence, frame);
        self.compare();
    }

    /// A prediction was published so long after its frame had arrived.
    pub(super) fn latency(&mut self, latency: Duration) {
        self.monitor.published(1, latency);
    }

    /// The truth came.
    pub(super) fn truth(&mut self, frame: Frame) {
        if let Some(last) = self.last.replace(frame.clone()) {
            let before = State { position: last.position, velocity: last.velocity };
            self.truths.insert(frame.sequence, (before, frame));
        }
        self.compare();
    }

    /// Compares what has both sides, and forgets what will never have.
    fn compare(&mut self) {
        while let Some((&sequence, _)) = self.predicted.first_key_value() {
            let Some((before, frame)) = self.truths.remove(&sequence) else { break };
            let Some(predicted) = self.predicted.remove(&sequence) else { break };
            let baseline = |baseline: Baseline| {
                let after = baseline.roll_out(&before, 1, &self.ballistic);
                mean_squared_distance(&after[0].position, &frame.position)
            };
            let [persistence, constant, ballistic] = Baseline::ALL.map(baseline);
            let model = mean_squared_distance(&predicted.position, &frame.position);
            self.recent.push_back([model, persistence, constant, ballistic]);
            if self.recent.len() > AVERAGED {
                self.recent.pop_front();
            }
        }
        while self.truths.len() > AVERAGED {
            self.truths.pop_first();
        }
        while self.predicted.len() > AVERAGED {
            self.predicted.pop_first();
        }
    }

    /// The line; starts the next interval of rate and latency.
    pub(super) fn line(&mut self, now: Duration) -> String {
        let rates = self.monitor.rates(now);
        self.monitor = Monitor::start(now);
        let Some(last) = &self.last else { return "waiting for the first frame".to_owned() };
        let mut line = format!("t = {:6.2} s", last.stamp.seconds());
        if self.recent.is_empty() {
            return line + " | warming up";
        }
        let milliseconds = |latency: Duration| latency.as_secs_f64() * 1e3;
        line += &format!(
            " | {:5.1} predictions/s | latency p50 {:.1} ms, p99 {:.1} ms",
            rates.rate,
            milliseconds(rates.latency_p50),
            milliseconds(rates.latency_p99)
        );
        let mean = |which: usize| {
            self.recent.iter().map(|errors| errors[which]).sum::<f64>() / self.recent.len() as f64
        };
        let (best, error) = Baseline::ALL
            .into_iter()
            .zip((1..).map(mean))
            .min_by(|a, b| a.1.total_cmp(&b.1))
            .unwrap_or((Baseline::Persistence, f64::NAN));
        line += &format!(" | error {:.1e}, {} {:.1e}", mean(0).sqrt(), best.name(), error.sqrt());
        // Where everything rests the best baseline is exact, and a ratio to it says nothing.
        if error.sqrt() > AT_REST {
            line += &format!(", skill {:+.2}", 1.0 - mean(0) / error);
        }
        line
    }
}
