//! What holds of streams on a device, whatever the network.

use eddy_frames::Frame;
use eddy_inference::engine::{StepRequest, Surrogate};

use crate::streams::{predict, stiffness};

/// Every stream has the same bits beside the others, in a second run, and alone.
pub fn have_the_same_bits_alone_and_beside_others(surrogate: &Surrogate, streams: &[Vec<Frame>]) {
    let predict_all = || streams.iter().map(|frames| predict(surrogate, frames));
    let alone: Vec<_> = predict_all().collect();
    assert!(predict_all().eq(alone.iter().cloned()), "other bits in a second run");
    assert_ne!(alone[0], alone[1]);

    let mut stepper = surrogate.stepper();
    let begin = |frames: &Vec<Frame>| {
        let stiffness = stiffness(surrogate.description(), &frames[0]);
        surrogate.start_with_stiffness(&frames[0], stiffness).unwrap()
    };
    let mut hidden: Vec<_> = streams.iter().map(begin).collect();
    let mut predicted: Vec<Frame> = streams.iter().map(|frames| frames[0].clone()).collect();
    for number in 0..streams[0].len() {
        let pairs = hidden.iter_mut().zip(&mut predicted).zip(streams);
        let mut requests: Vec<_> = pairs
            .map(|((hidden, next), frames)| StepRequest {
                hidden,
                frame: (&frames[number]).into(),
                next,
            })
            .collect();
        stepper.step_all(&mut requests);
        let expected = alone.iter().map(|frames| &frames[number]);
        assert!(predicted.iter().eq(expected), "frame {number}");
    }
    stepper.check().unwrap();

    // Threads that step streams of their own, which the device takes together.
    let predict_own = |frames: &Vec<Frame>| predict(surrogate, frames);
    let found: Vec<_> = std::thread::scope(|scope| {
        let threads: Vec<_> =
            streams.iter().map(|frames| scope.spawn(move || predict_own(frames))).collect();
        threads.into_iter().map(|thread| thread.join().unwrap()).collect()
    });
    assert!(found == alone, "other bits beside steps of other threads");
}

/// A copied state evolves independently of the original; a cleared state predicts as at the start.
pub fn are_copied_and_forgotten(surrogate: &Surrogate, frames: &[Frame]) {
    let (mut stepper, mut hidden) = (surrogate.stepper(), surrogate.start(&frames[0]).unwrap());
    let first = stepper.step(&mut hidden, &frames[0]);
    let mut ahead = hidden.clone();
    assert_eq!(ahead, hidden);
    let second = stepper.step(&mut ahead, &frames[1]);
    assert_ne!(ahead, hidden, "the copy has moved on");
    assert_eq!(stepper.step(&mut hidden, &frames[1]), second);

    stepper.step(&mut hidden, &frames[2]);
    assert_ne!(ahead, hidden);
    ahead.clone_from(&hidden);
    assert_eq!(stepper.step(&mut ahead, &frames[3]), stepper.step(&mut hidden, &frames[3]));

    hidden.forget();
    assert_eq!(stepper.step(&mut hidden, &frames[0]), first);
    stepper.check().unwrap();
}
