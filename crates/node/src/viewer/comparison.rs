//! Pairs truth and prediction of the same instant, and measures them beside the trivial baselines.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::Arc,
};

use super::curves::{Curves, Point, Recent, Squared, Summary};
use eddy_evaluation::{Baseline, dataset::State, mean_squared_distance};
use eddy_frames::{Domain, Frame};
use eddy_inference::{checkpoint::Description, engine::Ballistic};

/// Points of the curve over time.
const POINTS: usize = 375;
/// Frames that wait for their counterpart, at most; of large ones as many as fit [`WAITING_BYTES`].
const WAITING: usize = 1024;
const WAITING_BYTES: usize = 64 << 20;
/// Bytes of a particle in a frame: position, velocity, material.
const PARTICLE_BYTES: usize = 17;
/// Particles times frames that baselines are rolled out for one pair, at most.
const ROLLED: usize = 4_000_000;
/// Particles of all rollouts that are kept to go on with.
const KEPT: usize = 1_000_000;
/// Numbers of frames ahead that errors are kept for, and for how many pairs after the last of their own.
const LENGTHS: usize = 512;
const FRESH: u64 = 620;
/// A sequence so far before the last one begins the stream anew, as for the node.
const RESTART: u64 = 16;

/// How a prediction came to be.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Ahead {
    /// Sequence of the last observed frame.
    pub source: u64,
    /// Frames predicted ahead of it; 0 if nobody said.
    pub frames: u32,
    /// Whether the model is fed with its own output.
    pub free: bool,
}

/// Truth and prediction of one instant.
#[derive(Clone, Debug)]
pub struct Pair {
    /// What was observed.
    pub truth: Arc<Frame>,
    /// What was predicted for it.
    pub predicted: Arc<Frame>,
    /// How.
    pub ahead: Ahead,
    /// Root mean square distance of the two (domain lengths).
    pub error: f64,
    /// The same of the best trivial baseline lately, unless it is unknown or too dear.
    pub baseline: Option<(Baseline, f64)>,
}

/// The baselines' rollouts from one observed frame, as far as they were needed.
#[derive(Debug)]
struct Rollout {
    source: u64,
    reached: u32,
    states: [State; Baseline::ALL.len()],
}

/// Compares the predictions of one stream with its truth, whichever of the two comes first.
#[derive(Debug)]
pub struct Comparison {
    gravity: [f32; 2],
    /// The domain that walls were seen in, and where.
    domain: Domain,
    walls: [[f32; 2]; 2],
    stream: Option<u64>,
    truths: BTreeMap<u64, Arc<Frame>>,
    /// By sequence and frames ahead.
    waiting: BTreeMap<(u64, u32), (Arc<Frame>, Ahead)>,
    rollouts: VecDeque<Rollout>,
    recent: BTreeMap<u32, Recent>,
    time: VecDeque<Point>,
    pairs: u64,
    last: Option<u32>,
}

impl Comparison {
    /// Gravity and walls of the baselines are those of a model.
    pub fn new(model: &Description) -> Self {
        let Ballistic { gravity, lower, upper, .. } = Ballistic::new(model);
        Self::within(gravity, model.domain, [lower, upper])
    }

    /// The same baselines, nothing seen.
    pub fn anew(&self) -> Self {
        Self::within(self.gravity, self.domain, self.walls)
    }

    fn within(gravity: [f32; 2], domain: Domain, walls: [[f32; 2]; 2]) -> Self {
        Self {
            gravity,
            domain,
            walls,
            stream: None,
            truths: BTreeMap::new(),
            waiting: BTreeMap::new(),
            rollouts: VecDeque::new(),
            recent: BTreeMap::new(),
            time: VecDeque::new(),
            pairs: 0,
            last: None,
        }
    }

