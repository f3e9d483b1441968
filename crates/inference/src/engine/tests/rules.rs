//! Rules in the engine.

use super::{
    streams::{DT, JELLY, RULES, elastic, hovering, predict_alone, pushed_jelly, scene},
    *,
};
use crate::{
    checkpoint::Rule,
    engine::{Corrector, hidden_state::Memory},
    kernels::{lattice::Lattices, rest_shape::RestShape},
};

/// The same network without rules.
fn without_rules(mut checkpoint: Checkpoint) -> Checkpoint {
    checkpoint.description.rules = Rules::default();
    checkpoint
}

/// Mean momentum and angular momentum about the centre.
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

#[test]
fn every_rule_changes_a_scene_made_for_it() {
    let frames = scene(1);
    let with = |rules| predict(&Surrogate::load(&hovering(rules), threads(2)).unwrap(), &frames);
    let corrected = with(RULES);
    for rule in Rule::ALL.into_iter().filter(|rule| RULES.has(*rule)) {
        let mut rules = RULES;
        rules.remove(rule);
        let difference = largest_difference(&corrected[0].position, &with(rules)[0].position);
        assert!(difference > 1e-4, "{rule}: {difference}");
    }
}

#[test]
fn a_body_in_free_flight_keeps_its_momentum_and_its_spin() {
    let checkpoint = particle_model(Core::MinGru);
    let frame = disc(400);
    let fall = 9.8 * DT;
    let gains = [checkpoint.clone(), without_rules(checkpoint)].map(|checkpoint| {
        let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
        let next = predict(&surrogate, std::slice::from_ref(&frame)).remove(0);
        let ((before, spin), (after, turned)) = (momenta(&frame), momenta(&next));
        let gain = (after[0] - before[0]).hypot(after[1] - before[1] + f64::from(fall));
        (gain / f64::from(fall), (turned / spin - 1.0).abs(), next)
    });
    let [(gain, spin, kept), (other_gain, _, free)] = gains;
    assert!(gain < 1e-4 && spin < 1e-4, "{gain} of g dt, {spin} of the spin");
    // The network alone predicts another momentum, and still changes the shape.
    assert!(other_gain > 0.1, "{other_gain}");
    assert!(largest_difference(&kept.velocity, &free.velocity) > 0.01);
}

#[test]
fn rules_in_the_engine_equal_a_corrector_after_it() {
    for (checkpoint, frames) in wide(Core::MinGru) {
        let corrector = Corrector::new(&checkpoint.description);
        let spacing = checkpoint.description.grid.as_ref().map_or(0.0, |s| s.spacing);
        let rest = RestShape::new(&frames[0].position, &frames[0].material, 1, spacing);
        let lattices = Lattices::default();
        let expected = predict(&Surrogate::load(&checkpoint, threads(2)).unwrap(), &frames);
        let alone = Surrogate::load(&without_rules(checkpoint), threads(2)).unwrap();
        for ((before, mut found), expected) in
            frames.iter().zip(predict(&alone, &frames)).zip(&expected)
        {
            corrector.correct((&rest, &lattices, &mut lattices.expected()), before, &mut found);
            assert!(largest_difference(&found.position, &expected.position) <= 1e-6);
            assert!(largest_difference(&found.velocity, &expected.velocity) <= 1e-6);
        }
    }
}

#[test]
fn a_body_that_touches_a_wall_is_left_to_the_network() {
    let checkpoint = particle_model(Core::MinGru);
    let mut frame = disc(400);
    // Neither area nor shape of snow are corrected.
    frame.material.fill(Material::Snow);
    // So fast that it reaches the wall in the next frame.
    for (x, v) in frame.position.iter_mut().zip(&mut frame.velocity) {
        x[1] -= 0.38;
        v[1] -= 4.0;
    }
    let [kept, free] = [checkpoint.clone(), without_rules(checkpoint)].map(|checkpoint| {
        let surrogate = Surrogate::load(&checkpoint, threads(1)).unwrap();
        predict(&surrogate, std::slice::from_ref(&frame))
    });
    assert_eq!(kept, free);
}

/// A network whose prediction cancels gravity, and accelerates to the right by a hundredth of gravity.
fn pulled() -> Checkpoint {
    let mut checkpoint = particle_model(Core::MinGru);
    let unit = velocity_unit(&checkpoint.description.normalization);
    let up = 9.8 * DT / unit;
    let decoder = |name: &str| format!("decoder.{name}");
    checkpoint.tensors.get_mut(&decoder("weight")).unwrap().values.fill(0.0);
    checkpoint.tensors.get_mut(&decoder("bias")).unwrap().values =
        vec![0.01 * up, up, 0.01 * up, 0.5 * up];
    checkpoint
}

