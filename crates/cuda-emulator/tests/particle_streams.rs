//! Streams of particle models predicted on a device beside those that the engine predicts on the processor.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue fails")]

#[path = "../../inference/src/engine/test_streams.rs"]
#[expect(dead_code, reason = "the engine's own tests use more of it")]
mod streams;

mod device_streams;

use std::{num::NonZeroUsize, path::Path, sync::Arc};

use proptest::{prelude::*, sample::select};

use device_streams::{are_copied_and_forgotten, have_the_same_bits_alone_and_beside_others};
use eddy_cuda::particle::{Constants, Inference, Streams, TrainingConstants};
use eddy_cuda_emulator::Emulator;
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::{
    checkpoint::{
        Architecture, Checkpoint, Core, Description, ElasticRule, Form, GridOptions,
        MATERIAL_INPUTS, Normalization, RestRule, Rule, Rules, Sizes, initial_weights,
        tensors_of_knots,
    },
    engine::{Accelerator, StepRequest, Surrogate, scales::velocity_unit},
};
use streams::{
    DT, JELLY, RULES, checkpoint, description, elastic, frames, hovering, jelly,
    largest_difference, predict, predict_alone, pushed_jelly, scene, threads,
};

/// Largest difference of predictions (domain lengths; domain lengths per second).
const TOLERANCE: f32 = 1e-5;

/// Descriptions of all kinds of particle models; compiling the kernels for one takes seconds.
fn descriptions() -> impl Strategy<Value = Description> {
    let channels = proptest::collection::vec(1usize..40, GridOptions::LEVELS);
    let widths = (1usize..40, 1usize..40, 1usize..3, channels);
    let choices = (select(&Core::ALL[..]), any::<[bool; 3]>(), 4usize..=6);
    (choices, widths).prop_map(|((core, options, material_inputs), widths)| {
        let [log, normalize_gates, stiffness] = options;
        let (encoder, hidden, layers, channels) = widths;
        let sizes = Sizes { encoder, hidden, layers, particles: None };
        let mut description = description(Architecture::Particle, core, sizes);
        let grid = description.grid.as_mut().unwrap();
        grid.channels = channels;
        description.form = if log { Form::Log } else { Form::Plain };
        description.normalize_gates = normalize_gates;
        description.stiffness = stiffness;
        description.material_inputs = material_inputs;
        description.format_version = Description::version(material_inputs);
        // Of a body of two random particles that nearly meet, the flight rule magnifies any difference.
        description.rules = Rules::default();
        description
    })
}

/// The network in the emulator.
fn emulated(checkpoint: &Checkpoint) -> Surrogate {
    Surrogate::on_devices(checkpoint, |checkpoint| Ok(device(checkpoint))).unwrap()
}

fn device(Checkpoint { description, tensors, .. }: &Checkpoint) -> Arc<dyn Accelerator> {
    let device = Emulator::new(&Constants::of(description).unwrap()).unwrap();
    // More threads than there are by default, which copy parts of a frame.
    let inference = Inference::new(Arc::new(device), description, tensors)
        .unwrap()
        .with_threads(NonZeroUsize::new(5));
    Arc::new(Streams::new(inference))
}

/// The largest difference of two predictions.
fn apart(found: &Frame, expected: &Frame) -> f32 {
    let position = largest_difference(&found.position, &expected.position);
    position.max(largest_difference(&found.velocity, &expected.velocity))
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(12))]

    #[test]
    fn a_device_predicts_what_the_processor_does(
        description in descriptions(),
        particles in 1usize..300,
        seed in any::<u64>(),
    ) {
        let checkpoint = checkpoint(description, seed);
        let frames = frames(4, particles, seed);
        let expected = predict(&Surrogate::load(&checkpoint, threads(1)).unwrap(), &frames);
        let found = predict(&emulated(&checkpoint), &frames);
        for (number, (found, expected)) in found.iter().zip(&expected).enumerate() {
            let apart = apart(found, expected);
            prop_assert!(apart <= TOLERANCE, "frame {number}: {apart} apart");
            prop_assert_eq!(
                (found.sequence, found.stamp, &found.material),
                (expected.sequence, expected.stamp, &expected.material)
            );
        }
    }
}