    /// The truth of an instant. Returns the pair with what was predicted farthest ahead for it.
    pub fn truth(&mut self, frame: Arc<Frame>) -> Option<Pair> {
        let last = self.truths.last_key_value().map(|(&sequence, frame)| (sequence, frame.len()));
        let restarted = last.is_some_and(|(sequence, particles)| {
            frame.sequence.saturating_add(RESTART) < sequence || particles != frame.len()
        });
        self.follow(frame.stream, restarted);
        bound(&mut self.truths, frame.len());
        let sequence = frame.sequence;
        self.truths.insert(sequence, Arc::clone(&frame));
        // What lies farther back will not be observed any more.
        self.waiting = self.waiting.split_off(&(sequence.saturating_sub(RESTART), 0));
        let due: Vec<_> =
            self.waiting.range((sequence, 0)..=(sequence, u32::MAX)).map(|(&key, _)| key).collect();
        let mut farthest = None;
        for key in due {
            let Some((predicted, ahead)) = self.waiting.remove(&key) else { continue };
            farthest = self.compare(&frame, predicted, ahead).or(farthest);
        }
        farthest
    }

    /// A prediction. Returns the pair if the truth was there already.
    pub fn prediction(&mut self, frame: Arc<Frame>, ahead: Ahead) -> Option<Pair> {
        // A free run may be far behind the truth: only the truth begins anew.
        self.follow(frame.stream, false);
        if let Some(truth) = self.truths.get(&frame.sequence) {
            let truth = Arc::clone(truth);
            return self.compare(&truth, frame, ahead);
        }
        if self.waiting.len() >= room(frame.len()) {
            self.spare();
        }
        self.waiting.insert((frame.sequence, ahead.frames), (frame, ahead));
        None
    }

    /// Makes room for one more that waits. Where every frame of a long horizon is predicted, powers of two and the
    /// farthest make a curve, to about 500 frames ahead, of 100,000 particles to 17; else those that are due next
    /// are those that are shown next.
    fn spare(&mut self) {
        let farthest = self.waiting.keys().map(|&(_, frames)| frames).max();
        let between =
            |&&(_, frames): &&(u64, u32)| !frames.is_power_of_two() && Some(frames) != farthest;
        match self.waiting.keys().rev().find(between).copied() {
            Some(key) => self.waiting.remove(&key),
            None => self.waiting.pop_last().map(|(_, waiting)| waiting),
        };
    }

    /// Forgets what does not belong to this stream, or to its new beginning.
    fn follow(&mut self, stream: u64, restarted: bool) {
        if restarted || self.stream != Some(stream) {
            *self = Self { stream: Some(stream), ..self.anew() };
        }
    }

    fn compare(&mut self, truth: &Arc<Frame>, predicted: Arc<Frame>, ahead: Ahead) -> Option<Pair> {
        if truth.len() != predicted.len() {
            return None;
        }
        let model = mean_squared_distance(&predicted.position, &truth.position);
        let baselines = self.baselines(truth, ahead);
        self.pairs += 1;
        self.last = Some(ahead.frames);
        if !self.recent.contains_key(&ahead.frames) && self.recent.len() >= LENGTHS {
            let oldest = self.recent.iter().min_by_key(|(_, recent)| recent.used);
            let oldest = oldest.map(|(&frames, _)| frames);
            oldest.and_then(|frames| self.recent.remove(&frames));
        }
        let recent = self.recent.entry(ahead.frames).or_default();
        recent.used = self.pairs;
        let time = truth.stamp.seconds();
        recent.push(Squared { time, model, baselines });
        let best = recent.best().map(|(best, _)| best);
        let baseline = best.zip(baselines).map(|(best, all)| (best, all[best as usize].sqrt()));
        let error = model.sqrt();
        let point = Point { time, error, baseline: baseline.map(|(_, error)| error) };
        // Of several predictions of one instant the curve has that from farthest away.
        if self.time.back().is_some_and(|last| last.time >= time) {
            self.time.pop_back();
        }
        self.time.push_back(point);
        if self.time.len() > POINTS {
            self.time.pop_front();
        }
        Some(Pair { truth: Arc::clone(truth), predicted, ahead, error, baseline })
    }

