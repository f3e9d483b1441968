//! Pairs truth and prediction of the same instant and measures their distance.

use std::{
    collections::{BTreeMap, VecDeque},
    ops::RangeInclusive,
    sync::Arc,
};

use super::{
    baselines::Baselines,
    curves::{Curves, Point, Recent, Squared, Summary},
};
use eddy_frames::{Frame, mean_squared_distance};
use eddy_inference::engine::Baseline;
use eddy_inference::{checkpoint::Description, engine::Ballistic};

/// Points of the curve over time.
const MAX_POINTS: usize = 375;
/// Frames waiting for their counterpart; fewer large ones, see [`WAITING_BYTES`].
const MAX_WAITING: usize = 1024;
/// Memory for these frames (bytes).
const WAITING_BYTES: usize = 64 << 20;
/// Bytes of a particle in a frame: position, velocity, material.
const PARTICLE_BYTES: usize = 17;
/// Horizons for which errors are kept.
const MAX_HORIZONS: usize = 512;
/// Pairs after which the errors of a horizon without pairs of its own are no longer shown.
const RECENT_PAIRS: u64 = 620;
/// A sequence this far before the last one means that the stream restarted, as in the node.
const RESTART_FRAMES: u64 = 16;

/// Where a prediction comes from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PredictionInfo {
    /// Sequence of the last observed frame.
    pub source: u64,
    /// Frames from the source to the predicted frame; 0 if unknown.
    pub horizon: u32,
    /// Whether the stream is in a free run.
    pub free_running: bool,
}

/// Truth and prediction of one instant.
#[derive(Clone, Debug)]
pub struct Pair {
    /// Observed frame.
    pub truth: Arc<Frame>,
    /// Predicted frame.
    pub predicted: Arc<Frame>,
    /// Where the prediction comes from.
    pub info: PredictionInfo,
    /// Root mean square distance of the particles (domain lengths).
    pub error: f64,
    /// The same for the best recent baseline, unless unknown or too expensive.
    pub baseline: Option<(Baseline, f64)>,
}

/// Compares the predictions of one stream with its truth, whichever arrives first.
#[derive(Debug)]
pub struct Comparison {
    baselines: Baselines,
    stream: Option<u64>,
    truths: BTreeMap<u64, Arc<Frame>>,
    /// By sequence and horizon.
    waiting: BTreeMap<(u64, u32), (Arc<Frame>, PredictionInfo)>,
    /// By horizon.
    recent: BTreeMap<u32, Recent>,
    time: VecDeque<Point>,
    pairs: u64,
    /// Horizon of the last pair.
    last: Option<u32>,
    newest: SourceHorizons,
    /// Horizons that are predicted at present.
    current_horizons: RangeInclusive<u32>,
}

/// Horizons of the predictions from one observed frame.
#[derive(Clone, Debug)]
struct SourceHorizons {
    source: Option<u64>,
    horizons: RangeInclusive<u32>,
}

impl Comparison {
    /// Baselines use gravity and walls of `model`.
    pub fn new(model: &Description) -> Self {
        let Ballistic { gravity, lower, upper, .. } = Ballistic::new(model);
        Self::with_baselines(Baselines::new(gravity, model.domain, [lower, upper]))
    }

    /// An empty comparison with the same baselines.
    pub fn empty_copy(&self) -> Self {
        Self::with_baselines(self.baselines.empty_copy())
    }

    fn with_baselines(baselines: Baselines) -> Self {
        Self {
            baselines,
            stream: None,
            truths: BTreeMap::new(),
            waiting: BTreeMap::new(),
            recent: BTreeMap::new(),
            time: VecDeque::new(),
            pairs: 0,
            last: None,
            newest: SourceHorizons { source: None, horizons: 0..=0 },
            current_horizons: 0..=u32::MAX,
        }
    }

    /// Adds an observed frame. Returns its pair with the prediction of the longest horizon.
    pub fn truth(&mut self, frame: Arc<Frame>) -> Option<Pair> {
        let last = self.truths.last_key_value().map(|(&sequence, frame)| (sequence, frame.len()));
        let restarted = last.is_some_and(|(sequence, particles)| {
            frame.sequence.saturating_add(RESTART_FRAMES) < sequence || particles != frame.len()
        });
        self.follow(frame.stream, restarted);
        bound(&mut self.truths, frame.len());
        let sequence = frame.sequence;
        self.truths.insert(sequence, Arc::clone(&frame));
        // Earlier frames will not be observed any more.
        self.waiting = self.waiting.split_off(&(sequence.saturating_sub(RESTART_FRAMES), 0));
        let due: Vec<_> =
            self.waiting.range((sequence, 0)..=(sequence, u32::MAX)).map(|(&key, _)| key).collect();
        let mut longest = None;
        for key in due {
            let Some((predicted, info)) = self.waiting.remove(&key) else { continue };
            longest = self.compare(&frame, predicted, info).or(longest);
        }
        longest
    }