#[test]
fn a_body_that_touches_a_wall_and_hardly_moves_comes_to_rest() {
    let surrogate = Surrogate::load(&pulled(), threads(1)).unwrap();
    let mut frame = disc(400);
    frame.material.fill(Material::Snow);
    frame.position.iter_mut().for_each(|x| x[1] -= 0.44);
    let next = |velocity: [f32; 2]| {
        let mut frame = frame.clone();
        frame.velocity.fill(velocity);
        predict(&surrogate, &[frame]).remove(0)
    };
    let pull = 9.8 * DT;
    let still = next([0.0; 2]);
    assert_eq!((still.position, still.velocity), (frame.position.clone(), vec![[0.0; 2]; 400]));
    // Between the two limits it loses speed; above, it gains what the network predicts.
    let slow = next([0.06 * pull, 0.0]).velocity[0][0] / pull;
    assert!(slow > 0.02 && slow < 0.05, "{slow}");
    let fast = next([2.0 * pull, 0.0]).velocity[0][0] / pull;
    assert!((fast - 2.01).abs() < 1e-3, "{fast}");
}

#[test]
fn jelly_of_a_stiffer_stream_has_stiffer_and_wider_elements() {
    let sizes = Sizes { encoder: 9, hidden: 8, layers: 1, particles: None };
    let plain = description(Architecture::Particle, Core::MinGru, sizes);
    let conditioned = elastic(&Description { stiffness: true, ..plain });
    let surrogate = Surrogate::load(&checkpoint(conditioned, 5), threads(1)).unwrap();
    let frame = &jelly(1)[0];
    let [soft, stiff] = [1e3, 1e5].map(|stiffness| {
        let hidden = surrogate.start_with_stiffness(frame, Some(stiffness)).unwrap();
        let Memory::Particle(memory) = &hidden.memory else { unreachable!() };
        let lattice = &memory.stream.lattices.bodies()[0];
        (lattice.elasticity().lame[0], lattice.elasticity().steps, lattice.inverse_mass().len())
    });
    assert!((soft.0 / 125.0 - 1.0).abs() < 1e-5, "300 / (2 (1 + .2))");
    assert!((stiff.0 / soft.0 / 100.0 - 1.0).abs() < 1e-5);
    assert!(soft.1 < stiff.1 && soft.2 > stiff.2, "{soft:?}, {stiff:?}");
}

#[test]
fn jelly_that_was_pushed_by_something_unknown_moves_as_the_network_predicts() {
    let sizes = Sizes { encoder: 9, hidden: 8, layers: 1, particles: None };
    let plain = checkpoint(description(Architecture::Particle, Core::MinGru, sizes), 5);
    let elastic = Checkpoint { description: elastic(&plain.description), ..plain.clone() };
    let [plain, elastic] = [&plain, &elastic].map(|own| Surrogate::load(own, threads(1)).unwrap());
    let frames = pushed_jelly(&elastic);
    let [without, with] = [&plain, &elastic].map(|own| predict(own, &frames));
    let pushed = |frames: &[Frame], number: usize| frames[number].velocity[..JELLY].to_vec();
    assert_ne!(pushed(&with, 1), pushed(&without, 1), "it was where it was expected");
    assert_eq!(pushed(&with, 2), pushed(&without, 2));
    // Other bodies still move by their elasticity, and this one does after an interruption.
    assert_ne!(with[2].velocity[JELLY..], without[2].velocity[JELLY..]);
    assert_ne!(pushed(&predict_alone(&elastic, &frames), 2), pushed(&without, 2));
}

#[test]
fn elasticity_has_the_same_bits_with_any_number_of_threads_and_changes_no_liquid() {
    let sizes = Sizes { encoder: 9, hidden: 8, layers: 1, particles: None };
    let plain = checkpoint(description(Architecture::Particle, Core::MinGru, sizes), 5);
    let checkpoint = Checkpoint { description: elastic(&plain.description), ..plain.clone() };
    let frames = jelly(3);
    let with = |checkpoint: &Checkpoint, number: usize| {
        predict(&Surrogate::load(checkpoint, threads(number)).unwrap(), &frames)
    };
    let found = with(&checkpoint, 1);
    assert_eq!(found, with(&checkpoint, 3));
    assert_ne!(found, with(&plain, 1));
    // Without jelly, the rule changes nothing.
    let liquid = frames
        .iter()
        .cloned()
        .map(|frame| Frame { material: vec![Material::Liquid; frame.len()], ..frame });
    let liquid: Vec<_> = liquid.collect();
    let of = |checkpoint: &Checkpoint| {
        predict(&Surrogate::load(checkpoint, threads(1)).unwrap(), &liquid)
    };
    assert_eq!(of(&checkpoint), of(&plain));
}
