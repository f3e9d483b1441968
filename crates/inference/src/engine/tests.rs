//! The engine beside itself; `model` has the tests beside the networks in burn.

use std::num::NonZeroUsize;

use pulp::Arch;
use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{Corrector, Memory, Surrogate, scales::velocity_unit};
use crate::{
    checkpoint::{
        Architecture, Checkpoint, Core, Description, FrameOptions, Normalization, Pooling, Rules,
        Sizes, Surroundings, initial_weights,
    },
    kernels::rest::Rest,
};
use eddy_frames::{Domain, Frame, Material, Stamp};

const DT: f32 = 0.016;

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

/// A block of jelly that falls and a heap of snow that hardly moves, each of more particles than one thread takes
/// at a time.
fn bodies(count: u64, seed: u64) -> Vec<Frame> {
    const SPACING: f32 = 0.01;
    let mut random = ChaCha8Rng::seed_from_u64(seed);
    let block = |corner: [f32; 2]| {
        let at = move |k: usize| [(k % 40) as f32, (k / 40) as f32];
        (0..40 * 20).map(move |k| [0, 1].map(|axis| corner[axis] + SPACING * at(k)[axis]))
    };
    let rest: Vec<_> = block([0.3, 0.5]).chain(block([0.3, 0.03])).collect();
    let material: Vec<_> = (0..rest.len())
        .map(|k| if k < rest.len() / 2 { Material::Jelly } else { Material::Snow })
        .collect();
    let mut near = |value: f32, most: f32| value + random.random_range(-most..most);
    frames(count, rest.len(), seed)
        .into_iter()
        .map(|frame| Frame {
            position: rest.iter().map(|x| x.map(|x| near(x, 0.1 * SPACING))).collect(),
            velocity: material
                .iter()
                .map(|material| match material {
                    Material::Jelly => [near(0.0, 0.2), near(-1.0, 0.2)],
                    _ => [near(0.0, 0.001), near(0.0, 0.001)],
                })
                .collect(),
            material: material.clone(),
            ..frame
        })
        .collect()
}