#[test]
fn each_rule_changes_a_scene_made_for_it_as_it_does_on_the_processor() {
    let frames = scene(3);
    let bare = predict(&emulated(&hovering(Rules::default())), &frames);
    for rule in Rule::ALL.into_iter().filter(|rule| RULES.has(*rule)) {
        let mut only = RULES;
        only.disable(&Rule::ALL.into_iter().filter(|other| *other != rule).collect::<Vec<_>>());
        let checkpoint = hovering(only);
        let expected = predict(&Surrogate::load(&checkpoint, threads(1)).unwrap(), &frames);
        let found = predict(&emulated(&checkpoint), &frames);
        let changed = apart(&found[0], &bare[0]);
        assert!(changed > 1e-4, "{rule}: {changed}");
        for (found, expected) in found.iter().zip(&expected) {
            let position = largest_difference(&found.position, &expected.position);
            let velocity = largest_difference(&found.velocity, &expected.velocity);
            // Rules divide the last digits of positions by dt.
            let fits = position <= TOLERANCE && velocity <= TOLERANCE / DT;
            assert!(fits, "{rule}: {position}, {velocity} apart");
        }
    }
}

#[test]
fn jelly_moves_by_its_elasticity_as_it_does_on_the_processor() {
    let frames = jelly(4);
    for stiffness in [false, true] {
        let rules = Rules::default();
        let plain = Description { stiffness, rules, ..small(Core::MinGru).description };
        let checkpoint_of = |description| checkpoint(description, 3);
        let checkpoint = checkpoint_of(elastic(&plain));
        let processor = Surrogate::load(&checkpoint, threads(1)).unwrap();
        let device = emulated(&checkpoint);
        let expected = predict_alone(&processor, &frames);
        let found = predict_alone(&device, &frames);
        let plain = Surrogate::load(&checkpoint_of(plain), threads(1)).unwrap();
        let without = predict_alone(&plain, &frames);
        assert!(apart(&without[3], &expected[3]) > 0.1, "the rule moves jelly");
        let pushed = pushed_jelly(&processor);
        let [in_stream, on_device] = [&processor, &device].map(|of| predict(of, &pushed));
        let unexpected = &predict_alone(&processor, &pushed)[2].velocity[..JELLY];
        assert_ne!(&in_stream[2].velocity[..JELLY], unexpected, "it moves as predicted");
        if !stiffness {
            are_copied_and_forgotten(&device, &frames);
        }
        let pairs = found.iter().chain(&on_device).zip(expected.iter().chain(&in_stream));
        for (number, (found, expected)) in pairs.enumerate() {
            let apart = apart(found, expected);
            // A position's rounding, 6e-8, gives an element 0.07 wide a velocity of 6e-5 within a frame.
            assert!(apart <= 2e-4, "conditioned: {stiffness}, frame {number}: {apart} apart");
        }
    }
}