    /// Adds a prediction. Returns its pair if the truth has arrived.
    pub fn prediction(&mut self, frame: Arc<Frame>, info: PredictionInfo) -> Option<Pair> {
        // A free run may be far behind the truth: only the truth restarts the comparison.
        self.follow(frame.stream, false);
        self.record_horizon(info);
        if let Some(truth) = self.truths.get(&frame.sequence) {
            let truth = Arc::clone(truth);
            return self.compare(&truth, frame, info);
        }
        if self.waiting.len() >= capacity(frame.len()) {
            self.drop_one();
        }
        self.waiting.insert((frame.sequence, info.horizon), (frame, info));
        None
    }

    /// Records which horizons are predicted. The horizons of a source frame are complete when the first prediction from the next
    /// source arrives; a free run adds one horizon per frame.
    fn record_horizon(&mut self, PredictionInfo { source, horizon, free_running }: PredictionInfo) {
        let SourceHorizons { source: newest, horizons } = &mut self.newest;
        if *newest != Some(source) {
            if newest.is_some() {
                self.current_horizons = horizons.clone();
            }
            (*newest, *horizons) = (Some(source), horizon..=horizon);
        }
        *horizons = horizon.min(*horizons.start())..=horizon.max(*horizons.end());
        if free_running {
            self.current_horizons = horizons.clone();
        }
    }

    /// Drops one waiting prediction. Where all frames of a long horizon are published, horizons that are powers of two and
    /// the longest are kept: they make a curve up to about 500 frames ahead (17 with 100,000 particles). Otherwise the
    /// prediction that is due last goes.
    fn drop_one(&mut self) {
        let longest = self.waiting.keys().map(|&(_, horizon)| horizon).max();
        let between =
            |&&(_, horizon): &&(u64, u32)| !horizon.is_power_of_two() && Some(horizon) != longest;
        match self.waiting.keys().rev().find(between).copied() {
            Some(key) => self.waiting.remove(&key),
            None => self.waiting.pop_last().map(|(_, waiting)| waiting),
        };
    }

    /// Clears everything when the stream changes or restarts.
    fn follow(&mut self, stream: u64, restarted: bool) {
        if restarted || self.stream != Some(stream) {
            *self = Self { stream: Some(stream), ..self.empty_copy() };
        }
    }

    fn compare(
        &mut self,
        truth: &Arc<Frame>,
        predicted: Arc<Frame>,
        info: PredictionInfo,
    ) -> Option<Pair> {
        if truth.len() != predicted.len() {
            return None;
        }
        let model = mean_squared_distance(&predicted.position, &truth.position);
        let source = self.truths.get(&info.source).map(|frame| &**frame);
        let baselines = self.baselines.errors(truth, source, info);
        self.pairs += 1;
        self.last = Some(info.horizon);
        if !self.recent.contains_key(&info.horizon) && self.recent.len() >= MAX_HORIZONS {
            let oldest = self.recent.iter().min_by_key(|(_, recent)| recent.used);
            let oldest = oldest.map(|(&horizon, _)| horizon);
            oldest.and_then(|horizon| self.recent.remove(&horizon));
        }
        let recent = self.recent.entry(info.horizon).or_default();
        recent.used = self.pairs;
        let time = truth.stamp.seconds();
        recent.push(Squared { time, model, baselines });
        let best = recent.best().map(|(best, _)| best);
        let baseline = best.zip(baselines).map(|(best, all)| (best, all[best as usize].sqrt()));
        let error = model.sqrt();
        let point = Point { time, error, baseline: baseline.map(|(_, error)| error) };
        // Of several predictions of one instant the curve shows the one with the longest horizon.
        if self.time.back().is_some_and(|last| last.time >= time) {
            self.time.pop_back();
        }
        self.time.push_back(point);
        if self.time.len() > MAX_POINTS {
            self.time.pop_front();
        }
        Some(Pair { truth: Arc::clone(truth), predicted, info, error, baseline })
    }

