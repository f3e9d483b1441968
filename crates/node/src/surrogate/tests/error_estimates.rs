//! Estimates of the errors of published predictions.

use std::time::Duration;

use super::*;
use eddy_frames::FrameView;
use eddy_inference::error_model::{
    CalibratedHorizon, ErrorEstimate, ErrorModel, ErrorTracker, FEATURES, LEVELS, Linear,
    Regression,
};

/// A model that is calibrated up to 4 frames ahead.
fn calibrated() -> Surrogate {
    let uncalibrated = checkpoint();
    let linear = |weight: f32| Linear { intercept: 0.5, weights: [weight; FEATURES] };
    let at = |frames: u32| CalibratedHorizon {
        frames,
        error: Regression {
            linear: linear(0.1 * frames as f32),
            residuals: LEVELS.map(|level| level - 0.5),
        },
        worse_than_ballistic: linear(-0.01),
    };
    let error_model = ErrorModel {
        format_version: 1,
        checkpoint: uncalibrated.digest(),
        data: String::new(),
        streams: 10,
        rollouts: 70,
        seen: Vec::new(),
        horizons: vec![at(1), at(4)],
    };
    let checkpoint = Checkpoint { error_model: Some(error_model), ..uncalibrated };
    Surrogate::load(&checkpoint, None).unwrap()
}

/// The number of frames ahead and the estimate of each prediction.
type Estimates = Vec<(u32, Option<ErrorEstimate>)>;

fn estimates(node: &mut SurrogateNode, frames: Vec<Frame>) -> Estimates {
    let mut found = Vec::new();
    let mut arrivals: Vec<_> =
        frames.into_iter().map(|frame| (Duration::ZERO, Payload::Frame(frame))).collect();
    node.on_frames(&mut arrivals, None, &mut |_, result| {
        found.extend(result.ok().map(|prediction| (prediction.horizon, prediction.expected_error)));
    });
    found
}

/// What a tracker estimates from the frames of stream 1 with these sequences, of which those in `compared` were predicted from
/// the frame before them.
fn directly_estimated(sequences: &[u64], compared: &[u64], horizons: &[u32]) -> Estimates {
    let surrogate = calibrated();
    let model = surrogate.error_model().unwrap();
    let first = frame(1, sequences[0]);
    let mut tracker = ErrorTracker::new(surrogate.description(), &first.domain, &first.material);
    let mut memory = surrogate.start(&first).unwrap();
    let (mut stepper, mut predicted) = (surrogate.stepper(), first);
    for &sequence in sequences {
        while predicted.sequence < sequence {
            predicted = stepper.step(&mut memory, &predicted);
        }
        let observed = frame(1, sequence);
        let before = compared.contains(&sequence).then_some(&predicted);
        tracker.observe(&FrameView::from(&observed), before);
        predicted = stepper.step(&mut memory, &observed);
    }
    let mut ahead = 1;
    let estimate = |&horizon: &u32| {
        while ahead < horizon {
            predicted = stepper.step(&mut memory, &predicted);
            ahead += 1;
        }
        (horizon, tracker.estimate(model, &predicted, horizon))
    };
    horizons.iter().map(estimate).collect()
}

#[test]
fn each_prediction_has_the_estimate_for_its_horizon_up_to_the_last_calibrated_one() {
    let sequences: Vec<u64> = (0..6).collect();
    for (publish, horizons) in [(Publish::All, &[1, 2, 3, 4, 5][..]), (Publish::Last, &[5])] {
        let settings = NodeSettings { horizon: 5, publish, ..NodeSettings::default() };
        let mut node = SurrogateNode::new(calibrated(), settings).unwrap();
        let mut found = Vec::new();
        for &sequence in &sequences {
            found = estimates(&mut node, vec![frame(1, sequence)]);
        }
        assert_eq!(found, directly_estimated(&sequences, &sequences[1..], horizons));
        assert_eq!(found.last().unwrap(), &(5, None));
    }
    let settings = NodeSettings { horizon: 4, ..NodeSettings::default() };
    let mut node = SurrogateNode::new(calibrated(), settings).unwrap();
    let woven = sequences.iter().flat_map(|&s| [frame(1, s), frame(2, s)]).collect();
    let found = estimates(&mut node, woven);
    let expected = directly_estimated(&sequences, &sequences[1..], &[4]);
    assert_eq!(found[found.len() - 2], expected[0]);
    assert!(expected[0].1.is_some());
}

#[test]
fn a_frame_after_a_gap_is_not_compared_with_a_prediction_over_the_gap() {
    let mut node = SurrogateNode::new(calibrated(), NodeSettings::default()).unwrap();
    let frames = |sequences: &[u64]| sequences.iter().map(|&s| frame(1, s)).collect();
    estimates(&mut node, frames(&[0, 1, 2, 3]));
    let found = estimates(&mut node, frames(&[6]));
    assert_eq!(found, directly_estimated(&[0, 1, 2, 3, 6], &[1, 2, 3], &[1]));
}

#[test]
fn nothing_is_estimated_after_a_long_gap_until_a_prediction_was_compared_again() {
    let mut node = SurrogateNode::new(calibrated(), NodeSettings::default()).unwrap();
    let frames = |sequences: &[u64]| sequences.iter().map(|&s| frame(1, s)).collect();
    estimates(&mut node, frames(&[0, 1, 2, 3]));
    let found = estimates(&mut node, frames(&[20, 21, 22]));
    assert_eq!(node.counters().resets, 1);
    assert_eq!(found, directly_estimated(&[20, 21, 22], &[21, 22], &[1]));
    assert!(found[0].1.is_some());
}

#[test]
fn a_free_run_is_estimated_from_the_last_observed_frame() {
    let settings = NodeSettings { free_run: Some(5), ..NodeSettings::default() };
    let mut node = SurrogateNode::new(calibrated(), settings).unwrap();
    estimates(&mut node, (0..5).map(|s| frame(1, s)).collect());
    let mut found = Vec::new();
    for _ in 0..5 {
        let due = node.next_tick().unwrap();
        node.on_tick(due, &mut |_, result| {
            found.extend(
                result.ok().map(|prediction| (prediction.horizon, prediction.expected_error)),
            );
        });
    }
    let sequences: Vec<u64> = (0..5).collect();
    assert_eq!(found, directly_estimated(&sequences, &sequences[1..], &[1, 2, 3, 4, 5]));
}

#[test]
fn a_model_that_was_calibrated_as_another_one_estimates_nothing() {
    let mut checkpoint = checkpoint();
    let error_model = calibrated().error_model().unwrap().clone();
    checkpoint.description.warm_up += 1;
    let checkpoint = Checkpoint { error_model: Some(error_model), ..checkpoint };
    let surrogate = Surrogate::load(&checkpoint, None).unwrap();
    assert_eq!(surrogate.error_model(), None);
    let mut node = SurrogateNode::new(surrogate, NodeSettings::default()).unwrap();
    let found = estimates(&mut node, (0..5).map(|s| frame(1, s)).collect());
    assert_eq!(found, [(1, None), (1, None)]);
}