/// Jelly of 12 x 8 particles at a place, more of it beside, and particles around, most of them as far away as where they keep the rule
/// `elastic` from moving jelly, some inside and some outside the domain.
fn surrounded_jelly() -> impl Strategy<Value = Frame> {
    const SPACING: f32 = 0.02;
    let place = prop::array::uniform2(0.3f32..0.7);
    let beside = prop::array::uniform2(-0.45f32..0.45);
    let around = prop::collection::vec((0.0f32..1.0, 0.05f32..0.25), 0..4);
    // All of it within a tenth of the domain outside, as a frame must be.
    let domain = (prop::array::uniform2(-0.3f32..0.0), prop::array::uniform2(1.6f32..2.5));
    (place, beside, around, domain).prop_map(|(place, beside, around, (lower, size))| {
        let block = |corner: [f32; 2]| {
            let at = |k: u8| [f32::from(k % 12), f32::from(k / 12)];
            (0..96).map(move |k| [0, 1].map(|axis| corner[axis] + SPACING * at(k)[axis]))
        };
        // At a share of the way around the block, at a distance from its side.
        let [wide, high] = [11.0 * SPACING, 7.0 * SPACING];
        let around = around.into_iter().map(|(share, distance)| {
            let (side, along) = ((4.0 * share) as u8, (4.0 * share).fract());
            let [x, y] = match side {
                0 => [along * wide, -distance],
                1 => [along * wide, high + distance],
                2 => [-distance, along * high],
                _ => [wide + distance, along * high],
            };
            [place[0] + x, place[1] + y]
        });
        let other = [place[0] + beside[0], place[1] + beside[1]];
        let mut position: Vec<_> = block(place).chain(block(other)).collect();
        let mut material = vec![Material::Jelly; position.len()];
        position.extend(around);
        material.resize(position.len(), Material::Liquid);
        Frame {
            velocity: position.iter().map(|[x, y]| [0.5 * y, -1.0 - x]).collect(),
            domain: Domain { lower, upper: [lower[0] + size[0], lower[1] + size[1]] },
            position,
            material,
            ..frames(1, 0, 0).remove(0)
        }
    })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    /// The processor looks at every particle, the device at those of the cells around.
    #[test]
    fn jelly_has_the_same_particles_close_as_on_the_processor(frame in surrounded_jelly()) {
        let plain = Description { rules: Rules::default(), ..small(Core::MinGru).description };
        let checkpoint = checkpoint(elastic(&plain), 3);
        let frames = [frame];
        let [expected] = &predict(&Surrogate::load(&checkpoint, threads(1)).unwrap(), &frames)[..]
        else {
            panic!("one frame")
        };
        let found = &predict(&emulated(&checkpoint), &frames)[0];
        let apart = apart(found, expected);
        prop_assert!(apart <= 2e-4, "{apart} apart");
    }
}

/// A checkpoint with narrow layers.
fn small(core: Core) -> Checkpoint {
    let sizes = Sizes { encoder: 10, hidden: 13, layers: 2, particles: None };
    checkpoint(description(Architecture::Particle, core, sizes), 3)
}

/// Positions that a grid may find hard.
fn positions() -> impl Strategy<Value = Vec<[f32; 2]>> {
    let cell = 1.0f32 / 32.0;
    let count = 1usize..200;
    let free =
        count.clone().prop_flat_map(|n| prop::collection::vec([-0.1f32..1.08, -0.1f32..1.08], n));
    let place = || prop::array::uniform2(-0.1f32..1.08);
    let heap = (count.clone(), place()).prop_map(|(n, place)| vec![place; n]);
    // On the edges and centres of cells.
    let corners = count.prop_flat_map(move |n| {
        let half = (0u8..65).prop_map(move |half| f32::from(half) * 0.5 * cell);
        prop::collection::vec(prop::array::uniform2(half), n)
    });
    prop_oneof![free, heap, corners]
}

/// A stream with these positions in every frame.
fn standing(position: Vec<[f32; 2]>, domain: Domain) -> Vec<Frame> {
    let mut frames = frames(2, position.len(), position.len() as u64);
    for frame in &mut frames {
        frame.position.clone_from(&position);
        frame.domain = domain;
    }
    frames
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(40))]

    #[test]
    fn particles_in_one_place_at_cell_edges_or_outside_the_domain_are_predicted_alike(
        position in positions(),
        corner in prop::array::uniform2(-0.3f32..0.0),
        size in prop::array::uniform2(1.3f32..2.5),
    ) {
        let mut checkpoint = small(Core::MinGru);
        checkpoint.description.rules = Rules::default();
        let domain = Domain { lower: corner, upper: [corner[0] + size[0], corner[1] + size[1]] };
        let frames = standing(position, domain);
        let expected = predict(&Surrogate::load(&checkpoint, threads(1)).unwrap(), &frames);
        let found = predict(&emulated(&checkpoint), &frames);
        for (found, expected) in found.iter().zip(&expected) {
            let apart = apart(found, expected);
            prop_assert!(apart <= TOLERANCE, "{apart} apart");
        }
    }
}

