//! The frame model's training on a GPU: beside the emulator, twice the same bits, and its time.
//!
//! `frame_training check` compares small networks of every core with the emulator; `frame_training time` times steps
//! of the paper's network; `frame_training once` takes one step, for a profiler.

use std::{collections::BTreeMap, error::Error, sync::Arc};

use eddy_cuda::{
    device::Device,
    frame::{Batch, GROUP, Settings, Store, StoreWriter, Training, Window},
    gpu::{Gpu, Precision, list},
    kernels::Constants,
};
use eddy_cuda_emulator::Emulator;
use eddy_frames::clock::Clock;
use eddy_inference::checkpoint::{
    Architecture, Core, Description, MaterialInput, Sizes, Weights, initial_weights,
};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

fn main() -> Result<()> {
    for gpu in list()? {
        println!("{gpu:?}");
    }
    match std::env::args().nth(1).as_deref() {
        Some("check") => check(),
        Some("time") => time(),
        Some("once") => once(),
        _ => Err("expected check, time or once".into()),
    }
}

/// Numbers in -1..1 that only depend on the seed.
struct Noise(u64);

impl Noise {
    fn next(&mut self) -> f32 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    }
}

/// A network of these widths, its weights, and streams of particles that move at random.
struct Problem {
    description: Description,
    weights: BTreeMap<String, Weights>,
    settings: Settings,
    frames: usize,
    streams: usize,
}

impl Problem {
    fn new(core: Core, sizes: Sizes, one_hot: bool, settings: Settings) -> Self {
        let mut description = Description::untrained(Architecture::Frame, core, sizes);
        if !one_hot {
            description.frame.material = MaterialInput::Scalar;
        }
        let mut noise = Noise(7);
        let mut weights = initial_weights(&description, 1);
        for weight in weights.get_mut("decoder.weight").into_iter().flat_map(|w| &mut w.values) {
            *weight = 0.03 * noise.next();
        }
        Self { description, weights, settings, frames: 40, streams: 8 }
    }

    fn store(&self, device: &dyn Device) -> Result<Store> {
        let particles = self.description.sizes.particles.unwrap_or_default();
        let mut noise = Noise(3);
        let mut store = StoreWriter::new(device, particles, self.frames * self.streams)?;
        for stream in 0..self.streams {
            let material: Vec<u8> =
                (0..particles).map(|p| ((p * 4 / particles + stream) % 4) as u8).collect();
            store.stream(&material);
            for _ in 0..self.frames {
                let bodies: Vec<_> = (0..particles)
                    .map(|_| {
                        [
                            0.5 + 0.4 * noise.next(),
                            0.5 + 0.4 * noise.next(),
                            noise.next(),
                            noise.next(),
                        ]
                    })
                    .collect();
                store.frame(&bodies)?;
            }
        }
        Ok(store.finish()?)
    }

    fn training(&self, device: Arc<dyn Device>) -> Result<Training> {
        let store = Arc::new(self.store(&*device)?);
        let training = Training::new(device, store, &self.description, &self.settings)?;
        training.set_weights(&self.weights)?;
        let even = 2.0
            * self.description.sizes.particles.unwrap_or_default() as f32
            * self.settings.unroll as f32;
        training.set_error_weights([1.0 / even, 1.0 / even, 0.25 / even, 0.25 / even])?;
        Ok(training)
    }

    fn constants(&self) -> Result<Constants> {
        Ok(Constants::of(&self.description)?)
    }

    fn batches(&self, count: usize) -> Vec<Batch> {
        let window = |i: usize| Window {
            stream: i * 7 % self.streams,
            start: i * 13 % (self.frames - self.settings.warm_up - self.settings.unroll),
            mirrored: i.is_multiple_of(3),
            noise: i.is_multiple_of(2).then_some([i as u8; 32]),
        };
        (1..=count)
            .map(|step| Batch {
                windows: (0..self.settings.batch)
                    .map(|i| window(i + step * self.settings.batch))
                    .collect(),
                rate: 1e-3 / (1.0 - 0.9f32.powi(step as i32)),
                correction: 1.0 / (1.0 - 0.999f32.powi(step as i32)).sqrt(),
                kept: 0.5,
                dropout: [step as u8; 32],
                weights: None,
            })
            .collect()
    }
}

