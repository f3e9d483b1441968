//! Trajectories in the memory of the host beside those on the device.

#[path = "../examples/problem/mod.rs"]
#[expect(dead_code, reason = "the examples use more of it")]
mod problem;

use std::sync::Arc;

use eddy_cuda::{
    frame::Place,
    training::{InTraining as _, Settings},
};
use eddy_cuda_emulator::Emulator;
use eddy_inference::checkpoint::{Core, Sizes};
use problem::Problem;

#[test]
fn windows_fetched_from_the_host_give_the_bits_of_those_on_the_device() {
    let sizes = Sizes { encoder: 6, hidden: 10, layers: 1, particles: Some(300) };
    let settings = Settings {
        unroll: 2,
        density_weight: 0.3,
        density_nodes: 9,
        noise: [0.01, 0.1],
        ..Settings::plain(3, 2)
    };
    let mut problem = Problem::new(Core::MinGru, sizes, true, settings);
    let mut run = |place: Place, groups: [usize; 3]| {
        problem.place = place;
        let emulator = Emulator::new(&problem.constants().unwrap()).unwrap();
        let mut training = problem.training(Arc::new(emulator)).unwrap();
        let batches = problem.batches(groups.iter().sum());
        let (mut left, mut losses) = (&batches[..], Vec::new());
        for steps in groups {
            let (now, later) = left.split_at(steps);
            left = later;
            training.start(now).unwrap();
            let outcomes = training.outcomes(steps).unwrap();
            losses.extend(outcomes.iter().map(|outcome| outcome.loss.to_bits()));
        }
        (losses, training.weights().unwrap())
    };
    let expected = run(Place::Device, [6, 0, 0]);
    assert!(expected.0.windows(2).all(|pair| pair[0] != pair[1]), "steps differ");
    // An odd number of steps at once, one step, and an even number.
    assert!(run(Place::Host, [3, 1, 2]) == expected);
}