    /// Mean errors over the last second of simulation time at the horizon of the last pair.
    pub fn summary(&self) -> Option<Summary> {
        let horizon = self.last?;
        self.recent.get(&horizon)?.summary(horizon)
    }

    /// Simulation time of the last observed frame (s).
    pub fn now(&self) -> Option<f64> {
        self.truths.last_key_value().map(|(_, frame)| frame.stamp.seconds())
    }

    /// The last observed frame.
    pub(super) fn last_truth(&self) -> Option<&Arc<Frame>> {
        self.truths.last_key_value().map(|(_, frame)| frame)
    }

    /// The curves.
    pub fn curves(&self) -> Curves {
        let current = self.recent.iter().filter(|(horizon, recent)| {
            self.current_horizons.contains(horizon) && recent.used + RECENT_PAIRS > self.pairs
        });
        Curves {
            time: self.time.iter().copied().collect(),
            by_horizon: current.filter_map(|(&horizon, recent)| recent.summary(horizon)).collect(),
            now: self.summary(),
        }
    }
}

/// Number of waiting frames with `particles` particles.
fn capacity(particles: usize) -> usize {
    (WAITING_BYTES / (PARTICLE_BYTES * particles.max(1))).clamp(2, MAX_WAITING)
}

/// Drops the oldest frames until there is room for one more.
fn bound(frames: &mut BTreeMap<u64, Arc<Frame>>, particles: usize) {
    while frames.len() >= capacity(particles) {
        frames.pop_first();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{Domain, Material, Stamp};

    const DT: f32 = 0.016;

    /// A particle in free fall from rest, after `sequence` frames.
    fn falling(sequence: u64, off: f32) -> Arc<Frame> {
        let time = sequence as f32 * DT;
        Arc::new(Frame {
            stream: 1,
            sequence,
            stamp: Stamp(0).advance(DT, sequence as u32),
            dt: DT,
            domain: Domain::UNIT,
            position: vec![[0.5, 0.9 - 4.9 * time * time + off]],
            velocity: vec![[0.0, -9.8 * time]],
            material: vec![Material::Liquid],
        })
    }

    fn comparison() -> Comparison {
        let walls = [[0.05; 2], [0.95; 2]];
        Comparison::with_baselines(Baselines::new([0.0, -9.8], Domain::UNIT, walls))
    }

    fn info(source: u64, horizon: u32) -> PredictionInfo {
        PredictionInfo { source, horizon, free_running: false }
    }

    #[test]
    fn a_prediction_is_paired_with_the_truth_of_its_instant_whichever_arrives_first() {
        let mut comparison = comparison();
        assert!(comparison.truth(falling(0, 0.0)).is_none());
        assert!(comparison.prediction(falling(1, 0.01), info(0, 1)).is_none());
        let pair = comparison.truth(falling(1, 0.0)).unwrap();
        assert!((pair.error - 0.01).abs() < 1e-6, "{pair:?}");
        assert!(comparison.truth(falling(2, 0.0)).is_none());
        let late = comparison.prediction(falling(2, 0.02), info(1, 1)).unwrap();
        assert!((late.error - 0.02).abs() < 1e-6, "{late:?}");
        let summary = comparison.summary().unwrap();
        let mean = ((0.01f64.powi(2) + 0.02f64.powi(2)) / 2.0).sqrt();
        assert!((summary.error - mean).abs() < 1e-6, "{summary:?}");
    }

    #[test]
    fn the_best_baseline_of_a_fall_is_the_ballistic_one_however_far_ahead() {
        let mut comparison = comparison();
        for sequence in 0..12 {
            if sequence >= 5 {
                comparison.prediction(falling(sequence, 0.01), info(sequence - 5, 5));
            }
            comparison.truth(falling(sequence, 0.0));
        }
        let summary = comparison.summary().unwrap();
        assert_eq!(summary.horizon, 5);
        let (best, error) = summary.baseline.unwrap();
        assert_eq!(best, Baseline::Ballistic);
        assert!(error < 1e-5, "{error}");
    }

    #[test]
    fn errors_are_averaged_over_a_second_at_any_frame_rate() {
        let mut comparison = comparison();
        for (second, rate, error) in [(0, 62, 0.5), (1, 10, 0.01), (2, 200, 0.02)] {
            for i in 0..rate {
                let sequence = second * 1_000 + i;
                // A second with frames, then one without, so that no window covers two of them.
                let stamp = Stamp((second * 2_000_000_000 + i * 1_000_000_000 / rate) as i64);
                let truth = Frame { sequence, stamp, ..(*falling(0, 0.0)).clone() };
                let position = vec![[0.5, truth.position[0][1] + error]];
                let predicted = Frame { position, ..truth.clone() };
                comparison.prediction(Arc::new(predicted), info(sequence - i, 1));
                comparison.truth(Arc::new(truth));
            }
            let summary = comparison.summary().unwrap();
            assert!((summary.error - f64::from(error)).abs() < 1e-6, "{second}: {summary:?}");
        }
    }

    #[test]
    fn a_free_run_is_compared_from_the_last_observed_frame() {
        let mut comparison = comparison();
        comparison.truth(falling(0, 0.0));
        for sequence in 1..20 {
            let free = PredictionInfo { source: 0, horizon: sequence as u32, free_running: true };
            comparison.truth(falling(sequence, 0.0));
            let pair = comparison.prediction(falling(sequence, 0.001), free).unwrap();
            assert!(pair.baseline.unwrap().1 < 1e-5, "{pair:?}");
        }
        assert_eq!(comparison.baselines.rollouts.len(), 1, "one rollout that is continued");
        assert_eq!(comparison.curves().by_horizon.len(), 19);
        assert_eq!(comparison.curves().time.len(), 19);
    }

    #[test]
    fn only_horizons_that_are_predicted_at_present_are_in_the_curve() {
        let mut comparison = comparison();
        let mut sequence = 0;
        let mut run = |comparison: &mut Comparison, frames: u64, horizons: RangeInclusive<u32>| {
            for source in sequence..sequence + frames {
                comparison.truth(falling(source, 0.0));
                for horizon in horizons.clone() {
                    let ahead = source + u64::from(horizon);
                    comparison.prediction(falling(ahead, 0.001), info(source, horizon));
                }
            }
            sequence += frames;
            let rows = comparison.curves().by_horizon;
            rows.iter().map(|row| row.horizon).collect::<Vec<_>>()
        };
        assert_eq!(run(&mut comparison, 5, 1..=1), [1]);
        // Nothing has met its truth yet.
        assert_eq!(run(&mut comparison, 5, 20..=20), [0; 0]);
        assert_eq!(run(&mut comparison, 20, 20..=20), [20]);
        assert_eq!(run(&mut comparison, 30, 1..=4), [1, 2, 3, 4]);
        assert_eq!(run(&mut comparison, 2, 2..=2), [2]);
    }

    #[test]
    fn skill_is_undefined_at_rest_and_without_a_baseline() {
        let of = |error, baseline| Summary { horizon: 1, error, baseline }.skill();
        assert_eq!(of(0.1, Some((Baseline::Ballistic, 0.2))), Some(0.75));
        assert_eq!(of(0.1, Some((Baseline::Persistence, 1e-5))), None);
        assert_eq!(of(0.1, None), None);
    }

    #[test]
    fn waiting_frames_are_bounded_and_another_stream_clears_them() {
        let mut comparison = comparison();
        for sequence in 0..2_000 {
            comparison.prediction(falling(sequence + 1_000, 0.0), info(sequence, 1_000));
            comparison.truth(falling(sequence, 0.0));
        }
        assert!(comparison.waiting.len() <= MAX_WAITING && comparison.truths.len() <= MAX_WAITING);
        let other = Frame { stream: 2, ..(*falling(7, 0.0)).clone() };
        comparison.truth(Arc::new(other));
        assert_eq!((comparison.truths.len(), comparison.waiting.len()), (1, 0));
        assert_eq!(capacity(100_000), 39);
    }

    #[test]
    fn a_long_horizon_of_all_frames_is_compared_to_its_end() {
        const HORIZON: u32 = 100;
        let mut comparison = comparison();
        for source in 0..400 {
            comparison.truth(falling(source, 0.0));
            for frames in 1..=HORIZON {
                let sequence = source + u64::from(frames);
                comparison.prediction(falling(sequence, 0.001), info(source, frames));
            }
        }
        let lengths: Vec<u32> = comparison.curves().by_horizon.iter().map(|s| s.horizon).collect();
        for expected in [1, 2, 4, 8, 16, 32, 64, HORIZON] {
            assert!(lengths.contains(&expected), "{expected} of {lengths:?}");
        }
    }
}
