//! The frame model's training on a GPU: beside the emulator, twice the same bits, and its time.
//!
//! `frame_training check` compares small networks of every core with the emulator; `frame_training time` times steps
//! of the paper's network; `frame_training core` those of its core over many frames; `frame_training group`
//! compares two GPUs with one that has both parts of the batch; `frame_training once` takes one step, for a profiler.

mod problem;

use std::sync::Arc;

use eddy_cuda::{
    CudaError,
    device::Device,
    frame::{Place, Training},
    gpu::{Gpu, Precision, list},
    training::{GROUP, InTraining as _, Settings},
};
use eddy_cuda_emulator::Emulator;
use eddy_frames::clock::Clock;
use eddy_inference::checkpoint::{Core, Pooling, Sizes};
use problem::{PAPER, Problem, Result, together, train_together, worst};

fn main() -> Result<()> {
    for gpu in list()? {
        println!("{gpu:?}");
    }
    match std::env::args().nth(1).as_deref() {
        Some("check") => check(),
        Some("time") => time(),
        Some("core") => core(),
        Some("group") => group(),
        Some("once") => once(),
        _ => Err("expected check, time, core, group or once".into()),
    }
}

fn check() -> Result<()> {
    let maxima = [(Core::MinGru, Pooling::MeanMax), (Core::Lstm, Pooling::Max)];
    for (core, pooling) in Core::ALL.map(|core| (core, Pooling::Mean)).into_iter().chain(maxima) {
        let sizes = Sizes { encoder: 260, hidden: 44, layers: 2, particles: Some(301) };
        let settings = Settings {
            unroll: 3,
            density_weight: 0.3,
            dropout: 0.2,
            noise: [0.01, 0.1],
            clip: 0.05,
            epsilon: 1e-4,
            average: true,
            ..Settings::plain(3, 3)
        };
        let mut problem = Problem::new(core, sizes, true, settings).with_pooling(pooling);
        let constants = problem.constants()?;
        let mut run = |device: Arc<dyn Device>, place: Place| -> Result<_> {
            problem.place = place;
            let mut training = problem.training(device)?;
            let batches = problem.batches(4);
            training.start(&batches[..1])?;
            let (mut outcomes, gradients) = (training.outcomes(1)?, training.gradients()?);
            training.start(&batches[1..])?;
            outcomes.extend(training.outcomes(3)?);
            Ok((outcomes, gradients, training.weights()?))
        };
        let expected = run(Arc::new(Emulator::new(&constants)?), Place::Device)?;
        for precision in [Precision::Fp32, Precision::Tf32] {
            let gpu = || Gpu::new(0, &constants, precision, None);
            let found = run(Arc::new(gpu()?), Place::Device)?;
            let again = run(Arc::new(gpu()?), Place::Device)?;
            let fetched = run(Arc::new(gpu()?), Place::Host)?;
            let (gradient, weights) = (worst(&found.1, &expected.1), worst(&found.2, &expected.2));
            println!(
                "{} {pooling:?} {}: relative errors: gradient {gradient:.1e}, weights after 4 steps {weights:.1e}",
                core.name(),
                precision.name(),
            );
            let most = if precision == Precision::Fp32 { 1e-4 } else { 5e-3 };
            if gradient.max(weights) > most {
                return Err(format!("relative error above {most:.0e}").into());
            }
            if found != again {
                return Err("two runs with the same settings differ".into());
            }
            if found != fetched {
                return Err("windows fetched from the host give other bits".into());
            }
        }
    }
    Ok(())
}

/// Median milliseconds a step.
fn median(
    gpu: &Arc<Gpu>,
    training: &mut Training,
    problem: &Problem,
    groups: usize,
) -> Result<f32> {
    let batches = problem.batches(GROUP);
    training.start(&batches[..4])?;
    let mut times = Vec::new();
    for _ in 0..groups {
        let mut outcome = Ok(());
        let time = gpu.time(|| {
            outcome = training.start(&batches);
            Ok(())
        })?;
        outcome?;
        times.push(time / GROUP as f32);
    }
    times.sort_by(f32::total_cmp);
    Ok(times[groups / 2])
}

