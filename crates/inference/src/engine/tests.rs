//! Tests of the engine alone; `eddy-learning` compares it with the networks in burn.

mod rules;
mod stiffness;
#[path = "test_streams.rs"]
mod streams;

use rand::{RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{HiddenState, ModelError, Surrogate, scales::velocity_unit};
use crate::checkpoint::{
    Architecture, Checkpoint, Core, Description, ElasticRule, FrameOptions, GridOptions,
    Normalization, Pooling, RestRule, Rules, Sizes, Weights, initial_weights,
    layout::particle_features,
};
use eddy_frames::{Domain, Frame, Material, Stamp};
use streams::{
    checkpoint, description, frames, instruction_sets, jelly, largest_difference, predict, threads,
};

/// A falling block of jelly and a heap of snow that hardly moves, each of more particles than one item of the thread pool.
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

/// One network of each kind, wide enough to use all threads.
fn wide(core: Core) -> Vec<(Checkpoint, Vec<Frame>)> {
    let frame_sizes = Sizes { encoder: 70, hidden: 210, layers: 2, particles: Some(301) };
    let frame = description(Architecture::Frame, core, frame_sizes);
    let options = FrameOptions { pooling: Pooling::MeanMax, ..FrameOptions::default() };
    let both = Description { frame: options, ..frame.clone() };
    let sizes = Sizes { encoder: 40, hidden: 50, layers: 2, particles: None };
    let particle = description(Architecture::Particle, core, sizes);
    let make = |description| (checkpoint(description, 5), frames(4, 301, 6));
    // A decoder with small outputs, so that bodies come to rest.
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
            let expected = predict(&Surrogate::load(&checkpoint, threads(1)).unwrap(), &frames);
            for number in [2, 3, 8] {
                let surrogate = Surrogate::load(&checkpoint, threads(number)).unwrap();
                assert_eq!(predict(&surrogate, &frames), expected, "{core:?}, {number} threads");
            }
        }
    }
}

