//! Streams of the frame model on a GPU: beside the engine on the processor, alone and beside others, and the time of a
//! frame with copies in and out.
//!
//! `frame_inference check` compares; `frame_inference time` times the paper's networks.

#[expect(dead_code, reason = "shared with training")]
mod problem;

use std::sync::Arc;

use eddy_cuda::{
    frame::{Inference, Streams},
    gpu::{Gpu, Precision},
    kernels::Constants,
    training::Settings,
};
use eddy_frames::{Domain, Frame, Material, Stamp, clock::Clock};
use eddy_inference::{
    checkpoint::{Checkpoint, Core, Pooling},
    engine::{StepRequest, Surrogate},
};
use problem::{Noise, PAPER, Problem, Result};

fn main() -> Result<()> {
    match std::env::args().nth(1).as_deref() {
        Some("check") => check(),
        Some("time") => time(),
        _ => Err("expected check or time".into()),
    }
}

/// The paper's network on a GPU and on the processor.
fn surrogates(core: Core, pooling: Pooling) -> Result<[Surrogate; 2]> {
    let Problem { description, weights, .. } =
        Problem::new(core, PAPER, true, Settings::plain(1, 2)).with_pooling(pooling);
    let checkpoint = Checkpoint::new(description, weights);
    let Checkpoint { description, tensors, .. } = &checkpoint;
    let cache = std::env::temp_dir().join("kernels");
    let gpu = Gpu::new(0, &Constants::of(description)?, Precision::Fp32, Some(&cache))?;
    let streams = Streams::new(Inference::new(Arc::new(gpu), description, tensors)?);
    Ok([Surrogate::on_device(&checkpoint, Arc::new(streams))?, Surrogate::load(&checkpoint, None)?])
}

/// Frames of particles at random places.
fn frames(stream: u64, count: u64) -> Vec<Frame> {
    let mut noise = Noise(stream);
    let mut pairs = |centre: f32, reach: f32| -> Vec<[f32; 2]> {
        (0..2500).map(|_| [(); 2].map(|()| centre + reach * noise.next())).collect()
    };
    (0..count)
        .map(|sequence| Frame {
            stream,
            sequence,
            stamp: Stamp(0).advance(0.016, sequence as u32),
            dt: 0.016,
            domain: Domain::UNIT,
            position: pairs(0.5, 0.4),
            velocity: pairs(0.0, 1.0),
            material: (0..2500).map(|p| Material::ALL[(p + stream as usize) % 4]).collect(),
        })
        .collect()
}

/// One frame of every stream.
fn step(
    stepper: &mut eddy_inference::engine::Stepper,
    hidden: &mut [eddy_inference::engine::HiddenState],
    frames: &[&Frame],
    next: &mut [Frame],
) -> Result<()> {
    let mut requests: Vec<_> = hidden
        .iter_mut()
        .zip(frames)
        .zip(next)
        .map(|((hidden, &frame), next)| StepRequest { hidden, frame: frame.into(), next })
        .collect();
    stepper.step_all(&mut requests);
    Ok(stepper.check()?)
}

fn check() -> Result<()> {
    let maxima = [
        (Core::MinGru, Pooling::MeanMax),
        (Core::Gru, Pooling::MeanMax),
        (Core::Lstm, Pooling::Max),
    ];
    for (core, pooling) in Core::ALL.map(|core| (core, Pooling::Mean)).into_iter().chain(maxima) {
        let [gpu, cpu] = surrogates(core, pooling)?;
        let streams: Vec<_> = (0..64).map(|stream| frames(stream, 4)).collect();
        let run = |surrogate: &Surrogate, streams: &[Vec<Frame>]| -> Result<Vec<Frame>> {
            let mut stepper = surrogate.stepper();
            let mut hidden: Vec<_> = streams
                .iter()
                .map(|frames| surrogate.start(&frames[0]))
                .collect::<std::result::Result<_, _>>()?;
            let mut next: Vec<_> = streams.iter().map(|frames| frames[0].clone()).collect();
            for number in 0..4 {
                let now: Vec<_> = streams.iter().map(|frames| &frames[number]).collect();
                step(&mut stepper, &mut hidden, &now, &mut next)?;
            }
            Ok(next)
        };
        let together = run(&gpu, &streams)?;
        let mut apart = 0f32;
        for (number, expected) in together.iter().enumerate() {
            if run(&gpu, &streams[number..=number])? != [expected.clone()] {
                return Err(format!("{}: other bits alone than beside others", core.name()).into());
            }
            expected.check()?; // all numbers are finite
            let processor = &run(&cpu, &streams[number..=number])?[0];
            let pairs =
                expected.velocity.as_flattened().iter().zip(processor.velocity.as_flattened());
            apart = pairs.map(|(a, b)| (a - b).abs()).fold(apart, f32::max);
        }
        println!(
            "{} {pooling:?}: velocities at most {apart:.1e} from the processor's",
            core.name()
        );
        if apart > 1e-5 {
            return Err("more than 1e-5".into());
        }
    }
    Ok(())
}

fn time() -> Result<()> {
    const FRAMES: usize = 2000;
    let maxima = [(Core::MinGru, Pooling::Max)];
    for (core, pooling) in Core::ALL.map(|core| (core, Pooling::Mean)).into_iter().chain(maxima) {
        let [gpu, _] = surrogates(core, pooling)?;
        for count in [1, 8, 64] {
            let frames: Vec<_> = (0..count).flat_map(|stream| frames(stream, 1)).collect();
            let mut hidden: Vec<_> = frames
                .iter()
                .map(|frame| gpu.start(frame))
                .collect::<std::result::Result<_, _>>()?;
            let (mut stepper, mut next) = (gpu.stepper(), frames.clone());
            let frames: Vec<_> = frames.iter().collect();
            let mut times = Vec::new();
            for number in 0..FRAMES + 20 {
                let clock = Clock::start();
                step(&mut stepper, &mut hidden, &frames, &mut next)?;
                if number >= 20 {
                    times.push(1e6 * clock.now().as_secs_f64());
                }
            }
            times.sort_by(f64::total_cmp);
            println!(
                "{} {pooling:?}: {count} streams: {:.1} us a frame of all, 99th percentile {:.1}",
                core.name(),
                times[FRAMES / 2],
                times[FRAMES * 99 / 100]
            );
        }
    }
    Ok(())
}
