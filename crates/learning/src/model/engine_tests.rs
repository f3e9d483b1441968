//! The networks in burn beside the engine, which predicts the same, rules included, within 1e-5.

use std::num::NonZeroUsize;

use proptest::{prelude::*, sample::select, test_runner::RngSeed};
use pulp::Arch;
use rand::SeedableRng as _;
use rand_chacha::ChaCha8Rng;

use super::{DeviceKind, Reference};
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::{
    checkpoint::{
        Activation, Architecture, Checkpoint, Core, Description, FeatureScaling, Form,
        FrameOptions, MaterialInput, Normalization, Pooling, Rule, Rules, Sizes, Surroundings,
        initial_weights,
    },
    engine::{Surrogate, scales::velocity_unit},
};

const DT: f32 = 0.016;

/// How far predictions may be apart (domain lengths; domain lengths per second).
const NEAR: f32 = 1e-5;

fn description(architecture: Architecture, core: Core, sizes: Sizes) -> Description {
    Description {
        normalization: Normalization {
            minimum: [0.05, 0.05, -3.0, -4.0],
            maximum: [0.95, 0.95, 3.0, 3.0],
            mean: [0.5, 0.3, 0.1, -0.5],
            standard_deviation: [0.2, 0.2, 0.7, 0.9],
        },
        surroundings: (architecture == Architecture::Particle).then_some(Surroundings {
            cell_width: 1.0 / 32.0,
            channels: [16, 24, 20],
            spacing: 0.02,
        }),
        ..Description::untrained(architecture, core, sizes)
    }
}

/// Random weights, biases and decoder included.
fn checkpoint(description: Description, seed: u64) -> Checkpoint {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut tensors = initial_weights(&description, seed);
    for (name, weights) in &mut tensors {
        if name.starts_with("decoder") || weights.shape.len() == 1 {
            for value in &mut weights.values {
                *value += random.random_range(-0.3..0.3);
            }
        }
    }
    Checkpoint { description, tensors }
}

/// Particles that jump about, on and beyond the walls too: no network can tell them from truth.
fn frames(count: u64, particles: usize, seed: u64) -> Vec<Frame> {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let material: Vec<_> =
        (0..particles).map(|_| Material::ALL[random.random_range(0..4)]).collect();
    let mut pairs = |low: f32, high: f32| {
        (0..particles).map(|_| [(); 2].map(|()| random.random_range(low..high))).collect()
    };
    (0..count)
        .map(|sequence| Frame {
            stream: 4,
            sequence,
            stamp: Stamp(0).advance(DT, sequence as u32),
            dt: DT,
            domain: Domain::UNIT,
            position: pairs(0.0, 1.0),
            velocity: pairs(-2.0, 2.0),
            material: material.clone(),
        })
        .collect()
}