#[test]
fn sets_of_instructions_with_a_fused_multiply_add_give_the_same_bits() {
    for core in Core::ALL {
        for (checkpoint, frames) in wide(core) {
            let sets = instruction_sets();
            let all = sets[1..].iter().map(|&set| {
                predict(&Surrogate::load_for(&checkpoint, threads(2), set).unwrap(), &frames)
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
        let alone = [predict(&surrogate, &first), predict(&surrogate, &second)];
        let mut stepper = surrogate.stepper();
        let mut states = [&first, &second].map(|frames| surrogate.start(&frames[0]).unwrap());
        for number in 0..4 {
            for (which, frames) in [&first, &second].into_iter().enumerate() {
                let found = stepper.step(&mut states[which], &frames[number]);
                assert_eq!(found, alone[which][number]);
            }
        }
        // Two steppers at the same time, and one stepper for both streams at once.
        std::thread::scope(|scope| {
            for (frames, expected) in [&first, &second].into_iter().zip(&alone) {
                let surrogate = &surrogate;
                scope.spawn(move || assert_eq!(&predict(surrogate, frames), expected));
            }
        });
        let mut streams = [&first, &second].map(|frames| (frames, Vec::new()));
        stepper.for_each(&mut streams, |stepper, (frames, found)| {
            let mut hidden = surrogate.start(&frames[0]).unwrap();
            *found = frames.iter().map(|frame| stepper.step(&mut hidden, frame)).collect();
        });
        assert_eq!(streams.map(|(_, found)| found), alone);
    }
}

#[test]
fn a_copied_state_continues_where_it_was_copied() {
    for (checkpoint, frames) in wide(Core::Gru) {
        let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
        let (mut stepper, mut hidden) = (surrogate.stepper(), surrogate.start(&frames[0]).unwrap());
        stepper.step(&mut hidden, &frames[0]);
        let mut copy = HiddenState::clone(&hidden);
        let expected = stepper.step(&mut copy, &frames[1]);
        assert_ne!(copy, hidden, "a step changes nothing");
        copy.clone_from(&hidden);
        assert_eq!(stepper.step(&mut copy, &frames[1]), expected);
    }
}

#[test]
fn a_state_that_forgot_its_frames_keeps_the_rest_shape() {
    let surrogate = Surrogate::load(&particle_model(Core::Lstm), threads(1)).unwrap();
    let frames = frames(3, 300, 3);
    let (mut stepper, mut hidden) = (surrogate.stepper(), surrogate.start(&frames[0]).unwrap());
    for frame in &frames {
        stepper.step(&mut hidden, frame);
    }
    hidden.forget();
    assert_eq!(hidden, surrogate.start(&frames[0]).unwrap());
    assert_ne!(hidden, surrogate.start(&frames[2]).unwrap(), "the rest shape is the first frame's");
}

#[test]
fn units_that_ignore_the_features_still_have_what_is_gathered() {
    let frames = frames(3, 200, 4);
    let features = particle_features(&particle_model(Core::MinGru).description);
    let with = |weight: f32| {
        let mut checkpoint = particle_model(Core::MinGru);
        let Weights { shape, values } = checkpoint.tensors.get_mut("context.weight").unwrap();
        values.chunks_mut(shape[1]).for_each(|row| row[..features].fill(weight));
        let predicted = instruction_sets().into_iter().map(|set| {
            predict(&Surrogate::load_for(&checkpoint, threads(1), set).unwrap(), &frames)
        });
        predicted.flatten().collect::<Vec<_>>()
    };
    for (none, tiny) in with(0.0).iter().zip(&with(1e-30)) {
        assert!(largest_difference(&none.position, &tiny.position) < 1e-6);
        assert!(largest_difference(&none.velocity, &tiny.velocity) < 1e-5);
    }
}

#[test]
fn a_nan_in_the_input_is_not_hidden_in_the_prediction() {
    for (checkpoint, mut frames) in wide(Core::MinGru) {
        let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
        let mut hidden = surrogate.start(&frames[0]).unwrap();
        frames[0].velocity[200][1] = f32::NAN;
        assert!(surrogate.stepper().step(&mut hidden, &frames[0]).check().is_err());
    }
}

#[test]
fn particles_that_a_network_cannot_predict_are_rejected() {
    let frame = frames(1, 7, 1).remove(0);
    let surrogate = |architecture| {
        let particles = (architecture == Architecture::Frame).then_some(7);
        let sizes = Sizes { encoder: 6, hidden: 5, layers: 2, particles };
        let mut description = description(architecture, Core::MinGru, sizes);
        description.materials.retain(|&material| material != Material::Snow);
        Surrogate::load(&checkpoint(description, 1), threads(1)).unwrap()
    };
    let rejection = |architecture, change: fn(&mut Frame)| {
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
    let message = rejection(Architecture::Frame, fewer);
    assert_eq!(message, "particles: found 6, expected 7 as in the checkpoint");
    let message = rejection(Architecture::Particle, |frame| frame.material[2] = Material::Snow);
    let expected = "expected one of liquid, jelly, rope as in the checkpoint: use one that knows it, or train on such data";
    assert_eq!(message, format!("material[2]: found snow, {expected}"));
    let message = rejection(Architecture::Particle, |frame| frame.dt = 0.02);
    assert!(
        message.starts_with("dt: found 0.02 s, expected 0.016 s as in the checkpoint: "),
        "{message}"
    );
    let message = rejection(Architecture::Frame, |frame| frame.domain.upper = [2.0, 1.0]);
    assert!(
        message.starts_with("lower, upper: found 0 to 2 x 0 to 1, expected 0 to 1 x 0 to 1"),
        "{message}"
    );
    for upper in [[1.0, 0.09], [f32::NAN, 1.0], [1.0, -2.0]] {
        let mut other = frame.clone();
        other.material.fill(Material::Liquid);
        other.domain.upper = upper;
        let message = surrogate(Architecture::Particle).start(&other).err().unwrap().to_string();
        assert!(message.ends_with(", for the walls"), "{message}");
    }
    let message = rejection(Architecture::Particle, |frame| frame.domain.upper = [1e9, 1.0]);
    assert!(message.ends_with("expected at most 1048576: units?"), "{message}");

    let mut fewer_particles = frame.clone();
    fewer_particles.material.fill(Material::Jelly);
    fewer(&mut fewer_particles);
    assert!(surrogate(Architecture::Particle).start(&fewer_particles).is_ok());
}

#[test]
fn weights_that_do_not_match_are_rejected_by_name() {
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

/// A spinning disc of `count` particles, away from walls.
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
fn predictions_do_not_depend_on_the_position_of_the_domain() {
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
    for (here, there) in predict(&surrogate, &here).iter().zip(predict(&surrogate, &there)) {
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
        predict(&surrogate, std::slice::from_ref(&frame)).remove(0)
    });
    assert!(largest_difference(&small.position, &large.position) < 1e-6);
    // A rule changes velocities by the change of positions divided by dt: the last place of a position is 1.5e-5 of a velocity.
    assert!(largest_difference(&small.velocity, &large.velocity) < 1e-4);
}

#[test]
fn particles_outside_the_domain_neither_stop_the_engine_nor_stay_outside() {
    let checkpoint = particle_model(Core::MinGru);
    let surrogate = Surrogate::load(&checkpoint, threads(2)).unwrap();
    for place in [[-3.0, 0.5], [0.5, 7.0], [1e30, -1e30], [0.4, 0.4]] {
        for everyone in [true, false] {
            let mut frame = frames(1, 300, 5).remove(0);
            let (mut stepper, mut hidden) = (surrogate.stepper(), surrogate.start(&frame).unwrap());
            let count = if everyone { frame.len() } else { 3 };
            frame.position[..count].fill(place);
            frame.velocity[..count].fill([40.0, -1e6]);
            assert!(matches!(
                surrogate.fits(&frame),
                Err(ModelError::Implausible(_) | ModelError::Fast { .. })
            ));
            for _ in 0..3 {
                frame = stepper.step(&mut hidden, &frame);
            }
            frame.check().unwrap();
            let inside = |x: &[f32; 2]| x.iter().all(|x| (0.05..=0.95).contains(x));
            assert!(frame.position.iter().all(inside), "{place:?}");
        }
    }
}
