//! One thread between the hub and the browsers: compares what was copied, and encodes what is shown.

use std::{
    collections::BTreeMap,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use axum::body::Bytes;

use super::{Ahead, Comparison, Hub, Pair, Shown, hub::Copied, wire};
use eddy_frames::{Frame, clock::Clock};

/// How long a wait may last before the end is looked for.
const PATIENCE: Duration = Duration::from_millis(50);
/// Time between two looks at the curves.
const CURVES: Duration = Duration::from_millis(200);
/// Frames of one side without one of the other after which the other is not waited for.
const ALONE: u32 = 4;
/// Frames by which a prediction may be away from the truth beside which it is shown, and its own number of frames ahead.
const APART: u64 = 4;
/// The top speed falls by this share with every frame that does not reach it, so that colours do not flicker.
const FORGOTTEN: f32 = 0.002;
/// Streams that are kept though nobody looks at them.
const KEPT: usize = 8;

/// What is known of one stream.
struct Scene {
    comparison: Comparison,
    /// The newest prediction.
    predicted: Option<(Arc<Frame>, Ahead)>,
    /// Predictions since the last truth, and truths since the last prediction.
    unobserved: u32,
    unpredicted: u32,
    top_speed: f32,
    drawn: Duration,
    used: Duration,
}

/// Composes until `stop` is raised.
pub(super) fn compose(hub: &Hub, comparison: &Comparison, stop: &AtomicBool) {
    let clock = Clock::start();
    let mut scenes: BTreeMap<u64, Scene> = BTreeMap::new();
    while !stop.load(Ordering::Relaxed) {
        if !hub.is_watched() {
            // Who comes next begins with what is then.
            scenes.clear();
        }
        let Some(copied) = hub.next(PATIENCE) else { continue };
        let (Copied::Truth(frame) | Copied::Prediction(frame, _)) = &copied;
        if frame.check().is_err() {
            continue;
        }
        let (stream, now) = (frame.stream, clock.now());
        if scenes.len() > KEPT {
            let oldest = scenes.iter().min_by_key(|(_, scene)| scene.used).map(|(&id, _)| id);
            oldest.and_then(|oldest| scenes.remove(&oldest));
        }
        let scene = scenes.entry(stream).or_insert_with(|| Scene::new(comparison.anew(), now));
        scene.used = now;
        let shown = match copied {
            Copied::Truth(frame) => scene.truth(Arc::new(frame)),
            Copied::Prediction(frame, ahead) => scene.prediction(Arc::new(frame), ahead),
        };
        if let Some(shown) = shown {
            let top_speed = scene.top_speed(&shown);
            hub.show(stream, &Bytes::from(wire::encode(&shown, top_speed)));
        }
        if now.saturating_sub(scene.drawn) > CURVES {
            scene.drawn = now;
            hub.draw(stream, scene.comparison.curves());
        }
    }
}

impl Scene {
    fn new(comparison: Comparison, now: Duration) -> Self {
        let (unobserved, unpredicted) = (0, 0);
        let (predicted, top_speed) = (None, 0.0);
        Self { comparison, predicted, unobserved, unpredicted, top_speed, drawn: now, used: now }
    }

    /// What is shown when the truth came: with the prediction for it; where a free run is on its way to it, nothing yet.
    fn truth(&mut self, frame: Arc<Frame>) -> Option<Shown> {
        self.unobserved = 0;
        self.unpredicted = self.unpredicted.saturating_add(1);
        if let Some(pair) = self.comparison.truth(Arc::clone(&frame)) {
            return Some(shown(pair));
        }
        let newest = self.predicted.as_ref().filter(|(newest, _)| newest.len() == frame.len());
        let behind =
            |(newest, ahead): &&(Arc<Frame>, Ahead)| ahead.free && newest.sequence < frame.sequence;
        if newest.filter(behind).is_some() && self.unpredicted <= ALONE {
            return None;
        }
        let near = |(newest, ahead): &&(Arc<Frame>, Ahead)| {
            newest.sequence.abs_diff(frame.sequence) <= APART + u64::from(ahead.frames)
                && newest.sequence.saturating_add(APART) >= frame.sequence
        };
        let prediction = newest.filter(near).cloned();
        Some(Shown { truth: Some(frame), prediction, ..Shown::default() })
    }

    /// What is shown when a prediction came: with its truth, if that was there; without, if no truth is to be expected.
    fn prediction(&mut self, frame: Arc<Frame>, ahead: Ahead) -> Option<Shown> {
        self.unpredicted = 0;
        self.unobserved = self.unobserved.saturating_add(1);
        let first = self.predicted.replace((Arc::clone(&frame), ahead)).is_none();
        if let Some(pair) = self.comparison.prediction(Arc::clone(&frame), ahead) {
            return Some(shown(pair));
        }
        let truth = self.comparison.last_truth().cloned();
        let expected = match &truth {
            Some(_) => !ahead.free || self.unobserved <= ALONE,
            // What it was predicted from comes next, unless nobody records it.
            None => first,
        };
        let truth = truth.filter(|truth| truth.len() == frame.len());
        (!expected).then(|| Shown { truth, prediction: Some((frame, ahead)), ..Shown::default() })
    }

    /// The fastest particle lately (domain lengths per second).
    fn top_speed(&mut self, shown: &Shown) -> f32 {
        let frame = shown.truth.as_ref().or(shown.prediction.as_ref().map(|(frame, _)| frame));
        let square = |v: &[f32; 2]| v[0] * v[0] + v[1] * v[1];
        let fastest = frame.into_iter().flat_map(|frame| frame.velocity.iter().map(square));
        let fastest = fastest.fold(0.0, f32::max).sqrt();
        self.top_speed = fastest.max(self.top_speed * (1.0 - FORGOTTEN)).max(1e-3);
        self.top_speed
    }
}

fn shown(Pair { truth, predicted, ahead, error, baseline }: Pair) -> Shown {
    let errors = [Some(error), baseline.map(|(_, error)| error)];
    Shown { truth: Some(truth), prediction: Some((predicted, ahead)), errors }
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

    fn scene() -> Scene {
        let model = Checkpoint::shipped().unwrap().description;
        Scene::new(Comparison::new(&model), Duration::ZERO)
    }

    /// Sequences of what is shown: truth, prediction.
    fn sides(shown: Option<Shown>) -> Option<[Option<u64>; 2]> {
        shown.map(|Shown { truth, prediction, .. }| {
            [truth.map(|frame| frame.sequence), prediction.map(|(frame, _)| frame.sequence)]
        })
    }

    #[test]
    fn every_observed_frame_is_shown_once_with_its_prediction() {
        let mut scene = scene();
        for sequence in 0..9 {
            // The node publishes before it shows what it predicted from.
            let ahead = Ahead { source: sequence, frames: 1, free: false };
            assert_eq!(sides(scene.prediction(frame(sequence + 1), ahead)), None);
            let both = [Some(sequence), Some(sequence.max(1))];
            assert_eq!(sides(scene.truth(frame(sequence))), Some(both));
        }
    }

    #[test]
    fn a_free_run_is_shown_with_its_truth_whichever_is_ahead_and_goes_on_without() {
        for behind in [true, false] {
            let mut scene = scene();
            scene.truth(frame(0));
            for sequence in 1..9 {
                let free = Ahead { source: 0, frames: sequence as u32, free: true };
                let pair = Some([Some(sequence); 2]);
                if behind {
                    let early = sides(scene.truth(frame(sequence)));
                    assert!(sequence == 1 || early.is_none(), "{early:?}");
                    assert_eq!(sides(scene.prediction(frame(sequence), free)), pair);
                } else {
                    assert_eq!(sides(scene.prediction(frame(sequence), free)), None);
                    assert_eq!(sides(scene.truth(frame(sequence))), pair);
                }
            }
            let alone = |sequence: u64| {
                (frame(sequence), Ahead { source: 0, frames: sequence as u32, free: true })
            };
            let shown = (9..15).map(|sequence| {
                let (frame, ahead) = alone(sequence);
                sides(scene.prediction(frame, ahead))
            });
            assert_eq!(shown.last().unwrap(), Some([Some(8), Some(14)]));
        }
    }

    #[test]
    fn a_free_run_far_behind_is_shown_with_the_truth_of_its_instants() {
        const BEHIND: u64 = 40;
        let mut scene = scene();
        for sequence in 0..=BEHIND {
            scene.truth(frame(sequence));
        }
        for sequence in 1..100 {
            let free = Ahead { source: 0, frames: sequence as u32, free: true };
            let pair = Some([Some(sequence); 2]);
            assert_eq!(sides(scene.prediction(frame(sequence), free)), pair);
            assert_eq!(sides(scene.truth(frame(sequence + BEHIND))), None);
        }
        // When it ends, the truth goes on alone.
        let alone = (0..9).map(|more| sides(scene.truth(frame(100 + BEHIND + more))));
        assert_eq!(alone.last().unwrap(), Some([Some(108 + BEHIND), None]));
    }

    #[test]
    fn predictions_without_any_truth_are_shown_alone() {
        let mut scene = scene();
        let ahead = Ahead { source: 0, frames: 0, free: false };
        assert_eq!(sides(scene.prediction(frame(1), ahead)), None);
        assert_eq!(sides(scene.prediction(frame(2), ahead)), Some([None, Some(2)]));
    }
}