fn largest_difference(a: &[[f32; 2]], b: &[[f32; 2]]) -> f32 {
    assert_eq!(a.len(), b.len());
    let pairs = a.as_flattened().iter().zip(b.as_flattened());
    pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
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

/// One network of each kind, wide enough for all threads to work on it.
fn wide(core: Core) -> Vec<(Checkpoint, Vec<Frame>)> {
    let frame_sizes = Sizes { encoder: 70, hidden: 210, layers: 2, particles: Some(301) };
    let frame = description(Architecture::Frame, core, frame_sizes);
    let options = FrameOptions { pooling: Pooling::MeanMax, ..FrameOptions::default() };
    let both = Description { frame: options, ..frame.clone() };
    let sizes = Sizes { encoder: 40, hidden: 50, layers: 2, particles: None };
    let particle = description(Architecture::Particle, core, sizes);
    let make = |description| (checkpoint(description, 5), frames(4, 301, 6));
    // It says little, so that bodies come to rest.
    let mut quiet = checkpoint(particle.clone(), 5);
    let decoder = quiet.tensors.iter_mut().filter(|(name, _)| name.starts_with("decoder"));
    decoder.flat_map(|(_, weights)| &mut weights.values).for_each(|value| *value *= 1e-3);
    let networks = [frame, both, particle].map(make).into_iter();
    networks.chain([(quiet, bodies(4, 6))]).collect()
}

#[test]
fn any_number_of_threads_gives_the_same_bits() {
    for core in Core::ALL {
        for (checkpoint, frames) in wide(core) {
            let expected = stream(&Surrogate::load(&checkpoint, threads(1)).unwrap(), &frames);
            for number in [2, 3, 8] {
                let surrogate = Surrogate::load(&checkpoint, threads(number)).unwrap();
                assert_eq!(stream(&surrogate, &frames), expected, "{core:?}, {number} threads");
            }
        }
    }
}

#[test]
fn sets_of_instructions_with_a_fused_multiply_add_give_the_same_bits() {
    for core in Core::ALL {
        for (checkpoint, frames) in wide(core) {
            let sets = sets();
            let all = sets[1..].iter().map(|&set| {
                stream(&Surrogate::load_for(&checkpoint, threads(2), set).unwrap(), &frames)
            });
            let all: Vec<_> = all.collect();
            assert!(all.windows(2).all(|pair| pair[0] == pair[1]), "{core:?}");
        }
    }
}

#[test]
fn a_stream_among_others_is_predicted_as_if_it_were_alone() {
    for (checkpoint, first) in wide(Core::Lstm) {
        let surrogate = Surrogate::load(&checkpoint, threads(2)).unwrap();
        let second = frames(4, 301, 7);
        let alone = [stream(&surrogate, &first), stream(&surrogate, &second)];
        let mut memories = [&first, &second].map(|frames| surrogate.start(&frames[0]).unwrap());
        for number in 0..4 {
            for (which, frames) in [&first, &second].into_iter().enumerate() {
                let found = surrogate.step(&mut memories[which], &frames[number]);
                assert_eq!(found, alone[which][number]);
            }
        }
        // From several threads at once as well.
        std::thread::scope(|scope| {
            for (frames, expected) in [&first, &second].into_iter().zip(&alone) {
                let surrogate = &surrogate;
                scope.spawn(move || assert_eq!(&stream(surrogate, frames), expected));
            }
        });
    }
}

#[test]
fn a_copied_memory_goes_on_from_where_it_was_copied() {
    for (checkpoint, frames) in wide(Core::Gru) {
        let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
        let mut memory = surrogate.start(&frames[0]).unwrap();
        surrogate.step(&mut memory, &frames[0]);
        let mut copy = Memory::clone(&memory);
        let expected = surrogate.step(&mut copy, &frames[1]);
        assert_ne!(copy, memory, "a step leaves no trace");
        copy.clone_from(&memory);
        assert_eq!(surrogate.step(&mut copy, &frames[1]), expected);
    }
}

#[test]
fn a_memory_that_forgot_its_frames_still_knows_the_shape_at_rest() {
    let surrogate = Surrogate::load(&particle_model(Core::Lstm), threads(1)).unwrap();
    let frames = frames(3, 300, 3);
    let mut memory = surrogate.start(&frames[0]).unwrap();
    for frame in &frames {
        surrogate.step(&mut memory, frame);
    }
    memory.forget();
    assert_eq!(memory, surrogate.start(&frames[0]).unwrap());
    assert_ne!(memory, surrogate.start(&frames[2]).unwrap(), "the shape is the first frame's");
}

#[test]
fn what_is_not_finite_stays_so() {
    for (checkpoint, mut frames) in wide(Core::MinGru) {
        let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
        let mut memory = surrogate.start(&frames[0]).unwrap();
        frames[0].velocity[200][1] = f32::NAN;
        assert!(surrogate.step(&mut memory, &frames[0]).check().is_err());
    }
}

#[test]
fn particles_that_a_network_cannot_predict_are_refused() {
    let frame = frames(1, 7, 1).remove(0);
    let surrogate = |architecture| {
        let particles = (architecture == Architecture::Frame).then_some(7);
        let sizes = Sizes { encoder: 6, hidden: 5, layers: 2, particles };
        let mut description = description(architecture, Core::MinGru, sizes);
        description.materials.retain(|&material| material != Material::Snow);
        Surrogate::load(&checkpoint(description, 1), threads(1)).unwrap()
    };
    let refusal = |architecture, change: fn(&mut Frame)| {
        let mut frame = frame.clone();
        frame.material.fill(Material::Liquid);
        change(&mut frame);
        surrogate(architecture).start(&frame).err().unwrap().to_string()
    };
    let fewer = |frame: &mut Frame| {
        frame.position.pop();
        frame.velocity.pop();
        frame.material.pop();
    };
    let message = refusal(Architecture::Frame, fewer);
    assert_eq!(message, "particles: found 6, expected 7 as in the checkpoint");
    let message = refusal(Architecture::Particle, |frame| frame.material[2] = Material::Snow);
    let expected = "expected one of liquid, jelly, rope as in the checkpoint";
    assert_eq!(message, format!("material[2]: found snow, {expected}"));
    let message = refusal(Architecture::Particle, |frame| frame.dt = 0.02);
    assert_eq!(message, "dt: found 0.02 s, expected 0.016 s as in the checkpoint");
    let message = refusal(Architecture::Frame, |frame| frame.domain.upper = [2.0, 1.0]);
    assert!(message.starts_with("lower, upper: found [0.0, 0.0], [2.0, 1.0]"), "{message}");
    for upper in [[1.0, 0.09], [f32::NAN, 1.0], [1.0, -2.0]] {
        let mut other = frame.clone();
        other.material.fill(Material::Liquid);
        other.domain.upper = upper;
        let message = surrogate(Architecture::Particle).start(&other).err().unwrap().to_string();
        assert!(message.ends_with("from corner to corner"), "{message}");
    }
    let message = refusal(Architecture::Particle, |frame| frame.domain.upper = [1e9, 1.0]);
    assert!(message.ends_with("expected at most 1048576"), "{message}");

    let mut fewer_particles = frame.clone();
    fewer_particles.material.fill(Material::Jelly);
    fewer(&mut fewer_particles);
    assert!(surrogate(Architecture::Particle).start(&fewer_particles).is_ok());
}

#[test]
fn weights_that_do_not_fit_are_refused_by_name() {
    let (mut checkpoint, _) = wide(Core::Gru).remove(0);
    checkpoint.tensors.remove("core.weight_hh_l1");
    let message = Surrogate::load(&checkpoint, None).err().unwrap().to_string();
    assert!(message.contains("core.weight_hh_l1: found nothing"), "{message}");

    let (mut checkpoint, _) = wide(Core::Gru).remove(0);
    checkpoint.description.sizes.hidden = 1 << 20;
    let message = Surrogate::load(&checkpoint, None).err().unwrap().to_string();
    assert!(message.contains("sizes.hidden: found 1048576, expected 1 to 65536"), "{message}");
}

/// A particle model and a frame of it.
fn particle_model(core: Core) -> Checkpoint {
    let sizes = Sizes { encoder: 20, hidden: 18, layers: 1, particles: None };
    checkpoint(description(Architecture::Particle, core, sizes), 8)
}

/// The network alone.
fn without_rules(mut checkpoint: Checkpoint) -> Checkpoint {
    checkpoint.description.rules = Rules::default();
    checkpoint
}

/// Momentum and angular momentum about the centre.
fn momenta(frame: &Frame) -> ([f64; 2], f64) {
    let count = frame.len() as f64;
    let mean = |values: &[[f32; 2]]| {
        [0, 1].map(|axis| values.iter().map(|x| f64::from(x[axis])).sum::<f64>() / count)
    };
    let centre = mean(&frame.position);
    let spin = frame.position.iter().zip(&frame.velocity).map(|(x, v)| {
        let r = [0, 1].map(|axis| f64::from(x[axis]) - centre[axis]);
        r[0] * f64::from(v[1]) - r[1] * f64::from(v[0])
    });
    (mean(&frame.velocity), spin.sum::<f64>() / count)
}

/// A spinning disc, `count` particles in the middle of nowhere.
fn disc(count: usize) -> Frame {
    let mut frame = frames(1, count, 3).remove(0);
    for (number, (x, v)) in frame.position.iter_mut().zip(&mut frame.velocity).enumerate() {
        let (r, angle) = (0.1 * (number as f32 / count as f32).sqrt(), 2.4 * number as f32);
        let from_centre = [r * angle.cos(), r * angle.sin()];
        *x = [0.5 + from_centre[0], 0.6 + from_centre[1]];
        *v = [0.3 - 4.0 * from_centre[1], 0.2 + 4.0 * from_centre[0]];
    }
    frame
}

#[test]
fn a_body_in_free_flight_keeps_its_momentum_and_its_spin() {
    let checkpoint = particle_model(Core::MinGru);
    let frame = disc(400);
    let fall = 9.8 * DT;
    let gains = [checkpoint.clone(), without_rules(checkpoint)].map(|checkpoint| {
        let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
        let mut memory = surrogate.start(&frame).unwrap();
        let next = surrogate.step(&mut memory, &frame);
        let ((before, spin), (after, turned)) = (momenta(&frame), momenta(&next));
        let gain = (after[0] - before[0]).hypot(after[1] - before[1] + f64::from(fall));
        (gain / f64::from(fall), (turned / spin - 1.0).abs(), next)
    });
    let [(gain, spin, kept), (other_gain, _, free)] = gains;
    assert!(gain < 1e-4 && spin < 1e-4, "{gain} of g dt, {spin} of the spin");
    // The network would have had it otherwise, and still shapes the body.
    assert!(other_gain > 0.1, "{other_gain}");
    assert!(largest_difference(&kept.velocity, &free.velocity) > 0.01);
}

#[test]
fn rules_behind_the_network_do_what_a_corrector_does_to_its_predictions() {
    for (checkpoint, frames) in wide(Core::MinGru) {
        let corrector = Corrector::new(&checkpoint.description);
        let spacing = checkpoint.description.surroundings.map_or(0.0, |s| s.spacing);
        let rest = Rest::new(&frames[0].position, &frames[0].material, 1, spacing);
        let expected = stream(&Surrogate::load(&checkpoint, threads(2)).unwrap(), &frames);
        let alone = Surrogate::load(&without_rules(checkpoint), threads(2)).unwrap();
        for ((before, mut found), expected) in
            frames.iter().zip(stream(&alone, &frames)).zip(&expected)
        {
            corrector.correct(&rest, before, &mut found);
            assert!(largest_difference(&found.position, &expected.position) <= 1e-6);
            assert!(largest_difference(&found.velocity, &expected.velocity) <= 1e-6);
        }
    }
}

#[test]
fn a_body_that_touches_a_wall_is_as_the_network_has_it() {
    let checkpoint = particle_model(Core::MinGru);
    let mut frame = disc(400);
    // Its area and its shape are nobody's but the network's.
    frame.material.fill(Material::Snow);
    // Falls so fast that it is there at the next frame only.
    for (x, v) in frame.position.iter_mut().zip(&mut frame.velocity) {
        x[1] -= 0.38;
        v[1] -= 4.0;
    }
    let [kept, free] = [checkpoint.clone(), without_rules(checkpoint)].map(|checkpoint| {
        let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
        surrogate.step(&mut surrogate.start(&frame).unwrap(), &frame)
    });
    assert_eq!(kept, free);
}

/// A network that holds everything against gravity, and pushes it to the right by a twentieth of that.
fn holding() -> Checkpoint {
    let mut checkpoint = particle_model(Core::MinGru);
    let unit = velocity_unit(&checkpoint.description.normalization);
    let up = 9.8 * DT / unit;
    let decoder = |name: &str| format!("decoder.{name}");
    checkpoint.tensors.get_mut(&decoder("weight")).unwrap().values.fill(0.0);
    checkpoint.tensors.get_mut(&decoder("bias")).unwrap().values =
        vec![0.05 * up, up, 0.05 * up, 0.5 * up];
    checkpoint
}

#[test]
fn what_touches_a_wall_and_hardly_moves_comes_to_rest() {
    let surrogate = Surrogate::load(&holding(), threads(1)).unwrap();
    let mut frame = disc(400);
    frame.material.fill(Material::Snow);
    frame.position.iter_mut().for_each(|x| x[1] -= 0.44);
    let next = |velocity: [f32; 2]| {
        let mut frame = frame.clone();
        frame.velocity.fill(velocity);
        surrogate.step(&mut surrogate.start(&frame).unwrap(), &frame)
    };
    let pull = 9.8 * DT;
    let still = next([0.0; 2]);
    assert_eq!((still.position, still.velocity), (frame.position.clone(), vec![[0.0; 2]; 400]));
    // Half asleep: it loses speed. Awake: it gains what the network says.
    let slow = next([0.6 * pull, 0.0]).velocity[0][0] / pull;
    assert!(slow > 0.2 && slow < 0.5, "{slow}");
    let fast = next([2.0 * pull, 0.0]).velocity[0][0] / pull;
    assert!((fast - 2.05).abs() < 1e-3, "{fast}");
}

#[test]
fn a_scene_elsewhere_is_predicted_as_if_it_were_here() {
    let checkpoint = particle_model(Core::Lstm);
    let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
    let here = frames(3, 200, 9);
    let away = [2.0, -4.0];
    let shift = |x: [f32; 2]| [x[0] + away[0], x[1] + away[1]];
    let mut there = here.clone();
    for frame in &mut there {
        frame.domain.lower = shift(frame.domain.lower);
        frame.domain.upper = shift(frame.domain.upper);
        frame.position.iter_mut().for_each(|x| *x = shift(*x));
    }
    for (here, there) in stream(&surrogate, &here).iter().zip(stream(&surrogate, &there)) {
        let back: Vec<_> = here.position.iter().map(|x| shift(*x)).collect();
        assert!(largest_difference(&back, &there.position) < 1e-4);
        assert!(largest_difference(&here.velocity, &there.velocity) < 1e-2);
    }
}

#[test]
fn a_larger_domain_changes_nothing_for_a_scene_far_from_the_walls_that_moved() {
    let checkpoint = particle_model(Core::Gru);
    let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
    let mut frame = disc(200);
    frame.position.iter_mut().for_each(|x| *x = [x[0] + 3.0, x[1] + 3.0]);
    let [small, large] = [7.0, 9.0].map(|end| {
        frame.domain.upper = [end; 2];
        surrogate.step(&mut surrogate.start(&frame).unwrap(), &frame)
    });
    assert!(largest_difference(&small.position, &large.position) < 1e-6);
    assert!(largest_difference(&small.velocity, &large.velocity) < 1e-5);
}

#[test]
fn particles_out_of_place_neither_stop_the_engine_nor_leave_the_domain() {
    let checkpoint = particle_model(Core::MinGru);
    let surrogate = Surrogate::load(&checkpoint, threads(2)).unwrap();
    for place in [[-3.0, 0.5], [0.5, 7.0], [1e30, -1e30], [0.4, 0.4]] {
        for everyone in [true, false] {
            let mut frame = frames(1, 300, 5).remove(0);
            let count = if everyone { frame.len() } else { 3 };
            frame.position[..count].fill(place);
            frame.velocity[..count].fill([40.0, -1e6]);
            let mut memory = surrogate.start(&frame).unwrap();
            for _ in 0..3 {
                frame = surrogate.step(&mut memory, &frame);
            }
            frame.check().unwrap();
            let inside = |x: &[f32; 2]| x.iter().all(|x| (0.05..=0.95).contains(x));
            assert!(frame.position.iter().all(inside), "{place:?}");
        }
    }
}
