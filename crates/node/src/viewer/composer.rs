//! The thread between the hub and the browsers: compares frames and encodes what is displayed.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use axum::body::Bytes;

use super::{Comparison, DisplayedFrame, Hub, Pair, PredictionInfo, hub::FrameCopy, wire};
use eddy_frames::{Frame, clock::Clock};

/// Longest wait before the stop flag is checked.
const MAX_WAIT: Duration = Duration::from_millis(50);
/// Interval between updates of the curves.
const CURVES_INTERVAL: Duration = Duration::from_millis(200);
/// Frames of one side without a counterpart after which the side is displayed alone.
const MAX_UNPAIRED_FRAMES: u32 = 4;
/// Longest time that an observed frame waits for its prediction: then it is displayed alone, as a paused source sends no other.
const MAX_HOLD: Duration = Duration::from_millis(250);
/// Relative decay of the top speed per frame.
const TOP_SPEED_DECAY: f32 = 0.002;
/// Speeds are encoded up to at most [`MAX_TOP_SPEED`] times this percentile: a few outliers would otherwise leave no levels for
/// the other particles.
const TYPICAL_PERCENTILE: f64 = 0.98;
const MAX_TOP_SPEED: f32 = 64.0;
/// Streams kept beside the displayed ones.
const KEPT_STREAMS: usize = 8;

/// One stream.
struct StreamView {
    comparison: Comparison,
    /// The newest prediction.
    predicted: Option<(Arc<Frame>, PredictionInfo)>,
    /// Predictions since the last observed frame.
    unobserved: u32,
    /// Observed frames since the last prediction.
    unpredicted: u32,
    /// Observed frames since the last one that was displayed with its prediction.
    unpaired: u32,
    /// The newest observed frame, if it is not displayed yet, and the time at which it came.
    held: Option<(Arc<Frame>, Duration)>,
    top_speed: f32,
    /// Time of the last update of the curves.
    curves_updated: Duration,
    used: Duration,
}

/// Runs until `stop` is raised.
pub(super) fn compose(hub: &Hub, comparison: &Comparison, stop: &AtomicBool) {
    let clock = Clock::start();
    let mut views: BTreeMap<u64, StreamView> = BTreeMap::new();
    while !stop.load(Ordering::Relaxed) {
        if !hub.is_watched() {
            // The next browser starts with empty curves.
            views.clear();
        }
        let copy = hub.next(MAX_WAIT);
        for (&stream, view) in &mut views {
            if let Some(displayed) = view.overdue(clock.now()) {
                view.show(hub, stream, displayed);
            }
        }
        let Some(copy) = copy else { continue };
        let (FrameCopy::Truth(frame) | FrameCopy::Prediction(frame, _)) = &copy;
        if frame.check().is_err() {
            continue;
        }
        let (stream, now) = (frame.stream, clock.now());
        if views.len() > KEPT_STREAMS {
            let oldest = views.iter().min_by_key(|(_, view)| view.used).map(|(&id, _)| id);
            oldest.and_then(|oldest| views.remove(&oldest));
        }
        let view =
            views.entry(stream).or_insert_with(|| StreamView::new(comparison.empty_copy(), now));
        view.used = now;
        let displayed = match copy {
            FrameCopy::Truth(frame) => {
                let frame = Arc::new(frame);
                view.held = Some((Arc::clone(&frame), now));
                view.truth(frame)
            }
            FrameCopy::Prediction(frame, info) => view.prediction(Arc::new(frame), info),
        };
        if let Some(displayed) = displayed {
            view.show(hub, stream, displayed);
        }
        if now.saturating_sub(view.curves_updated) > CURVES_INTERVAL {
            view.curves_updated = now;
            hub.store_curves(stream, view.comparison.curves());
        }
    }
}

impl StreamView {
    fn new(comparison: Comparison, now: Duration) -> Self {
        let (unobserved, unpredicted, unpaired) = (0, 0, MAX_UNPAIRED_FRAMES);
        let (predicted, top_speed) = (None, 0.0);
        Self {
            comparison,
            predicted,
            unobserved,
            unpredicted,
            unpaired,
            held: None,
            top_speed,
            curves_updated: now,
            used: now,
        }
    }

    fn show(&mut self, hub: &Hub, stream: u64, mut displayed: DisplayedFrame) {
        self.held = None;
        let top_speed = self.top_speed(&displayed);
        let prediction = displayed.prediction.as_ref().map(|(frame, _)| frame);
        if let Some(frame) = displayed.truth.as_ref().or(prediction) {
            let height = frame.domain.upper[1] - frame.domain.lower[1];
            displayed.shapes = hub.shapes(stream, frame.sequence, height);
        }
        hub.show(stream, &Bytes::from(wire::encode(&displayed, top_speed)));
    }

    /// Displays the newest observed frame alone if nothing was displayed for [`MAX_HOLD`] since it came.
    fn overdue(&self, now: Duration) -> Option<DisplayedFrame> {
        let (frame, came) = self.held.as_ref()?;
        let truth = (now.saturating_sub(*came) > MAX_HOLD).then(|| Arc::clone(frame))?;
        Some(DisplayedFrame { truth: Some(truth), ..DisplayedFrame::default() })
    }

