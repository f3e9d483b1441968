//! Estimates by known regressions, and features of known motions.

use std::fs;

use super::*;
use crate::checkpoint::{Architecture, CheckpointError, Core, Description, Sizes};
use eddy_frames::{Domain, Frame, FrameView, Material, Stamp};

/// The sum of an intercept and a feature.
fn linear(intercept: f32, feature: usize) -> Linear {
    let mut weights = [0.0; FEATURES];
    weights[feature] = 1.0;
    Linear { intercept, weights }
}

/// Residuals are spread evenly over -0.2 to 0.2.
fn model() -> ErrorModel {
    let residuals = LEVELS.map(|level| 0.4 * (level - 0.5));
    let at = |frames: u32, intercept: f32| CalibratedHorizon {
        frames,
        error: Regression { linear: linear(intercept, 0), residuals },
        worse_than_ballistic: linear(-0.1 * frames as f32, 4),
    };
    ErrorModel {
        format_version: 1,
        checkpoint: "abc".to_owned(),
        data: "def".to_owned(),
        streams: 12,
        rollouts: 84,
        seen: vec!["0123".to_owned()],
        horizons: vec![at(2, -2.0), at(8, 0.0)],
    }
}

fn features(first: f32, fifth: f32) -> Features {
    let mut numbers = [0.0; FEATURES];
    (numbers[0], numbers[4]) = (first, fifth);
    Features(numbers)
}

#[test]
fn an_estimate_is_the_regression_with_the_quantiles_of_its_residuals() {
    let found = model().at(2).unwrap().estimate(&features(-6.0, 0.2));
    assert_eq!(found.horizon, 2);
    assert!((found.expected.ln() - 0.5 * (-2.0 - 6.0)).abs() < 1e-5, "{found:?}");
    assert!((found.upper / found.expected - (0.5f32 * 0.4 * 0.4).exp()).abs() < 1e-5, "{found:?}");
    // The logit is -0.2 + 0.2.
    assert!((found.worse_than_ballistic - 0.5).abs() < 1e-5, "{found:?}");
    let doubtful = model().at(2).unwrap().estimate(&features(-6.0, 1.2));
    assert!((doubtful.worse_than_ballistic - 0.731_059).abs() < 1e-5, "{doubtful:?}");
}

#[test]
fn levels_of_values_are_those_of_their_quantiles_and_beyond_them_0_or_1() {
    let CalibratedHorizon { error, .. } = &model().horizons[0];
    let features = features(-6.0, 0.0);
    for level in [0.02, 0.33, 0.5, 0.98] {
        let value = error.quantile(&features, level);
        assert!((error.level(&features, value) - level).abs() < 1e-5, "{level}");
    }
    let [lowest, highest] = [0.0, 1.0].map(|level| error.quantile(&features, level));
    assert_eq!(error.level(&features, lowest - 0.01), 0.0);
    assert_eq!(error.level(&features, highest + 0.01), 1.0);
}

#[test]
fn between_calibrated_horizons_logarithms_are_interpolated_and_beyond_there_is_no_estimate() {
    let (model, features) = (model(), features(-6.0, 0.0));
    let estimate = |horizon| model.at(horizon).unwrap().estimate(&features);
    let expected = |horizon| estimate(horizon).expected.ln();
    // 4 is half way from 2 to 8.
    assert!((expected(4) - 0.5 * (expected(2) + expected(8))).abs() < 1e-5);
    assert_eq!(expected(1), expected(2));
    assert_eq!(estimate(5).horizon, 5);
    assert_eq!(model.at(9), None);
}

