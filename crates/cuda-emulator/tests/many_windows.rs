//! Batches with more frames than a grid has blocks along one axis.

#[path = "../examples/problem/mod.rs"]
#[expect(dead_code, reason = "the examples use more of it")]
mod problem;

use std::{collections::BTreeMap, sync::Arc};

use eddy_cuda::training::{InTraining as _, Outcome, Settings};
use eddy_cuda_emulator::Emulator;
use eddy_inference::checkpoint::{Core, Pooling, Sizes, Weights};
use problem::{Problem, Result, worst};

/// A step on so many windows of 16 frames, of which only two differ.
fn step(windows: usize) -> Result<(Outcome, BTreeMap<String, Weights>)> {
    let problem = |windows: usize| {
        let sizes = Sizes { encoder: 5, hidden: 6, layers: 1, particles: Some(3) };
        let problem = Problem::new(Core::MinGru, sizes, true, Settings::plain(windows, 16));
        problem.with_pooling(Pooling::MeanMax)
    };
    let mut batches = problem(2).batches(1);
    let two = std::mem::take(&mut batches[0].windows);
    batches[0].windows = two.into_iter().cycle().take(windows).collect();
    let problem = problem(windows);
    let mut training = problem.training(Arc::new(Emulator::new(&problem.constants()?)?))?;
    training.start(&batches)?;
    Ok((training.outcomes(1)?[0], training.gradients()?))
}

#[test]
fn windows_that_are_repeated_have_the_loss_and_gradients_of_two() {
    let (few, expected) = step(2).unwrap();
    // The paper's batch: 65,536 frames, one more than a grid has blocks along y.
    let (many, found) = step(4096).unwrap();
    assert!((many.loss / few.loss - 1.0).abs() < 1e-5, "{many:?}, expected {few:?}");
    let error = worst(&found, &expected);
    assert!(error < 1e-4, "gradients: relative error {error:.1e}");
}