fn largest_difference(a: &[[f32; 2]], b: &[[f32; 2]]) -> f32 {
    assert_eq!(a.len(), b.len());
    let pairs = a.as_flattened().iter().zip(b.as_flattened());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

/// Whether two predictions are the same within [`NEAR`]. A rule changes a velocity by a shift of the position divided by the
/// frame interval, and so by the rounding of positions: behind rules [`NEAR`] is of velocities in domain lengths a frame.
fn check(found: &Frame, expected: &Frame, rules: &Rules) -> Result<(), String> {
    let position = largest_difference(&found.position, &expected.position);
    let velocity = largest_difference(&found.velocity, &expected.velocity);
    let limit = if rules.is_empty() { NEAR } else { NEAR / DT };
    match position <= NEAR && velocity <= limit {
        true => Ok(()),
        false => Err(format!("positions {position} apart, velocities {velocity}")),
    }
}

fn threads(number: usize) -> Option<NonZeroUsize> {
    NonZeroUsize::new(number)
}

/// Sets of instructions of this processor, the plainest first.
fn sets() -> Vec<Arch> {
    let mut sets = vec![Arch::Scalar];
    #[cfg(target_arch = "x86_64")]
    {
        sets.extend(pulp::x86::V3::try_new().map(Arch::V3));
        sets.extend(pulp::x86::V4::try_new().map(Arch::V4));
    }
    #[cfg(not(target_arch = "x86_64"))]
    sets.push(Arch::new());
    sets
}

/// Predictions from one frame after the other.
fn stream(surrogate: &Surrogate, frames: &[Frame]) -> Vec<Frame> {
    let mut memory = surrogate.start(&frames[0]).unwrap();
    frames.iter().map(|frame| surrogate.step(&mut memory, frame)).collect()
}

/// Everything a frame model can be.
fn frame_options() -> impl Strategy<Value = FrameOptions> {
    (
        select(&[Pooling::Mean, Pooling::Max, Pooling::MeanMax][..]),
        select(&Activation::ALL[..]),
        select(&[MaterialInput::OneHot, MaterialInput::Scalar][..]),
        select(&[FeatureScaling::MinMax, FeatureScaling::ZScore][..]),
    )
        .prop_map(|(pooling, activation, material, scaling)| FrameOptions {
            pooling,
            activation,
            material,
            scaling,
        })
}

/// Cells from small to so large that a few hold all.
fn surroundings() -> impl Strategy<Value = Surroundings> {
    ((0.03f32..0.5), [1usize..40, 1usize..40, 1usize..40], 0.01f32..0.2)
        .prop_map(|(cell_width, channels, spacing)| Surroundings { cell_width, channels, spacing })
}

/// Each rule on or off.
fn rules() -> impl Strategy<Value = Rules> {
    any::<[bool; 4]>().prop_map(|on| {
        let mut rules = Rules::STANDARD;
        for (rule, _) in Rule::ALL.into_iter().zip(on).filter(|(_, on)| !on) {
            rules.remove(rule);
        }
        rules
    })
}

/// Everything a checkpoint can describe, with the number of particles to predict.
fn descriptions() -> impl Strategy<Value = (Description, usize)> {
    let sizes = (1usize..50, 1usize..50, 1usize..4, 1usize..120);
    let choices =
        (select(&Core::ALL[..]), any::<[bool; 2]>(), frame_options(), surroundings(), rules());
    (any::<bool>(), choices, sizes).prop_map(
        |(whole, choices, (encoder, hidden, layers, particles))| {
            let (core, [log, normalize_gates], frame, surroundings, rules) = choices;
            let architecture = if whole { Architecture::Frame } else { Architecture::Particle };
            let sizes = Sizes { encoder, hidden, layers, particles: whole.then_some(particles) };
            let description = Description {
                form: if log { Form::Log } else { Form::Plain },
                normalize_gates,
                frame: if whole { frame } else { FrameOptions::default() },
                surroundings: (!whole).then_some(surroundings),
                rules: if whole { Rules::default() } else { rules },
                ..description(architecture, core, sizes)
            };
            (description, particles)
        },
    )
}

proptest! {
    // Always the same cases: a node whose fill is a rounding away from the surface is on this side of it for one and on that
    // side for the other, and pressures differ.
    #![proptest_config(ProptestConfig {
        cases: 400,
        rng_seed: RngSeed::Fixed(1),
        ..ProptestConfig::default()
    })]
    #[test]
    fn every_network_predicts_what_the_one_in_burn_predicts(
        (description, particles) in descriptions(),
        seed in any::<u64>(),
    ) {
        let checkpoint = checkpoint(description, seed);
        let frames = frames(5, particles, seed);
        let reference = Reference::load(&checkpoint, DeviceKind::Flex).unwrap();
        let mut memory = reference.start(&frames[0]);
        let expected: Vec<_> = frames.iter().map(|frame| reference.step(&mut memory, frame)).collect();
        for set in sets() {
            let surrogate = Surrogate::load_for(&checkpoint, threads(1), set).unwrap();
            for (found, expected) in stream(&surrogate, &frames).iter().zip(&expected) {
                let same = check(found, expected, &checkpoint.description.rules);
                prop_assert!(same.is_ok(), "{set:?}: {same:?}");
                prop_assert_eq!(
                    (found.sequence, found.stamp, &found.material),
                    (expected.sequence, expected.stamp, &expected.material)
                );
            }
        }
    }
}

/// A scene for each rule: liquid pressed together, jelly out of shape in mid-air, and snow at rest on the floor.
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

/// A particle model that holds nearly everything against gravity, and says little else.
fn holding(rules: Rules) -> Checkpoint {
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

#[test]
fn every_rule_changes_a_scene_made_for_it_as_it_does_behind_the_network_in_burn() {
    let frames = scene(3);
    let predict = |rules| stream(&Surrogate::load(&holding(rules), threads(2)).unwrap(), &frames);
    let corrected = predict(Rules::STANDARD);
    for rule in Rule::ALL {
        let mut rules = Rules::STANDARD;
        rules.remove(rule);
        let without = predict(rules);
        let difference = largest_difference(&corrected[0].position, &without[0].position);
        assert!(difference > 1e-4, "{rule}: {difference}");
    }
    let reference = Reference::load(&holding(Rules::STANDARD), DeviceKind::Flex).unwrap();
    let mut memory = reference.start(&frames[0]);
    for (frame, found) in frames.iter().zip(&corrected) {
        let expected = reference.step(&mut memory, frame);
        check(found, &expected, &Rules::STANDARD).unwrap();
    }
}