    /// Displays an observed frame with its prediction, which is of the same instant; nothing yet if a free run is about to reach it, and
    /// nothing where few predictions are missing between others.
    fn truth(&mut self, frame: Arc<Frame>) -> Option<DisplayedFrame> {
        self.unobserved = 0;
        self.unpredicted = self.unpredicted.saturating_add(1);
        if let Some(pair) = self.comparison.truth(Arc::clone(&frame)) {
            self.unpaired = 0;
            return Some(displayed(pair));
        }
        self.unpaired = self.unpaired.saturating_add(1);
        let newest = self.predicted.as_ref().filter(|(newest, _)| newest.len() == frame.len());
        let behind = |(newest, info): &&(Arc<Frame>, PredictionInfo)| {
            info.free_running && newest.sequence < frame.sequence
        };
        if newest.filter(behind).is_some() && self.unpredicted <= MAX_UNPAIRED_FRAMES {
            return None;
        }
        (self.unpaired > MAX_UNPAIRED_FRAMES)
            .then(|| DisplayedFrame { truth: Some(frame), ..DisplayedFrame::default() })
    }

    /// Displays a prediction with its truth if that has arrived, or alone if no truth is expected.
    fn prediction(&mut self, frame: Arc<Frame>, info: PredictionInfo) -> Option<DisplayedFrame> {
        self.unpredicted = 0;
        self.unobserved = self.unobserved.saturating_add(1);
        let first = self.predicted.replace((Arc::clone(&frame), info)).is_none();
        if let Some(pair) = self.comparison.prediction(Arc::clone(&frame), info) {
            self.unpaired = 0;
            return Some(displayed(pair));
        }
        let truth = self.comparison.last_truth().cloned();
        let expected = match &truth {
            Some(_) => !info.free_running || self.unobserved <= MAX_UNPAIRED_FRAMES,
            // The frame that it was predicted from comes next, unless only predictions were recorded.
            None => first,
        };
        let truth = truth.filter(|truth| truth.len() == frame.len());
        let prediction = Some((frame, info));
        (!expected).then(|| DisplayedFrame { truth, prediction, ..DisplayedFrame::default() })
    }

    /// Speed of the fastest recent particle, without outliers (domain lengths per second).
    fn top_speed(&mut self, displayed: &DisplayedFrame) -> f32 {
        let prediction = displayed.prediction.as_ref().map(|(frame, _)| frame);
        let frame = displayed.truth.as_ref().or(prediction);
        let velocity = frame.map_or(&[][..], |frame| &frame.velocity);
        let mut speeds: Vec<f32> = velocity.iter().map(|v| v[0].hypot(v[1])).collect();
        let fastest = speeds.iter().copied().fold(0.0, f32::max);
        let index = (TYPICAL_PERCENTILE * speeds.len().saturating_sub(1) as f64) as usize;
        let typical = match speeds.is_empty() {
            true => 0.0,
            false => *speeds.select_nth_unstable_by(index, f32::total_cmp).1,
        };
        // Where nearly all particles are at rest, the moving ones are not outliers.
        let limit = if typical > 1e-3 { MAX_TOP_SPEED * typical } else { f32::INFINITY };
        let kept = self.top_speed * (1.0 - TOP_SPEED_DECAY);
        self.top_speed = fastest.max(kept).min(limit).max(1e-3);
        self.top_speed
    }
}