fn settings(batch: usize, warm_up: usize) -> Settings {
    Settings {
        batch,
        warm_up,
        unroll: 1,
        relative: false,
        observed_weight: 1.0,
        density_weight: 0.0,
        density_nodes: 32,
        dropout: 0.0,
        noise: [0.0, 0.0],
        clip: f32::INFINITY,
        epsilon: 1e-8,
        average: false,
    }
}

fn check() -> Result<()> {
    for core in Core::ALL {
        let sizes = Sizes { encoder: 260, hidden: 44, layers: 2, particles: Some(301) };
        let settings = Settings {
            unroll: 3,
            density_weight: 0.3,
            dropout: 0.2,
            noise: [0.01, 0.1],
            clip: 0.05,
            epsilon: 1e-4,
            average: true,
            ..settings(3, 3)
        };
        let problem = Problem::new(core, sizes, true, settings);
        let constants = problem.constants()?;
        let run = |device: Arc<dyn Device>| -> Result<_> {
            let mut training = problem.training(device)?;
            let batches = problem.batches(4);
            training.start(&batches[..1])?;
            let (mut outcomes, gradients) = (training.outcomes(1)?, training.gradients()?);
            training.start(&batches[1..])?;
            outcomes.extend(training.outcomes(3)?);
            Ok((outcomes, gradients, training.weights()?))
        };
        let expected = run(Arc::new(Emulator::new(&constants)?))?;
        for precision in [Precision::Fp32, Precision::Tf32] {
            let gpu = || Gpu::new(0, &constants, precision, None);
            let found = run(Arc::new(gpu()?))?;
            let again = run(Arc::new(gpu()?))?;
            let (gradient, weights) = (worst(&found.1, &expected.1), worst(&found.2, &expected.2));
            println!(
                "{} {}: relative errors: gradient {gradient:.1e}, weights after 4 steps {weights:.1e}",
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
        }
    }
    Ok(())
}

/// The largest relative error of a tensor.
fn worst(found: &BTreeMap<String, Weights>, expected: &BTreeMap<String, Weights>) -> f64 {
    let norm = |values: &mut dyn Iterator<Item = f64>| values.map(|v| v * v).sum::<f64>().sqrt();
    let errors = expected.iter().map(|(name, expected)| {
        let pairs = found[name].values.iter().zip(&expected.values);
        norm(&mut pairs.map(|(a, b)| f64::from(a - b)))
            / norm(&mut expected.values.iter().map(|&b| f64::from(b))).max(1e-12)
    });
    errors.fold(0.0, f64::max)
}

const PAPER: Sizes = Sizes { encoder: 256, hidden: 1250, layers: 2, particles: Some(2500) };

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

fn time() -> Result<()> {
    for (name, settings, cores) in [
        ("T 2, MSE of all frames", settings(256, 2), &Core::ALL[..]),
        (
            "T 2, eddy's defaults: last frame, density loss, dropout, clip",
            Settings {
                observed_weight: 0.0,
                density_weight: 1e-3,
                dropout: 0.1,
                clip: 1.0,
                ..settings(256, 2)
            },
            &[Core::MinGru],
        ),
    ] {
        for &core in cores {
            for one_hot in [false, true] {
                for precision in [Precision::Tf32, Precision::Fp32] {
                    let problem = Problem::new(core, PAPER, one_hot, settings.clone());
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

fn once() -> Result<()> {
    let problem = Problem::new(Core::MinGru, PAPER, true, settings(256, 2));
    let gpu = Arc::new(Gpu::new(0, &problem.constants()?, Precision::Tf32, None)?);
    let mut training = problem.training(gpu)?;
    training.start(&problem.batches(1))?;
    println!("{:?}", training.outcomes(1)?);
    Ok(())
}