#[test]
fn a_stream_has_the_same_bits_alone_and_beside_others_of_other_sizes() {
    let stream = |seed: u64| {
        let mut frames = frames(3, [1, 70, 257, 130][seed as usize % 4], seed);
        for frame in &mut frames {
            frame.domain.upper[0] += seed as f32 % 3.0;
        }
        frames
    };
    let streams: Vec<_> = (0..11).map(stream).collect();
    for core in Core::ALL {
        have_the_same_bits_alone_and_beside_others(&emulated(&small(core)), &streams);
    }
}

#[test]
fn each_stream_has_a_stiffness_of_its_own() {
    let mut description = small(Core::MinGru).description;
    description.stiffness = true;
    let surrogate = emulated(&checkpoint(description, 3));
    // Streams of other sizes have another stiffness.
    let streams: Vec<_> = [40, 90, 70].map(|particles| frames(3, particles, 6)).into();
    have_the_same_bits_alone_and_beside_others(&surrogate, &streams);
    let first = &streams[0][0];
    let mut states = [1e3, 1e5].map(|e| surrogate.start_with_stiffness(first, Some(e)).unwrap());
    let mut copy = states[1].clone();
    let mut stepper = surrogate.stepper();
    let [soft, stiff] = states.each_mut().map(|state| stepper.step(state, first));
    assert_ne!(soft, stiff);
    assert_eq!(stepper.step(&mut copy, first), stiff, "a copy");
}

#[test]
fn each_stream_has_the_weights_of_its_stiffness() {
    let mut description = small(Core::MinGru).description;
    description.stiffness = true;
    let parts = [5, 6].map(|seed| checkpoint(description.clone(), seed));
    description.stiffness_knots = vec![1e3, 1e5];
    let tensors = tensors_of_knots(&parts.clone().map(|part| part.tensors));
    let combined = Checkpoint::new(description, tensors);
    let frames = frames(3, 100, 4);
    let run = |surrogate: &Surrogate| {
        let start = |e| surrogate.start_with_stiffness(&frames[0], Some(e)).unwrap();
        let mut states = [1e3, 2e4, 1e3].map(start);
        let (mut stepper, mut predicted) =
            (surrogate.stepper(), [(); 3].map(|()| frames[0].clone()));
        for frame in &frames {
            let pairs = states.iter_mut().zip(&mut predicted);
            let steps =
                pairs.map(|(hidden, next)| StepRequest { hidden, frame: frame.into(), next });
            stepper.step_all(&mut steps.collect::<Vec<_>>());
            stepper.check().unwrap();
        }
        predicted
    };
    let found = run(&emulated(&combined));
    let expected = run(&Surrogate::load(&combined, threads(1)).unwrap());
    for (found, expected) in found.iter().zip(&expected) {
        assert!(apart(found, expected) <= TOLERANCE);
    }
    assert_eq!(found[0], found[2]);
    assert_ne!(found[0], found[1]);
    let refused = Surrogate::on_device(&combined, device(&parts[0])).err().unwrap().to_string();
    assert_eq!(
        refused,
        "the device has one set of weights, the checkpoint some for several stiffnesses"
    );
}

#[test]
fn a_copied_state_goes_on_alone_and_a_forgotten_one_starts_anew() {
    for core in [Core::MinGru, Core::Lstm, Core::Mlp] {
        are_copied_and_forgotten(&emulated(&small(core)), &frames(4, 70, 5));
    }
}

/// Blocks of all materials of the shipped network that fall and collide, observed for a few frames; then the network observes its own predictions.
fn blocks() -> Frame {
    let mut frame = frames(1, 0, 0).remove(0);
    for (number, material) in Material::ALL[..MATERIAL_INPUTS].iter().copied().enumerate() {
        for k in 0..150 {
            let [x, y] = [(k % 15) as f32, (k / 15) as f32].map(|x| x / 128.0);
            frame.position.push([0.1 + 0.2 * number as f32 + x, 0.05 + 0.07 * number as f32 + y]);
            frame.velocity.push([0.3 - 0.2 * number as f32, -1.0]);
            frame.material.push(material);
        }
    }
    frame
}

