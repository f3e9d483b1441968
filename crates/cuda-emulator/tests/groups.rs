//! Several devices, each with a part of every batch, beside one with all of it.

#[path = "../examples/problem/mod.rs"]
#[expect(dead_code, reason = "the examples use more of it")]
mod problem;

use std::sync::Arc;

use eddy_cuda::training::{InTraining as _, Outcome, Settings};
use eddy_cuda_emulator::Emulator;
use eddy_inference::checkpoint::{Core, Sizes};
use problem::{Problem, train_together, worst};

#[test]
fn two_devices_take_the_steps_that_one_takes_with_both_parts_of_the_batch() {
    for core in [Core::MinGru, Core::Lstm] {
        let sizes = Sizes { encoder: 6, hidden: 10, layers: 2, particles: Some(20) };
        let settings = Settings {
            unroll: 3,
            density_weight: 0.3,
            density_nodes: 9,
            dropout: 0.2,
            noise: [0.01, 0.1],
            clip: 0.05,
            epsilon: 1e-4,
            average: true,
            ..Settings::plain(6, 3)
        };
        let problem = Problem::new(core, sizes, true, settings);
        let constants = problem.constants().unwrap();
        let batches = problem.batches(4);

        let mut training = problem.training(Arc::new(Emulator::new(&constants).unwrap())).unwrap();
        training.start(&batches).unwrap();
        let expected: Vec<Outcome> = training.outcomes(4).unwrap();
        let weights = training.weights().unwrap();

        let devices = Emulator::group(&constants, 2).unwrap();
        let found = train_together(&problem, devices, &batches).unwrap();
        assert!(found[0] == found[1], "all devices have the same bits");
        for (found, expected) in found[0].0.iter().zip(&expected) {
            let apart = |a: f32, b: f32| f64::from(a / b - 1.0).abs();
            assert!(apart(found.loss, expected.loss) < 1e-5, "{found:?}, {expected:?}");
            assert!(apart(found.gradient_norm, expected.gradient_norm) < 1e-5, "{found:?}");
        }
        let apart = worst(&found[0].1, &weights);
        assert!(apart < 1e-6, "{}: weights: relative error {apart:.1e}", core.name());
    }
}
