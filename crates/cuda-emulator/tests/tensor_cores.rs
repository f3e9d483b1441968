//! The encoder on tensor cores beside the exact one.

#[path = "../examples/problem/mod.rs"]
#[expect(dead_code, reason = "the examples use more of it")]
mod problem;

use std::sync::Arc;

use eddy_cuda::training::{InTraining as _, Settings};
use eddy_cuda_emulator::Emulator;
use eddy_inference::checkpoint::{Activation, Core, Sizes};
use problem::{Problem, worst};

#[test]
fn factors_in_tf32_give_the_gradients_of_exact_ones_but_for_rounding() {
    // More units than a block has, and a number of particles that leaves groups unfilled.
    let sizes = Sizes { encoder: 260, hidden: 10, layers: 1, particles: Some(75) };
    let cases = Activation::ALL.map(|activation| (activation, true));
    for (activation, one_hot) in cases.into_iter().chain([(Activation::Elu, false)]) {
        let mut problem = Problem::new(Core::MinGru, sizes.clone(), one_hot, Settings::plain(2, 2));
        problem.description.frame.activation = activation;
        let emulator = || Emulator::new(&problem.constants().unwrap()).unwrap();
        let step = |emulator: Emulator| {
            let mut training = problem.training(Arc::new(emulator)).unwrap();
            training.start(&problem.batches(1)).unwrap();
            (training.outcomes(1).unwrap()[0], training.gradients().unwrap())
        };
        let (exact, rounded) = (step(emulator()), step(emulator().with_tf32()));
        let error = worst(&rounded.1, &exact.1);
        let case = format!("{}, one_hot {one_hot}: relative error {error:.1e}", activation.name());
        assert!(error > 1e-7, "{case}: nothing was rounded");
        // The slope of ReLU jumps: a sum that rounding moves across 0 changes it by 1.
        let most = if activation == Activation::Relu { 2e-2 } else { 2e-3 };
        assert!(error < most, "{case}");
        assert!((rounded.0.loss / exact.0.loss - 1.0).abs() < 1e-4, "{case}");
    }
}
