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
use crate::{clock::Clock, frame::Frame};

/// How long a wait may last before the end is looked for.
const PATIENCE: Duration = Duration::from_millis(50);
/// Time between two looks at the curves.
const CURVES: Duration = Duration::from_millis(200);
/// A side that was silent for so long is not waited for.
const SILENT: Duration = Duration::from_millis(300);
/// The top speed falls by this share with every frame that does not reach it, so that colours do not flicker.
const FORGOTTEN: f32 = 0.002;
/// Streams that are kept though nobody looks at them.
const KEPT: usize = 8;

/// What is known of one stream.
struct Scene {
    comparison: Comparison,
    /// The newest prediction, and when it came.
    predicted: Option<(Arc<Frame>, Ahead, Duration)>,
    /// When the last truth came.
    observed: Duration,
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
            Copied::Truth(frame) => scene.truth(Arc::new(frame), now),
            Copied::Prediction(frame, ahead) => scene.prediction(Arc::new(frame), ahead, now),
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
        let (observed, drawn, used) = (Duration::ZERO, now, now);
        Self { comparison, predicted: None, observed, top_speed: 0.0, drawn, used }
    }

    /// What is shown when the truth came: with the prediction for it; where a free run is on its way to it, nothing yet.
    fn truth(&mut self, frame: Arc<Frame>, now: Duration) -> Option<Shown> {
        self.observed = now;
        if let Some(pair) = self.comparison.truth(Arc::clone(&frame)) {
            return Some(shown(pair));
        }
        let newest = self.predicted.as_ref().filter(|(newest, ..)| newest.len() == frame.len());
        let on_its_way = newest.is_some_and(|(newest, ahead, when)| {
            ahead.free && newest.sequence < frame.sequence && now.saturating_sub(*when) < SILENT
        });
        if on_its_way {
            return None;
        }
        // A prediction of long ago says nothing.
        let newest = newest.filter(|(_, _, when)| now.saturating_sub(*when) < SILENT);
        let prediction = newest.map(|(newest, ahead, _)| (Arc::clone(newest), *ahead));
        Some(Shown { truth: Some(frame), prediction, ..Shown::default() })
    }

    /// What is shown when a prediction came: with its truth, if that was there; without, if no truth is to be expected.
    fn prediction(&mut self, frame: Arc<Frame>, ahead: Ahead, now: Duration) -> Option<Shown> {
        self.predicted = Some((Arc::clone(&frame), ahead, now));
        if let Some(pair) = self.comparison.prediction(Arc::clone(&frame), ahead) {
            return Some(shown(pair));
        }
        if now.saturating_sub(self.observed) < SILENT {
            return None;
        }
        let truth = self.comparison.last_truth().filter(|truth| truth.len() == frame.len());
        let truth = truth.cloned().filter(|_| ahead.free);
        Some(Shown { truth, prediction: Some((frame, ahead)), ..Shown::default() })
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