    /// The squared errors of the baselines from the same observed frame.
    fn baselines(&mut self, truth: &Frame, ahead: Ahead) -> Option<[f64; Baseline::ALL.len()]> {
        if ahead.frames == 0 {
            return None;
        }
        let step = self.step(truth);
        let found = self
            .rollouts
            .iter()
            .position(|rollout| rollout.source == ahead.source && rollout.reached <= ahead.frames);
        let mut rollout = match found.and_then(|place| self.rollouts.remove(place)) {
            Some(rollout) => rollout,
            None => {
                let source = self.truths.get(&ahead.source)?;
                let state = || State {
                    position: source.position.clone(),
                    velocity: source.velocity.clone(),
                };
                Rollout { source: ahead.source, reached: 0, states: Baseline::ALL.map(|_| state()) }
            }
        };
        let frames = (ahead.frames - rollout.reached) as usize;
        if frames.saturating_mul(truth.len()) > ROLLED {
            return None;
        }
        for (baseline, state) in Baseline::ALL.into_iter().zip(&mut rollout.states) {
            (0..frames).for_each(|_| baseline.step(state, &step));
        }
        rollout.reached = ahead.frames;
        let errors =
            rollout.states.each_ref().map(|s| mean_squared_distance(&s.position, &truth.position));
        self.rollouts.push_back(rollout);
        let kept = (KEPT / truth.len().max(1)).clamp(1, 64);
        while self.rollouts.len() > kept {
            self.rollouts.pop_front();
        }
        Some(errors)
    }

    /// The ballistic step in the frame's domain: walls are as thick as in the model's.
    fn step(&self, frame: &Frame) -> Ballistic {
        let [lower, upper] = self.walls;
        let (seen, domain) = (self.domain, frame.domain);
        let moved = |wall: [f32; 2], from: [f32; 2], to: [f32; 2]| {
            [0, 1].map(|axis| wall[axis] + (to[axis] - from[axis]))
        };
        Ballistic {
            gravity: self.gravity,
            dt: frame.dt,
            lower: moved(lower, seen.lower, domain.lower),
            upper: moved(upper, seen.upper, domain.upper),
        }
    }

    /// The mean errors of the last second of simulation time, as many frames ahead as the last pair.
    pub fn summary(&self) -> Option<Summary> {
        let frames = self.last?;
        self.recent.get(&frames)?.summary(frames)
    }

    /// The simulation time of the last observed frame.
    pub fn now(&self) -> Option<f64> {
        self.truths.last_key_value().map(|(_, frame)| frame.stamp.seconds())
    }

    /// The last observed frame.
    pub(super) fn last_truth(&self) -> Option<&Arc<Frame>> {
        self.truths.last_key_value().map(|(_, frame)| frame)
    }

    /// The curves.
    pub fn curves(&self) -> Curves {
        let fresh = self.recent.iter().filter(|(_, recent)| recent.used + FRESH > self.pairs);
        Curves {
            time: self.time.iter().copied().collect(),
            ahead: fresh.filter_map(|(&frames, recent)| recent.summary(frames)).collect(),
        }
    }
}

/// How many frames of so many particles are kept.
fn room(particles: usize) -> usize {
    (WAITING_BYTES / (PARTICLE_BYTES * particles.max(1))).clamp(2, WAITING)
}

