//! Streams predicted on a device beside those that the engine predicts on the processor.
#![expect(clippy::unwrap_used, reason = "a test that cannot continue fails")]

#[path = "../../inference/src/engine/test_streams.rs"]
#[expect(dead_code, reason = "the engine's own tests use more of it")]
mod streams;

mod device_streams;

use std::{num::NonZeroUsize, sync::Arc};

use proptest::{prelude::*, sample::select};

use device_streams::{are_copied_and_forgotten, have_the_same_bits_alone_and_beside_others};
use eddy_cuda::{
    frame::{Inference, Streams},
    kernels::Constants,
};
use eddy_cuda_emulator::Emulator;
use eddy_frames::{Domain, Frame, Material, Stamp};
use eddy_inference::{
    checkpoint::{
        Activation, Architecture, Checkpoint, Core, Description, ElasticRule, FeatureScaling, Form,
        FrameOutput, GridOptions, MaterialInput, Normalization, Pooling, RestRule, Rules, Sizes,
        initial_weights,
    },
    engine::{Surrogate, scales::velocity_unit},
};
use streams::{checkpoint, description, frames, largest_difference, predict, threads};

/// Largest difference of predictions (domain lengths; domain lengths per second).
const TOLERANCE: f32 = 1e-5;

/// Descriptions of all kinds of frame models that a device predicts.
fn descriptions() -> impl Strategy<Value = Description> {
    let sizes = (1usize..40, 1usize..40, 1usize..4, 1usize..150);
    let choices = (
        select(&Core::ALL[..]),
        select(&Activation::ALL[..]),
        select(&[MaterialInput::OneHot, MaterialInput::Scalar][..]),
        select(&[FeatureScaling::MinMax, FeatureScaling::ZScore][..]),
        select(&[Pooling::Mean, Pooling::Max, Pooling::MeanMax][..]),
        select(&FrameOutput::ALL[..]),
        any::<[bool; 2]>(),
    );
    (choices, sizes).prop_map(|(choices, (encoder, hidden, layers, particles))| {
        let (core, activation, material, scaling, pooling, output, [log, normalize_gates]) =
            choices;
        let sizes = Sizes { encoder, hidden, layers, particles: Some(particles) };
        let mut description = description(Architecture::Frame, core, sizes);
        description.frame.activation = activation;
        description.frame.material = material;
        description.frame.scaling = scaling;
        description.frame.pooling = pooling;
        description.frame.output = output;
        description.form = if log { Form::Log } else { Form::Plain };
        description.normalize_gates = normalize_gates;
        description
    })
}

/// The network in the emulator.
fn emulated(checkpoint: &Checkpoint) -> Surrogate {
    let Checkpoint { description, tensors, .. } = checkpoint;
    let device = Emulator::new(&Constants::of(description).unwrap()).unwrap();
    // More threads than there are by default, which copy parts of a frame.
    let inference = Inference::new(Arc::new(device), description, tensors)
        .unwrap()
        .with_threads(NonZeroUsize::new(5));
    Surrogate::on_device(checkpoint, Arc::new(Streams::new(inference))).unwrap()
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(10))]

    #[test]
    fn a_device_predicts_what_the_processor_does(description in descriptions(), seed in any::<u64>()) {
        let particles = description.sizes.particles.unwrap();
        // Velocities from predicted positions have the errors of these, by the time between two frames.
        let unit = if description.frame.output == FrameOutput::Position { description.dt } else { 1.0 };
        let limit = TOLERANCE / unit;
        let checkpoint = checkpoint(description, seed);
        let frames = frames(4, particles, seed);
        let expected = predict(&Surrogate::load(&checkpoint, threads(1)).unwrap(), &frames);
        let found = predict(&emulated(&checkpoint), &frames);
        for (found, expected) in found.iter().zip(&expected) {
            let position = largest_difference(&found.position, &expected.position);
            let velocity = largest_difference(&found.velocity, &expected.velocity);
            prop_assert!(position <= TOLERANCE && velocity <= limit, "{position} and {velocity} apart");
            prop_assert_eq!(
                (found.sequence, found.stamp, &found.material),
                (expected.sequence, expected.stamp, &expected.material)
            );
        }
    }
}

/// A checkpoint with a few particles.
fn small(core: Core) -> Checkpoint {
    let sizes = Sizes { encoder: 20, hidden: 30, layers: 2, particles: Some(70) };
    checkpoint(description(Architecture::Frame, core, sizes), 3)
}

#[test]
fn a_stream_has_the_same_bits_alone_and_beside_others() {
    let streams: Vec<_> = (0..11).map(|seed| frames(3, 70, seed)).collect();
    for core in Core::ALL {
        have_the_same_bits_alone_and_beside_others(&emulated(&small(core)), &streams);
    }
    for core in [Core::Gru, Core::Lstm] {
        // The products with the input of the first layer have more parts than those with its last outputs.
        let sizes = Sizes { encoder: 20, hidden: 40, layers: 2, particles: Some(70) };
        let mut wide = description(Architecture::Frame, core, sizes);
        wide.frame.pooling = Pooling::MeanMax;
        have_the_same_bits_alone_and_beside_others(&emulated(&checkpoint(wide, 3)), &streams);
    }
}

#[test]
fn a_copied_state_goes_on_alone_and_a_forgotten_one_starts_anew() {
    for core in [Core::MinGru, Core::Lstm] {
        are_copied_and_forgotten(&emulated(&small(core)), &frames(4, 70, 5));
    }
}
