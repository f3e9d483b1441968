//! The engine's predictions, including rules, equal those of the networks in burn within 1e-5.

#[path = "../../../inference/src/engine/test_streams.rs"]
mod streams;

use proptest::{prelude::*, sample::select, test_runner::RngSeed};
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::{DeviceKind, Reference};
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::{
    checkpoint::{
        Activation, Architecture, Checkpoint, Core, Description, ElasticRule, FeatureScaling, Form,
        FrameOptions, FrameOutput, GridOptions, MaterialInput, Normalization, Pooling, RestRule,
        Rule, Rules, Sizes, initial_weights,
    },
    engine::{Surrogate, scales::velocity_unit},
};
use streams::{
    DT, checkpoint, description, elastic, frames, instruction_sets, jelly, largest_difference,
    predict, predict_alone, pushed_jelly, stiffness, threads,
};

/// Largest difference of predictions (domain lengths; domain lengths per second).
const TOLERANCE: f32 = 1e-5;

/// Compares two predictions. A rule changes a velocity by a shift of the position divided by the frame interval, and so by the
/// rounding of positions, as does an output of positions: there, [`TOLERANCE`] of velocities is in domain lengths per frame.
fn check(found: &Frame, expected: &Frame, description: &Description) -> Result<(), String> {
    let position = largest_difference(&found.position, &expected.position);
    let velocity = largest_difference(&found.velocity, &expected.velocity);
    let of_positions = description.frame.output == FrameOutput::Position;
    let limit =
        if description.rules.is_empty() && !of_positions { TOLERANCE } else { TOLERANCE / DT };
    match position <= TOLERANCE && velocity <= limit {
        true => Ok(()),
        false => Err(format!("positions {position} apart, velocities {velocity}")),
    }
}

/// All options of a frame model.
fn frame_options() -> impl Strategy<Value = FrameOptions> {
    (
        select(&[Pooling::Mean, Pooling::Max, Pooling::MeanMax][..]),
        select(&Activation::ALL[..]),
        select(&[MaterialInput::OneHot, MaterialInput::Scalar][..]),
        select(&[FeatureScaling::MinMax, FeatureScaling::ZScore][..]),
        select(&FrameOutput::ALL[..]),
    )
        .prop_map(|(pooling, activation, material, scaling, output)| FrameOptions {
            pooling,
            activation,
            material,
            scaling,
            output,
        })
}

/// Cells from small to so large that a few contain all particles.
fn grid() -> impl Strategy<Value = GridOptions> {
    let channels = proptest::collection::vec(1usize..40, GridOptions::LEVELS);
    ((0.03f32..0.5), channels, 0.01f32..0.2)
        .prop_map(|(cell_width, channels, spacing)| GridOptions { cell_width, channels, spacing })
}

/// Each rule on or off.
fn rules() -> impl Strategy<Value = Rules> {
    any::<[bool; 4]>().prop_map(|on| {
        let mut rules = Rules::STANDARD;
        // All but `elastic`, which needs whole bodies.
        for (rule, _) in Rule::ALL.into_iter().skip(1).zip(on).filter(|(_, on)| !on) {
            rules.remove(rule);
        }
        rules
    })
}

/// Descriptions of all kinds, with the number of particles to predict.
fn descriptions() -> impl Strategy<Value = (Description, usize)> {
    let sizes = (1usize..50, 1usize..50, 1usize..4, 1usize..120);
    let choices = (select(&Core::ALL[..]), any::<[bool; 3]>(), frame_options(), grid(), rules());
    (any::<bool>(), choices, sizes).prop_map(
        |(whole, choices, (encoder, hidden, layers, particles))| {
            let (core, [log, normalize_gates, stiffness], frame, grid, rules) = choices;
            let architecture = if whole { Architecture::Frame } else { Architecture::Particle };
            let sizes = Sizes { encoder, hidden, layers, particles: whole.then_some(particles) };
            let description = Description {
                form: if log { Form::Log } else { Form::Plain },
                normalize_gates,
                stiffness: stiffness && !whole,
                frame: if whole { frame } else { FrameOptions::default() },
                grid: (!whole).then_some(grid),
                rules: if whole { Rules::default() } else { rules },
                ..description(architecture, core, sizes)
            };
            (description, particles)
        },
    )
}

proptest! {
    // Always the same cases: where the fill of a node is a rounding error away from the limit of the surface, the two may
    // decide differently, and pressures differ.
    #![proptest_config(ProptestConfig {
        cases: 400,
        rng_seed: RngSeed::Fixed(1),
        ..ProptestConfig::default()
    })]
    #[test]
    fn every_network_predicts_the_same_as_in_burn(
        (description, particles) in descriptions(),
        seed in any::<u64>(),
    ) {
        let checkpoint = checkpoint(description, seed);
        let frames = frames(5, particles, seed);
        let reference = Reference::load(&checkpoint, DeviceKind::Flex).unwrap();
        let mut memory = reference.start(&frames[0], stiffness(&checkpoint.description, &frames[0]));
        let expected: Vec<_> = frames.iter().map(|frame| reference.step(&mut memory, frame)).collect();
        for set in instruction_sets() {
            let surrogate = Surrogate::load_for(&checkpoint, threads(1), set).unwrap();
            for (found, expected) in predict(&surrogate, &frames).iter().zip(&expected) {
                let same = check(found, expected, &checkpoint.description);
                prop_assert!(same.is_ok(), "{set:?}: {same:?}");
                prop_assert_eq!(
                    (found.sequence, found.stamp, &found.material),
                    (expected.sequence, expected.stamp, &expected.material)
                );
            }
        }
    }
}