#[test]
fn a_file_is_read_as_it_was_written_and_a_damaged_one_is_rejected_by_its_field() {
    let folder = tempfile::tempdir().unwrap();
    model().save(folder.path()).unwrap();
    assert_eq!(load(folder.path()).unwrap(), Some(model()));
    let file = folder.path().join(ERROR_MODEL_FILE);
    let text = fs::read_to_string(&file).unwrap();
    for (from, to, words) in [
        ("format_version = 1", "format_version = 3", "format_version: found 3, expected 1"),
        ("frames = 8", "frames = 2", "horizons[1].frames: found 2, expected more than 2"),
        (
            "intercept = -2.0",
            "intercept = nan",
            "horizons[0].error.linear: found NaN, expected finite",
        ),
        ("streams = 12", "stream = 12", "unknown field `stream`"),
    ] {
        assert!(text.contains(from), "{text}");
        fs::write(&file, text.replacen(from, to, 1)).unwrap();
        let error = load(folder.path()).unwrap_err();
        assert!(error.to_string().contains(words), "{error}");
    }
    let mut falling = model();
    falling.horizons[0].error.residuals.reverse();
    let error = falling.save(folder.path()).unwrap_err();
    let expected = "horizons[0].error.residuals";
    assert!(matches!(&error, CheckpointError::Field { field, .. } if field == expected));
    fs::remove_file(file).unwrap();
    assert_eq!(load(folder.path()).unwrap(), None);
}

const DT: f32 = 0.5;

fn description() -> Description {
    let sizes = Sizes { encoder: 8, hidden: 8, layers: 1, particles: None };
    let gravity = [0.0, -1.0];
    let untrained = Description::untrained(Architecture::Particle, Core::MinGru, sizes);
    Description { dt: DT, gravity, ..untrained }
}

/// Two particles at the same height with the same velocity.
fn frame(height: f32, velocity: f32) -> Frame {
    Frame {
        stream: 1,
        sequence: 0,
        stamp: Stamp(0),
        dt: DT,
        domain: Domain::UNIT,
        position: vec![[0.25, height], [0.75, height]],
        velocity: vec![[0.0, velocity]; 2],
        material: vec![Material::Liquid, Material::Rope],
    }
}

/// The length of a logarithm of a mean square.
fn length(logarithm: f32) -> f32 {
    (0.5 * logarithm).exp()
}

#[test]
fn features_are_the_errors_and_motions_that_a_stream_has_shown() {
    let mut tracker = ErrorTracker::new(&description(), &Domain::UNIT, &frame(0.5, 0.0).material);
    tracker.observe(&FrameView::from(&frame(0.9, 0.0)), None);
    assert_eq!(tracker.features(&frame(0.8, 0.0), 1), None, "nothing was compared yet");
    // The ballistic step leads to 0.9 - 0.125; the truth is 0.8.
    tracker.observe(&FrameView::from(&frame(0.8, -0.3)), Some(&frame(0.81, -0.1)));
    let Features(found) = tracker.features(&frame(0.7, 0.0), 1).unwrap();
    // The next ballistic step leads to 0.8 - 0.15 - 0.125.
    let expected = [0.01, 0.025, 0.175, 0.1];
    for (found, expected) in found.into_iter().zip(expected) {
        assert!((length(found) - expected).abs() < 1e-4, "{found}: {expected}");
    }
    assert_eq!(found[4..], [0.5, 0.0, 0.0], "shares of liquid, snow and jelly");

    // A prediction that is not finite is not compared.
    let before = tracker.clone();
    tracker.observe(&FrameView::from(&frame(0.8, -0.3)), Some(&frame(f32::NAN, 0.0)));
    assert_eq!((tracker.recent, tracker.compared), (before.recent, 1));
    tracker.forget();
    assert_eq!(tracker.features(&frame(0.7, 0.0), 1), None);
}

#[test]
fn a_prediction_is_compared_with_the_extrapolation_over_as_many_frames_in_any_order() {
    let observed = frame(0.9, 0.1);
    let tracker = || {
        let mut tracker = ErrorTracker::new(&description(), &Domain::UNIT, &observed.material);
        tracker.observe(&FrameView::from(&observed), None);
        tracker.observe(&FrameView::from(&observed), Some(&observed));
        tracker
    };
    let mut all = tracker();
    let later = frame(0.3, 0.0);
    for horizon in [1, 3, 2, 2, 5] {
        assert_eq!(all.features(&later, horizon), tracker().features(&later, horizon));
    }
    assert_ne!(all.features(&later, 1), all.features(&later, 2));
}
