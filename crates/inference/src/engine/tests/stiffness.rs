//! Networks that are conditioned on the stiffness of a stream.

use super::*;
use crate::{
    checkpoint::{MATERIAL_INPUTS, tensors_of_knots},
    engine::{StepRequest, scales::stiffness_feature},
};

/// A particle model that is conditioned on the stiffness.
fn conditioned() -> Surrogate {
    let mut description = particle_model(Core::MinGru).description;
    description.stiffness = true;
    Surrogate::load(&checkpoint(description, 5), threads(1)).unwrap()
}

#[test]
fn a_network_conditioned_on_the_stiffness_predicts_by_it_up_to_the_limits_of_its_feature() {
    let (surrogate, frames) = (conditioned(), frames(3, 100, 3));
    let predict = |stiffness: f32| {
        let mut hidden = surrogate.start_with_stiffness(&frames[0], Some(stiffness)).unwrap();
        let mut copy = hidden.clone();
        let mut stepper = surrogate.stepper();
        let first = stepper.step(&mut hidden, &frames[0]);
        hidden.forget();
        assert_eq!(stepper.step(&mut hidden, &frames[0]), first, "a state that forgot its frames");
        assert_eq!(stepper.step(&mut copy, &frames[0]), first, "a copy");
        first
    };
    assert_ne!(predict(1e3), predict(1e5));
    assert_ne!(predict(100.0), predict(60.0));
    assert_eq!(predict(50.0), predict(1e-3));
    assert_eq!(predict(2e6), predict(1e9));
}

#[test]
fn streams_have_the_weights_of_their_stiffness() {
    let mut description = particle_model(Core::MinGru).description;
    description.stiffness = true;
    let parts = [5, 6].map(|seed| checkpoint(description.clone(), seed));
    description.stiffness_knots = vec![1e3, 1e5];
    let tensors = tensors_of_knots(&parts.clone().map(|part| part.tensors));
    let combined = Checkpoint::new(description, tensors);
    let surrogate = Surrogate::load(&combined, threads(2)).unwrap();
    assert_eq!(surrogate.digest(), combined.digest());
    let frames = frames(3, 200, 4);
    let stiffnesses = [1e3, 1e5, 2e4, 1e3];
    let run = |surrogate: &Surrogate, stiffnesses: &[f32]| {
        let start =
            |&stiffness| surrogate.start_with_stiffness(&frames[0], Some(stiffness)).unwrap();
        let mut states: Vec<_> = stiffnesses.iter().map(start).collect();
        let mut stepper = surrogate.stepper();
        let mut predicted = vec![frames[0].clone(); states.len()];
        for frame in &frames {
            let pairs = states.iter_mut().zip(&mut predicted);
            let mut steps: Vec<_> = pairs
                .map(|(hidden, next)| StepRequest { hidden, frame: frame.into(), next })
                .collect();
            stepper.step_all(&mut steps);
        }
        predicted
    };
    let together = run(&surrogate, &stiffnesses);
    for (stiffness, found) in stiffnesses.into_iter().zip(&together) {
        let alone = Surrogate::load(&combined.at_stiffness(stiffness), threads(1)).unwrap();
        assert_eq!(run(&alone, &[stiffness]), std::slice::from_ref(found), "{stiffness}");
    }
    assert_eq!(together[0], together[3]);
    assert_ne!(together[0], together[1]);
    let first = Surrogate::load(&parts[0], threads(1)).unwrap();
    assert_eq!(run(&first, &[1e3])[0], together[0], "at a knot, the weights of its checkpoint");
}

#[test]
fn a_network_that_ignores_another_feature_predicts_as_one_without_it() {
    let plain = particle_model(Core::MinGru);
    let features = particle_features(&plain.description);
    let frames = frames(3, 200, 4);
    let predict = |checkpoint: &Checkpoint| {
        predict(&Surrogate::load(checkpoint, threads(1)).unwrap(), &frames)
    };
    let others: [fn(&mut Description); 2] = [
        |description| description.stiffness = true,
        |description| {
            description.material_inputs = MATERIAL_INPUTS + 1;
            description.format_version = Description::version(MATERIAL_INPUTS + 1);
        },
    ];
    for change in others {
        let mut wider = plain.clone();
        change(&mut wider.description);
        for layer in ["encoder.0.weight", "context.weight"] {
            let Weights { shape, values } = wider.tensors.get_mut(layer).unwrap();
            let rows = values.chunks(shape[1]);
            let rows = rows.map(|row| [&row[..features], &[0.0], &row[features..]].concat());
            *values = rows.collect::<Vec<_>>().concat();
            shape[1] += 1;
        }
        assert_eq!(predict(&wider), predict(&plain));
    }
}

#[test]
fn the_feature_of_the_stiffness_is_a_logarithm() {
    assert_eq!(
        [1e4, 1e4 * 10f32.powf(1.5), 1.0, 1e9].map(stiffness_feature),
        [0.0, 1.0, -1.5, 1.5]
    );
    for (stiffness, about) in [(300.0, -1.0f32), (3e5, 1.0)] {
        assert!((stiffness_feature(stiffness) - about).abs() < 0.02);
    }
}

#[test]
fn a_stiffness_that_is_missing_invalid_or_not_used_is_rejected() {
    let frame = frames(1, 100, 3).remove(0);
    let rejection = |surrogate: &Surrogate, stiffness| {
        surrogate.start_with_stiffness(&frame, stiffness).err().unwrap().to_string()
    };
    let expected =
        "Young's modulus of the stream, a positive number: the checkpoint is conditioned on it"
            .to_owned();
    for (stiffness, found) in [
        (None, "nothing"),
        (Some(0.0), "0"),
        (Some(-3.0), "-3"),
        (Some(f32::INFINITY), "inf"),
        (Some(f32::NAN), "NaN"),
    ] {
        let message = rejection(&conditioned(), stiffness);
        assert_eq!(message, format!("stiffness: found {found}, expected {expected}"));
    }
    assert!(conditioned().start(&frame).is_err());
    let other = Surrogate::load(&particle_model(Core::MinGru), threads(1)).unwrap();
    let expected = "nothing: the checkpoint does not use it";
    let message = rejection(&other, Some(1e3));
    assert_eq!(message, format!("stiffness: found 1000, expected {expected}"));
}