/// A scene for each rule: compressed liquid, deformed jelly in mid-air, and snow at rest on the floor.
fn scene(count: u64) -> Vec<Frame> {
    const SPACING: f32 = 0.02;
    let mut random = ChaCha8Rng::seed_from_u64(3);
    let block = |material, corner: [f32; 2], columns: usize, apart: f32| {
        let at = move |k: usize| [(k % columns) as f32, (k / columns) as f32];
        (0..6 * columns).map(move |k| {
            (material, [0, 1].map(|axis| corner[axis] + apart * SPACING * at(k)[axis]))
        })
    };
    let rest: Vec<_> = block(Material::Liquid, [0.6, 0.05], 14, 0.8)
        .chain(block(Material::Jelly, [0.4, 0.6], 9, 1.0))
        .chain(block(Material::Snow, [0.06, 0.05], 8, 1.0))
        .collect();
    let mut near = |value: f32, most: f32| value + random.random_range(-most..most);
    let first = frames(1, rest.len(), 3).remove(0);
    let frame = |sequence| Frame {
        sequence,
        stamp: Stamp(0).advance(DT, sequence as u32),
        material: rest.iter().map(|(material, _)| *material).collect(),
        position: rest
            .iter()
            .map(|(material, x)| match material {
                Material::Jelly => x.map(|x| near(x, 0.2 * SPACING)),
                _ => *x,
            })
            .collect(),
        velocity: rest
            .iter()
            .map(|(material, _)| match material {
                Material::Jelly => [near(0.3, 0.2), near(-1.0, 0.2)],
                _ => [near(0.0, 0.001), near(0.0, 0.001)],
            })
            .collect(),
        ..first.clone()
    };
    (0..count).map(frame).collect()
}

/// A particle model whose prediction nearly cancels gravity and changes little else.
fn hovering(rules: Rules) -> Checkpoint {
    let sizes = Sizes { encoder: 20, hidden: 18, layers: 1, particles: None };
    let description = description(Architecture::Particle, Core::MinGru, sizes);
    let up = 9.8 * DT / velocity_unit(&description.normalization);
    let mut checkpoint = checkpoint(Description { rules, ..description }, 8);
    let decoder = |name: &str| format!("decoder.{name}");
    let weight = checkpoint.tensors.get_mut(&decoder("weight")).unwrap();
    weight.values.iter_mut().for_each(|value| *value *= 1e-3);
    checkpoint.tensors.get_mut(&decoder("bias")).unwrap().values =
        vec![0.0, 0.9 * up, 0.0, 0.45 * up];
    checkpoint
}

/// The standard rules, with a rule `rest` that acts at the speeds of [`hovering`].
const RULES: Rules = Rules {
    rest: Some(RestRule { wall_distance: 1.5, asleep_below: 0.25, awake_from: 1.0 }),
    ..Rules::STANDARD
};

#[test]
fn every_rule_changes_a_scene_made_for_it_as_it_does_in_burn() {
    let frames = scene(3);
    let with = |rules| predict(&Surrogate::load(&hovering(rules), threads(2)).unwrap(), &frames);
    let corrected = with(RULES);
    for rule in Rule::ALL.into_iter().filter(|rule| RULES.has(*rule)) {
        let mut rules = RULES;
        rules.remove(rule);
        let without = with(rules);
        let difference = largest_difference(&corrected[0].position, &without[0].position);
        assert!(difference > 1e-4, "{rule}: {difference}");
    }
    let reference = Reference::load(&hovering(RULES), DeviceKind::Flex).unwrap();
    let mut memory = reference.start(&frames[0], None);
    for (frame, found) in frames.iter().zip(&corrected) {
        let expected = reference.step(&mut memory, frame);
        check(found, &expected, &hovering(RULES).description).unwrap();
    }
}

#[test]
fn jelly_moves_by_its_elasticity_after_any_predictor() {
    for rules in [Rules::default(), Rules::STANDARD] {
        jelly_moves_by_its_elasticity_with(rules);
    }
}

fn jelly_moves_by_its_elasticity_with(rules: Rules) {
    let plain = hovering(rules);
    let checkpoint = Checkpoint { description: elastic(&plain.description), ..plain.clone() };
    let frames = jelly(4);
    let reference = Reference::load(&checkpoint, DeviceKind::Flex).unwrap();
    let start = || reference.start(&frames[0], None);
    let expected: Vec<_> = frames.iter().map(|frame| reference.step(&mut start(), frame)).collect();
    let without = predict_alone(&Surrogate::load(&plain, threads(1)).unwrap(), &frames);
    let pushed = pushed_jelly(&Surrogate::load(&checkpoint, threads(1)).unwrap());
    let mut memory = start();
    let in_stream: Vec<_> = pushed.iter().map(|frame| reference.step(&mut memory, frame)).collect();
    for set in instruction_sets() {
        let surrogate = Surrogate::load_for(&checkpoint, threads(2), set).unwrap();
        let found = [predict_alone(&surrogate, &frames), predict(&surrogate, &pushed)].concat();
        for (found, expected) in found.iter().zip(expected.iter().chain(&in_stream)) {
            check(found, expected, &checkpoint.description).unwrap();
        }
    }
    // The third body is liquid, the last one lies on it.
    for (body, moves) in [(0, true), (1, true), (2, false), (3, false)] {
        let rows = 126 * body..126 * (body + 1);
        let of = |frame: &Frame| frame.velocity[rows.clone()].to_vec();
        let difference = largest_difference(&of(&expected[3]), &of(&without[3]));
        assert!(
            if moves { difference > 0.3 } else { difference < 1e-5 },
            "body {body}: {difference}"
        );
    }
}
