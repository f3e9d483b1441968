//! Networks and streams for tests of the engine. `eddy-learning` includes this file to compare the engine with the networks
//! in burn: names come from the module that includes it.

use std::num::NonZeroUsize;

use pulp::Arch;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    Architecture, Checkpoint, Core, Description, Domain, ElasticRule, Frame, GridOptions, Material,
    Normalization, RestRule, Rules, Sizes, Stamp, Surrogate, initial_weights, velocity_unit,
};

pub(super) const DT: f32 = 0.016;

pub(super) fn description(architecture: Architecture, core: Core, sizes: Sizes) -> Description {
    Description {
        normalization: Normalization {
            minimum: [0.05, 0.05, -3.0, -4.0],
            maximum: [0.95, 0.95, 3.0, 3.0],
            mean: [0.5, 0.3, 0.1, -0.5],
            standard_deviation: [0.2, 0.2, 0.7, 0.9],
        },
        grid: (architecture == Architecture::Particle).then_some(GridOptions {
            cell_width: 1.0 / 32.0,
            channels: vec![16, 24, 20],
            spacing: 0.02,
        }),
        ..Description::untrained(architecture, core, sizes)
    }
}

/// Random weights, including biases and the decoder.
pub(super) fn checkpoint(description: Description, seed: u64) -> Checkpoint {
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let mut tensors = initial_weights(&description, seed);
    for (name, weights) in &mut tensors {
        if name.starts_with("decoder") || weights.shape.len() == 1 {
            for value in &mut weights.values {
                *value += random.random_range(-0.3..0.3);
            }
        }
    }
    Checkpoint::new(description, tensors)
}

/// Particles at random places in every frame, some at walls and beyond.
pub(super) fn frames(count: u64, particles: usize, seed: u64) -> Vec<Frame> {
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

/// The described particle model with the rule `elastic`.
pub(super) fn elastic(description: &Description) -> Description {
    let spacing = description.grid.as_ref().unwrap().spacing;
    let elastic = match description.stiffness {
        true => ElasticRule::default(),
        false => ElasticRule::new(300.0, spacing, DT),
    };
    let rules = Rules { elastic: Some(elastic), ..description.rules };
    Description { rules, ..description.clone() }
}

/// Particles of each of its bodies.
pub(super) const JELLY: usize = 14 * 9;

/// Four bodies of 14 x 9 particles: jelly that falls to the floor; jelly that touches it, turns, and is stretched more and more; liquid; and
/// jelly that lies on it.
pub(super) fn jelly(count: u32) -> Vec<Frame> {
    const SPACING: f32 = 0.02;
    let block = |corner: [f32; 2]| {
        (0..JELLY).map(move |k| {
            let at = [(k % 14) as f32, (k / 14) as f32];
            [0, 1].map(|axis| corner[axis] + SPACING * at[axis])
        })
    };
    let rest: Vec<_> =
        [[0.06, 0.1], [0.56, 0.12], [0.1, 0.5], [0.1, 0.69]].into_iter().flat_map(block).collect();
    let kinds = [Material::Jelly, Material::Jelly, Material::Liquid, Material::Jelly];
    let frame = |time: u32| {
        let (sin, cos) = (0.2 * time as f32).sin_cos();
        let stretch = 1.0 + 0.03 * time as f32;
        let turned = |[x, y]: [f32; 2]| {
            let [x, y] = [stretch * (x - 0.69), y - 0.2];
            [0.69 + cos * x - sin * y, 0.2 + sin * x + cos * y]
        };
        let place = |(row, &x): (usize, &[f32; 2])| match row / JELLY {
            0 => [x[0], x[1] - 0.01 * time as f32],
            1 => turned(x),
            _ => x,
        };
        Frame {
            stream: 4,
            sequence: time.into(),
            stamp: Stamp(0).advance(DT, time),
            dt: DT,
            domain: Domain::UNIT,
            position: rest.iter().enumerate().map(place).collect(),
            velocity: rest.iter().map(|[x, y]| [0.5 * y, -1.5 - x]).collect(),
            material: kinds.iter().flat_map(|&kind| [kind; JELLY]).collect(),
        }
    };
    (0..count).map(frame).collect()
}

pub(super) fn largest_difference(a: &[[f32; 2]], b: &[[f32; 2]]) -> f32 {
    assert_eq!(a.len(), b.len());
    let pairs = a.as_flattened().iter().zip(b.as_flattened());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
}

pub(super) fn threads(number: usize) -> Option<NonZeroUsize> {
    NonZeroUsize::new(number)
}

/// The instruction sets of this processor, the scalar one first.
pub(super) fn instruction_sets() -> Vec<Arch> {
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

/// The stiffness of a stream that begins with a frame, if the network is conditioned on it.
pub(super) fn stiffness(description: &Description, first: &Frame) -> Option<f32> {
    description.stiffness.then(|| 300.0 * first.len() as f32)
}

/// The prediction after each frame of a stream.
pub(super) fn predict(surrogate: &Surrogate, frames: &[Frame]) -> Vec<Frame> {
    predict_each(surrogate, frames, false)
}

/// The predictions of each frame as if the stream was interrupted before it.
pub(super) fn predict_alone(surrogate: &Surrogate, frames: &[Frame]) -> Vec<Frame> {
    predict_each(surrogate, frames, true)
}

fn predict_each(surrogate: &Surrogate, frames: &[Frame], forgets: bool) -> Vec<Frame> {
    let stiffness = stiffness(surrogate.description(), &frames[0]);
    let mut hidden = surrogate.start_with_stiffness(&frames[0], stiffness).unwrap();
    let mut stepper = surrogate.stepper();
    let step = |frame: &Frame| {
        if forgets {
            hidden.forget();
        }
        stepper.step(&mut hidden, frame)
    };
    frames.iter().map(step).collect()
}

/// Jelly that moves as a surrogate with the rule `elastic` predicts, until the first body, of [`JELLY`] particles, is pushed in the last of three
/// frames.
pub(super) fn pushed_jelly(surrogate: &Surrogate) -> Vec<Frame> {
    let mut frames = jelly(1);
    for _ in 0..2 {
        frames.extend(predict(surrogate, &frames).pop());
    }
    frames[2].position[..JELLY].iter_mut().for_each(|[x, _]| *x += 0.01);
    frames
}

/// A scene for each rule: compressed liquid, deformed jelly in mid-air, and snow at rest on the floor.
pub(super) fn scene(count: u64) -> Vec<Frame> {
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
pub(super) fn hovering(rules: Rules) -> Checkpoint {
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
pub(super) const RULES: Rules = Rules {
    rest: Some(RestRule { wall_distance: 1.5, asleep_below: 0.25, awake_from: 1.0 }),
    ..Rules::STANDARD
};