fn displayed(Pair { truth, predicted, info, error, baseline }: Pair) -> DisplayedFrame {
    let errors = [Some(error), baseline.map(|(_, error)| error)];
    let prediction = Some((predicted, info));
    DisplayedFrame { truth: Some(truth), prediction, errors, shapes: Vec::new() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_frames::{Domain, Material, Stamp};
    use eddy_inference::checkpoint::Checkpoint;

    fn frame(sequence: u64) -> Arc<Frame> {
        Arc::new(Frame {
            stream: 1,
            sequence,
            stamp: Stamp(0).advance(0.016, sequence as u32),
            dt: 0.016,
            domain: Domain::UNIT,
            position: vec![[0.5; 2]],
            velocity: vec![[0.0; 2]],
            material: vec![Material::Liquid],
        })
    }

    fn view() -> StreamView {
        let model = Checkpoint::shipped().unwrap().description;
        StreamView::new(Comparison::new(&model), Duration::ZERO)
    }

    /// Sequences of truth and prediction.
    fn sides(displayed: Option<DisplayedFrame>) -> Option<[Option<u64>; 2]> {
        displayed.map(|DisplayedFrame { truth, prediction, .. }| {
            [truth.map(|frame| frame.sequence), prediction.map(|(frame, _)| frame.sequence)]
        })
    }

    #[test]
    fn every_observed_frame_is_displayed_once_with_its_prediction() {
        let mut view = view();
        for sequence in 0..9 {
            // A node publishes its predictions before it passes on the observed frame.
            let info = PredictionInfo { source: sequence, horizon: 1, free_running: false };
            assert_eq!(sides(view.prediction(frame(sequence + 1), info)), None);
            let both = [Some(sequence), (sequence > 0).then_some(sequence)];
            assert_eq!(sides(view.truth(frame(sequence))), Some(both));
        }
    }

    #[test]
    fn both_sides_are_of_one_instant_however_far_ahead_and_single_losses_do_not_flicker() {
        const HORIZON: u64 = 20;
        let mut view = view();
        for sequence in 0..60 {
            let lost = sequence == 50;
            let ahead =
                PredictionInfo { source: sequence, horizon: HORIZON as u32, free_running: false };
            if sequence + HORIZON != 50 {
                assert_eq!(sides(view.prediction(frame(sequence + HORIZON), ahead)), None);
            }
            let expected = match sequence {
                _ if lost => None,
                HORIZON.. => Some([Some(sequence); 2]),
                _ => Some([Some(sequence), None]),
            };
            assert_eq!(sides(view.truth(frame(sequence))), expected, "{sequence}");
        }
    }

    #[test]
    fn a_frame_of_a_paused_source_is_displayed_without_its_prediction() {
        let hub = Hub::default();
        let mut view = view();
        for sequence in 0..8 {
            let info = PredictionInfo { source: sequence, horizon: 1, free_running: false };
            view.prediction(frame(sequence + 1), info);
            view.truth(frame(sequence));
        }
        // The prediction of frame 9 is missing.
        assert_eq!(sides(view.truth(frame(9))), None);
        let came = Duration::from_secs(7);
        view.held = Some((frame(9), came));
        assert_eq!(sides(view.overdue(came + MAX_HOLD)), None);
        let late = view.overdue(came + 2 * MAX_HOLD);
        assert_eq!(sides(late.clone()), Some([Some(9), None]));
        view.show(&hub, 1, late.unwrap());
        assert_eq!(sides(view.overdue(came + 9 * MAX_HOLD)), None, "displayed once");
    }

    #[test]
    fn a_free_run_is_displayed_with_its_truth_whichever_is_ahead_and_continues_alone() {
        for behind in [true, false] {
            let mut view = view();
            view.truth(frame(0));
            for sequence in 1..9 {
                let free =
                    PredictionInfo { source: 0, horizon: sequence as u32, free_running: true };
                let pair = Some([Some(sequence); 2]);
                if behind {
                    let early = sides(view.truth(frame(sequence)));
                    assert!(sequence == 1 || early.is_none(), "{early:?}");
                    assert_eq!(sides(view.prediction(frame(sequence), free)), pair);
                } else {
                    assert_eq!(sides(view.prediction(frame(sequence), free)), None);
                    assert_eq!(sides(view.truth(frame(sequence))), pair);
                }
            }
            let alone = |sequence: u64| {
                (
                    frame(sequence),
                    PredictionInfo { source: 0, horizon: sequence as u32, free_running: true },
                )
            };
            let displayed = (9..15).map(|sequence| {
                let (frame, info) = alone(sequence);
                sides(view.prediction(frame, info))
            });
            assert_eq!(displayed.last().unwrap(), Some([Some(8), Some(14)]));
        }
    }

    #[test]
    fn a_free_run_far_behind_is_displayed_with_the_truth_of_its_instants() {
        const BEHIND: u64 = 40;
        let mut view = view();
        for sequence in 0..=BEHIND {
            view.truth(frame(sequence));
        }
        for sequence in 1..100 {
            let free = PredictionInfo { source: 0, horizon: sequence as u32, free_running: true };
            let pair = Some([Some(sequence); 2]);
            assert_eq!(sides(view.prediction(frame(sequence), free)), pair);
            assert_eq!(sides(view.truth(frame(sequence + BEHIND))), None);
        }
        // When it ends, the truth continues alone.
        let alone = (0..9).map(|more| sides(view.truth(frame(100 + BEHIND + more))));
        assert_eq!(alone.last().unwrap(), Some([Some(108 + BEHIND), None]));
    }

    #[test]
    fn one_outlier_leaves_levels_for_the_others() {
        let mut view = view();
        let mut fast = (*frame(1)).clone();
        fast.position = vec![[0.5; 2]; 100];
        fast.velocity = vec![[0.0, 0.5]; 100];
        fast.material = vec![Material::Liquid; 100];
        let mut shown = |velocity: [f32; 2]| {
            fast.velocity[0] = velocity;
            let truth = Some(Arc::new(fast.clone()));
            view.top_speed(&DisplayedFrame { truth, ..DisplayedFrame::default() })
        };
        assert_eq!(shown([9.0, 0.0]), 9.0);
        // Kept for a while.
        assert!((8.9..9.0).contains(&shown([0.0, 0.5])));
        assert_eq!(shown([1e6, 0.0]), 32.0);
    }

    #[test]
    fn predictions_without_any_truth_are_displayed_alone() {
        let mut view = view();
        let info = PredictionInfo::default();
        assert_eq!(sides(view.prediction(frame(1), info)), None);
        assert_eq!(sides(view.prediction(frame(2), info)), Some([None, Some(2)]));
    }
}