/// Predicts ten frames of `frame` with the shipped network, each from the processor's prediction of the last.
fn ten_frames(mut frame: Frame) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../checkpoints/particle-mingru");
    let checkpoint = Checkpoint::load(&folder).unwrap();
    let surrogates = [emulated(&checkpoint), Surrogate::load(&checkpoint, threads(1)).unwrap()];
    let mut steppers = surrogates.each_ref().map(Surrogate::stepper);
    let mut hidden = surrogates.each_ref().map(|surrogate| surrogate.start(&frame).unwrap());
    for number in 0..10 {
        let found = steppers[0].step(&mut hidden[0], &frame);
        frame = steppers[1].step(&mut hidden[1], &frame);
        let position = largest_difference(&found.position, &frame.position);
        assert!(position <= TOLERANCE, "frame {number}: {position} apart");
        // The states have drifted apart since the first frame, and the rules divide the last digits of positions by dt.
        let most = (number + 1) as f32 * TOLERANCE + 2.0 * f32::EPSILON / frame.dt;
        // The rule `elastic` makes a velocity of 4e-4 of a position's rounding, 6e-8, in elements .027 wide.
        for (is_jelly, most) in [(false, most), (true, most + 4e-4)] {
            let [found, expected] = [&found, &frame].map(|of| -> Vec<[f32; 2]> {
                let rows = of.velocity.iter().zip(&of.material);
                rows.filter(|row| (*row.1 == Material::Jelly) == is_jelly)
                    .map(|row| *row.0)
                    .collect()
            });
            let velocity = largest_difference(&found, &expected);
            assert!(velocity <= most, "frame {number}, jelly: {is_jelly}: {velocity} apart");
        }
    }
    steppers[0].check().unwrap();
}

#[test]
fn the_shipped_network_with_its_rules_predicts_alike_for_ten_frames() {
    ten_frames(blocks());
}

#[test]
fn bodies_at_rest_in_flight_and_liquid_that_is_too_dense_are_corrected_alike() {
    let mut frame = blocks();
    for (number, (x, v)) in frame.position.iter_mut().zip(&mut frame.velocity).enumerate() {
        match number / 150 {
            // Liquid at 1.8 times its density.
            0 => *x = [0.3 + 0.75 * (x[0] - 0.1), 0.1 + 0.75 * (x[1] - 0.05)],
            // On the floor, at rest.
            1 => (*x, *v) = ([x[0], x[1] - 0.09], [0.0; 2]),
            // Spinning.
            2 => *v = [8.0 * (0.22 - x[1]), 8.0 * (x[0] - 0.53)],
            _ => {}
        }
    }
    ten_frames(frame);
}

#[test]
fn the_pressure_of_a_domain_too_large_for_shared_memory_is_the_same() {
    let mut frame = blocks();
    frame.domain.upper = [2.0, 2.0];
    for x in &mut frame.position[..150] {
        *x = [1.2 + 0.6 * (x[0] - 0.1), 0.1 + 0.6 * (x[1] - 0.05)];
    }
    ten_frames(frame);
}

#[test]
fn networks_that_do_not_fit_are_named() {
    let sizes = Sizes { encoder: 16, hidden: 5000, layers: 1, particles: None };
    let wide = Description::untrained(Architecture::Particle, Core::Gru, sizes);
    let message = Constants::of(&wide).err().unwrap().to_string();
    assert!(message.contains("network.hidden 5000"), "{message}");
    let sizes = Sizes { encoder: 16, hidden: 16, layers: 1, particles: None };
    let mut wide = Description::untrained(Architecture::Particle, Core::Gru, sizes);
    wide.grid.as_mut().unwrap().channels = vec![8000, 8, 8];
    let message = Constants::of(&wide).err().unwrap().to_string();
    assert!(message.contains("[8000, 8, 8]"), "{message}");
    wide.grid.as_mut().unwrap().channels = vec![4000, 8, 8];
    let message = TrainingConstants::of(&wide).err().unwrap().to_string();
    assert!(message.contains("[4000, 8, 8]"), "{message}");
}