/// Makes room for one more: the oldest goes.
fn bound(frames: &mut BTreeMap<u64, Arc<Frame>>, particles: usize) {
    while frames.len() >= room(particles) {
        frames.pop_first();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{Material, Stamp};

    const DT: f32 = 0.016;

    /// One particle that falls freely from rest, seen `sequence` frames later.
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
        Comparison::within([0.0, -9.8], Domain::UNIT, [[0.05; 2], [0.95; 2]])
    }

    fn ahead(source: u64, frames: u32) -> Ahead {
        Ahead { source, frames, free: false }
    }

    #[test]
    fn a_prediction_meets_the_truth_of_its_instant_whichever_comes_first() {
        let mut comparison = comparison();
        assert!(comparison.truth(falling(0, 0.0)).is_none());
        assert!(comparison.prediction(falling(1, 0.01), ahead(0, 1)).is_none());
        let pair = comparison.truth(falling(1, 0.0)).unwrap();
        assert!((pair.error - 0.01).abs() < 1e-6, "{pair:?}");
        assert!(comparison.truth(falling(2, 0.0)).is_none());
        let late = comparison.prediction(falling(2, 0.02), ahead(1, 1)).unwrap();
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
                comparison.prediction(falling(sequence, 0.01), ahead(sequence - 5, 5));
            }
            comparison.truth(falling(sequence, 0.0));
        }
        let summary = comparison.summary().unwrap();
        assert_eq!(summary.frames, 5);
        let (best, error) = summary.baseline.unwrap();
        assert_eq!(best, Baseline::Ballistic);
        assert!(error < 1e-5, "{error}");
    }

    #[test]
    fn errors_are_averaged_over_a_second_however_many_frames_it_has() {
        let mut comparison = comparison();
        for (second, rate, error) in [(0, 62, 0.5), (1, 10, 0.01), (2, 200, 0.02)] {
            for i in 0..rate {
                let sequence = second * 1_000 + i;
                // A second of frames, then one without, so that no window holds two of them.
                let stamp = Stamp((second * 2_000_000_000 + i * 1_000_000_000 / rate) as i64);
                let truth = Frame { sequence, stamp, ..(*falling(0, 0.0)).clone() };
                let position = vec![[0.5, truth.position[0][1] + error]];
                let predicted = Frame { position, ..truth.clone() };
                comparison.prediction(Arc::new(predicted), ahead(sequence - i, 1));
                comparison.truth(Arc::new(truth));
            }
            let summary = comparison.summary().unwrap();
            assert!((summary.error - f64::from(error)).abs() < 1e-6, "{second}: {summary:?}");
        }
    }

    #[test]
    fn a_free_run_goes_on_from_the_frame_it_observed_last() {
        let mut comparison = comparison();
        comparison.truth(falling(0, 0.0));
        for sequence in 1..20 {
            let free = Ahead { source: 0, frames: sequence as u32, free: true };
            comparison.truth(falling(sequence, 0.0));
            let pair = comparison.prediction(falling(sequence, 0.001), free).unwrap();
            assert!(pair.baseline.unwrap().1 < 1e-5, "{pair:?}");
        }
        assert_eq!(comparison.rollouts.len(), 1, "one rollout that goes on");
        assert_eq!(comparison.curves().ahead.len(), 19);
        assert_eq!(comparison.curves().time.len(), 19);
    }

    #[test]
    fn what_waits_is_bounded_and_another_stream_begins_anew() {
        let mut comparison = comparison();
        for sequence in 0..2_000 {
            comparison.prediction(falling(sequence + 1_000, 0.0), ahead(sequence, 1_000));
            comparison.truth(falling(sequence, 0.0));
        }
        assert!(comparison.waiting.len() <= WAITING && comparison.truths.len() <= WAITING);
        let other = Frame { stream: 2, ..(*falling(7, 0.0)).clone() };
        comparison.truth(Arc::new(other));
        assert_eq!((comparison.truths.len(), comparison.waiting.len()), (1, 0));
        assert_eq!(room(100_000), 39);
    }

    #[test]
    fn a_long_horizon_of_all_frames_is_seen_to_its_end() {
        const HORIZON: u32 = 100;
        let mut comparison = comparison();
        for source in 0..400 {
            comparison.truth(falling(source, 0.0));
            for frames in 1..=HORIZON {
                let sequence = source + u64::from(frames);
                comparison.prediction(falling(sequence, 0.001), ahead(source, frames));
            }
        }
        let lengths: Vec<u32> = comparison.curves().ahead.iter().map(|s| s.frames).collect();
        for expected in [1, 2, 4, 8, 16, 32, 64, HORIZON] {
            assert!(lengths.contains(&expected), "{expected} of {lengths:?}");
        }
    }
}
