//! Weights for several stiffnesses.

use super::*;

/// A checkpoint with weights for several stiffnesses, those of each moved by so much.
fn with_knots(knots: &[(f32, f32)]) -> Checkpoint {
    let mut description = Description { stiffness: true, ..checkpoint().description };
    let shapes = tensor_shapes(&description);
    let of_knot = |&(_, moved): &(f32, f32)| {
        let tensors = shapes.clone().into_iter().map(|(name, shape)| {
            let values = (0..shape.iter().product()).map(|place| place as f32 + moved).collect();
            (name, Weights { shape, values })
        });
        tensors.collect::<BTreeMap<_, _>>()
    };
    let tensors: Vec<_> = knots.iter().map(of_knot).collect();
    description.stiffness_knots = knots.iter().map(|&(stiffness, _)| stiffness).collect();
    Checkpoint::new(description, tensors_of_knots(&tensors))
}

#[test]
fn weights_for_several_stiffnesses_are_interpolated_in_its_logarithm() {
    let all = with_knots(&[(1e2, 0.0), (1e4, 1.0), (1e5, 5.0)]);
    for (stiffness, moved) in [
        (1.0, 0.0),
        (1e2, 0.0),
        (1e3, 0.5),
        (1e4, 1.0),
        (10f32.powf(4.75), 4.0),
        (1e5, 5.0),
        (1e9, 5.0),
    ] {
        let found = all.at_stiffness(stiffness);
        found.check(Path::new("found")).unwrap();
        for (name, Weights { values, .. }) in &found.tensors {
            for (place, value) in values.iter().enumerate() {
                let expected = place as f32 + moved;
                assert!(
                    (value - expected).abs() < 1e-4,
                    "{stiffness}: {name}: {value}, {expected}"
                );
            }
        }
    }
    assert_eq!(all.at_stiffness(1e4).tensors, tensors_of_knot(&all.tensors, 1));
    let folder = tempfile::tempdir().unwrap();
    all.save(folder.path()).unwrap();
    assert_eq!(Checkpoint::load(folder.path()).unwrap(), all);
    let single = checkpoint();
    assert_eq!(single.at_stiffness(1e3), single);
}

#[test]
fn stiffnesses_with_weights_ascend_and_need_a_network_that_is_conditioned_on_them() {
    type Change = fn(&mut Description);
    let cases: [(Change, &str); 4] = [
        (|description| description.stiffness_knots.reverse(), "[10000.0, 100.0]"),
        (|description| description.stiffness_knots[0] = f32::NAN, "[NaN, 10000.0]"),
        (|description| description.stiffness_knots.truncate(1), "[100.0]"),
        (|description| description.stiffness = false, "[100.0, 10000.0]"),
    ];
    for (change, found) in cases {
        let mut all = with_knots(&[(1e2, 0.0), (1e4, 1.0)]);
        change(&mut all.description);
        let error = all.check(Path::new("a")).unwrap_err().to_string();
        let expected = format!("stiffness_knots: found {found}, expected {VALID_KNOTS}");
        assert!(error.ends_with(&expected), "{error}");
    }
    let mut all = with_knots(&[(1e2, 0.0), (1e4, 1.0)]);
    all.description.stiffness_knots.push(1e5);
    let error = all.check(Path::new("a")).unwrap_err().to_string();
    assert!(error.contains("found shape [2, ") && error.contains("expected [3, "), "{error}");
}