#[expect(clippy::too_many_lines, reason = "a table of settings, then one loop over it")]
fn time() -> Result<()> {
    for (name, settings, cores, place, pooling) in [
        (
            "T 2, MSE of all frames",
            Settings::plain(256, 2),
            &Core::ALL[..],
            Place::Device,
            Pooling::Mean,
        ),
        (
            "T 2, MSE of all frames, pooled by the maximum",
            Settings::plain(256, 2),
            &[Core::MinGru],
            Place::Device,
            Pooling::Max,
        ),
        (
            "T 2, MSE of all frames, windows fetched from the host",
            Settings::plain(256, 2),
            &[Core::MinGru],
            Place::Host,
            Pooling::Mean,
        ),
        (
            "T 2, eddy's defaults: last frame, density loss, dropout, clip",
            Settings {
                observed_weight: 0.0,
                density_weight: 1e-3,
                dropout: 0.1,
                clip: 1.0,
                ..Settings::plain(256, 2)
            },
            &[Core::MinGru],
            Place::Device,
            Pooling::Mean,
        ),
    ] {
        for &core in cores {
            for one_hot in [false, true] {
                for precision in [Precision::Tf32, Precision::Fp32] {
                    let mut problem =
                        Problem::new(core, PAPER, one_hot, settings.clone()).with_pooling(pooling);
                    problem.place = place;
                    let clock = Clock::start();
                    let gpu = Arc::new(Gpu::new(
                        0,
                        &problem.constants()?,
                        precision,
                        Some("/tmp/kernels".as_ref()),
                    )?);
                    let opened = clock.now();
                    let mut training = problem.training(gpu.clone())?;
                    let time = median(&gpu, &mut training, &problem, 9)?;
                    let loss = training.outcomes(GROUP)?[GROUP - 1].loss;
                    println!(
                        "{name}: {} B 256 F {} {}: {time:.4} ms/step (opened in {opened:.2?}, loss {loss:.5})",
                        core.name(),
                        if one_hot { 8 } else { 5 },
                        precision.name(),
                    );
                }
            }
        }
    }
    Ok(())
}

/// With 8 particles the core takes nearly all of the time.
fn core() -> Result<()> {
    let sizes = || Sizes { particles: Some(8), ..PAPER };
    for core in [Core::MinGru, Core::MinLstm, Core::Gru, Core::Lstm] {
        for frames in [16, 64] {
            let mut problem = Problem::new(core, sizes(), true, Settings::plain(256, frames));
            problem.frames = 2 * frames;
            let gpu = Arc::new(Gpu::new(0, &problem.constants()?, Precision::Tf32, None)?);
            let mut training = problem.training(gpu.clone())?;
            let time = median(&gpu, &mut training, &problem, 3)?;
            println!("8 particles: {} B 256 F 8 T {frames} tf32: {time:.3} ms/step", core.name());
        }
    }
    Ok(())
}

/// Two GPUs, each with half of the batch, beside one GPU with all of it.
fn group() -> Result<()> {
    let settings = Settings {
        observed_weight: 0.0,
        density_weight: 1e-3,
        dropout: 0.1,
        clip: 1.0,
        ..Settings::plain(512, 2)
    };
    let problem = Problem::new(Core::MinGru, PAPER, true, settings);
    let constants = problem.constants()?;
    for precision in [Precision::Fp32, Precision::Tf32] {
        let batches = problem.batches(20);
        let one = || Ok::<_, CudaError>(vec![Gpu::new(0, &constants, precision, None)?]);
        let two = || Gpu::group(0..2, &constants, precision, None);
        let expected = train_together(&problem, one()?, &batches)?;
        let found = train_together(&problem, two()?, &batches)?;
        if found[0] != found[1] || found != train_together(&problem, two()?, &batches)? {
            return Err("two GPUs, or two runs of them, have different weights".into());
        }
        let moved = worst(&expected[0].1, &problem.weights);
        let apart = worst(&found[0].1, &expected[0].1);
        println!(
            "{}: weights after 20 steps: those of two GPUs {apart:.1e} from those of one, which moved by {moved:.1e}",
            precision.name()
        );
        for batch in [512, 2048] {
            let mut problem = problem.clone();
            problem.settings.batch = batch;
            let times = [time_together(&problem, one()?)?, time_together(&problem, two()?)?];
            let [alone, both] = times;
            println!(
                "{}: {batch} windows: {alone:.4} ms/step on one GPU, {both:.4} on two: {:.2} times the windows a second",
                precision.name(),
                alone / both
            );
        }
    }
    Ok(())
}

/// Median milliseconds of a step of all devices, by the clock of the host.
fn time_together(problem: &Problem, gpus: Vec<Gpu>) -> Result<f64> {
    let times = together(problem, gpus, &problem.batches(GROUP), |mut training, batches| {
        training.start(&batches[..4])?;
        training.outcomes(4)?;
        let mut times = Vec::new();
        for _ in 0..9 {
            let clock = Clock::start();
            training.start(&batches)?;
            training.outcomes(GROUP)?;
            times.push(1e3 * clock.now().as_secs_f64() / GROUP as f64);
        }
        times.sort_by(f64::total_cmp);
        Ok(times[4])
    })?;
    Ok(times.into_iter().fold(0.0, f64::max))
}

fn once() -> Result<()> {
    let problem = Problem::new(Core::MinGru, PAPER, true, Settings::plain(256, 2));
    let gpu = Arc::new(Gpu::new(0, &problem.constants()?, Precision::Tf32, None)?);
    let mut training = problem.training(gpu)?;
    training.start(&problem.batches(1))?;
    println!("{:?}", training.outcomes(1)?);
    Ok(())
}
