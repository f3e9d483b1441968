//! The particle model's training on a GPU: `check` compares small networks of every core with the emulator and two runs with each
//! other, minGRU with Muon too (`check muon`: that alone, since the emulator takes minutes for all); `time` times steps of the
//! usual network, `time muon 32` with Muon and 32 windows; `profile` adds the times of its kernels up, launched one after the
//! other; `once` takes one step, for a profiler.

#![expect(unsafe_code, reason = "a device that passes launches on")]

#[path = "problem/mod.rs"]
#[expect(dead_code, reason = "the example of the frame model uses more of it")]
mod problem;

use std::{
    collections::BTreeMap,
    ffi::c_void,
    sync::{Arc, Mutex},
};

use eddy_cuda::{
    Result as DeviceResult,
    device::{Buffer, Device, HostBuffer, Pointer, Product, Queue, Shape},
    gpu::{Gpu, Precision, list},
    kernels::MATERIALS,
    particle::{Store, StoreWriter, Training, TrainingConstants},
    training::{Batch, GROUP, InTraining as _, Settings, Window},
};
use eddy_cuda_emulator::Emulator;
use eddy_frames::Material;
use eddy_inference::{
    checkpoint::{Architecture, Core, Description, Sizes, Weights, initial_weights},
    kernels::rest_shape::RestShape,
};
use problem::{Noise, Result, worst};

/// The argument for the optimizer.
const MUON: &str = "muon";
/// Distance of particles at rest (domain lengths).
const SPACING: f32 = 1.0 / 128.0;
/// Frames of a stream.
const FRAMES: usize = 60;
/// Frames that are observed before the free ones, those of `eddy train`.
const WARM_UP: usize = 3;

fn main() -> Result<()> {
    for gpu in list()? {
        println!("{gpu:?}");
    }
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.first().map(String::as_str) {
        Some("check") => check(&arguments[1..]),
        Some("time") => time(&arguments[1..]),
        Some("profile") => profile(),
        Some("once") => once(),
        _ => Err("expected check, time, profile or once".into()),
    }
}

/// A network, and streams of four blocks of `side` x `side` particles, one of each material.
struct Problem {
    description: Description,
    weights: BTreeMap<String, Weights>,
    settings: Settings,
    side: usize,
    streams: usize,
}

impl Problem {
    fn new(core: Core, sizes: Sizes, side: usize, settings: Settings) -> Self {
        let description = Description::untrained(Architecture::Particle, core, sizes);
        let mut noise = Noise(7);
        let mut weights = initial_weights(&description, 1);
        // Zeros would leave the other layers without gradients.
        for weight in weights.get_mut("decoder.weight").into_iter().flat_map(|w| &mut w.values) {
            *weight = 0.1 * noise.next();
        }
        Self { description, weights, settings, side, streams: 8 }
    }

    /// The same but for the last bits of the weights.
    fn nearly(&self, seed: u64) -> Self {
        let mut noise = Noise(100 + seed);
        let mut weights = self.weights.clone();
        for weight in weights.values_mut().flat_map(|weights| &mut weights.values) {
            *weight *= 1.0 + 2e-7 * noise.next();
        }
        let Self { description, settings, .. } = self;
        Self { description: description.clone(), settings: settings.clone(), weights, ..*self }
    }

    fn store(&self, device: &dyn Device) -> Result<Store> {
        let particles = 4 * self.side * self.side;
        let mut noise = Noise(3);
        let mut store = StoreWriter::new(device, particles, particles * FRAMES * self.streams)?;
        for _ in 0..self.streams {
            let (mut rest, mut velocity, mut material) = (Vec::new(), Vec::new(), Vec::new());
            for (number, kind) in Material::ALL.into_iter().enumerate() {
                let corner = [0.08 + 0.22 * number as f32, 0.3 + 0.2 * noise.next()];
                let speed = [0.05 * noise.next(), 0.1 * noise.next()];
                for k in 0..self.side * self.side {
                    let steps = [k % self.side, k / self.side].map(|step| step as f32 * SPACING);
                    rest.push([corner[0] + steps[0], corner[1] + steps[1]]);
                    velocity.push(speed);
                    material.push(kind);
                }
            }
            let numbers: Vec<u8> = material.iter().map(|&material| material as u8).collect();
            let mirrored: Vec<_> = rest.iter().map(|&[x, y]| [1.0 - x, y]).collect();
            let shape = |rest: &[[f32; 2]]| RestShape::new(rest, &material, 1, SPACING);
            store.stream(&numbers, [&shape(&rest), &shape(&mirrored)], 0.0);
            for frame in 0..FRAMES {
                let time = frame as f32 * 0.016;
                let bodies: Vec<_> = rest
                    .iter()
                    .zip(&velocity)
                    .map(|(&[x, y], &[vx, vy])| {
                        let [dx, dy] = [(); 2].map(|()| 0.001 * noise.next());
                        [x + time * vx + dx, y + time * vy + dy, vx + 10.0 * dx, vy + 10.0 * dy]
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
        Ok(training)
    }

    fn batches(&self, count: usize) -> Vec<Batch> {
        let Settings { batch, warm_up, unroll, .. } = self.settings;
        let particles = 4.0 * (self.side * self.side) as f32;
        let window = |i: usize| Window {
            stream: i * 7 % self.streams,
            start: i * 13 % (FRAMES - warm_up - unroll),
            mirrored: i.is_multiple_of(3),
            noise: i.is_multiple_of(2).then_some([i as u8; 32]),
        };
        let even = 1.0 / (2.0 * particles * unroll as f32);
        (1..=count)
            .map(|step| Batch {
                windows: (0..batch).map(|i| window(i + step * batch)).collect(),
                rate: 1e-3 / (1.0 - 0.9f32.powi(step as i32)),
                plain_rate: 1e-3,
                shares: [1.0, 0.0, 0.0, 0.0],
                correction: 1.0 / (1.0 - 0.999f32.powi(step as i32)).sqrt(),
                kept: 0.5,
                dropout: [0; 32],
                weights: Some(vec![[even, even, even, even]; unroll * batch * MATERIALS]),
            })
            .collect()
    }
}

/// `eddy train`'s settings with so many windows and free frames.
fn settings(batch: usize, warm_up: usize, unroll: usize) -> Settings {
    Settings {
        batch,
        warm_up,
        unroll,
        relative: true,
        observed_weight: 0.5,
        noise: [1e-4, 0.01],
        clip: 1.0,
        average: true,
        ..Settings::plain(batch, warm_up)
    }
}

fn usual() -> Sizes {
    Sizes { encoder: 16, hidden: 24, layers: 2, particles: None }
}

/// The cores named in the arguments, or all.
fn cores(arguments: &[String]) -> Vec<Core> {
    let is_named = |core: &Core| arguments.iter().any(|argument| argument == core.name());
    let named: Vec<Core> = Core::ALL.into_iter().filter(is_named).collect();
    if named.is_empty() { Core::ALL.to_vec() } else { named }
}

fn check(arguments: &[String]) -> Result<()> {
    let muon = (Core::MinGru, true);
    let all = if arguments == [MUON] {
        vec![muon]
    } else {
        cores(arguments).into_iter().map(|core| (core, false)).chain([muon]).collect()
    };
    for (core, muon) in all {
        let settings = Settings { epsilon: 1e-4, muon, ..settings(3, 3, 3) };
        let problem = Problem::new(core, usual(), 5, settings);
        let constants = TrainingConstants::of(&problem.description)?;
        let emulator = Arc::new(Emulator::new(&constants)?);
        let run = |device: Arc<dyn Device>| -> Result<_> {
            let mut training = problem.training(device)?;
            let batches = problem.batches(4);
            training.start(&batches[..1])?;
            let (mut outcomes, gradients) = (training.outcomes(1)?, training.gradients()?);
            training.start(&batches[1..])?;
            outcomes.extend(training.outcomes(3)?);
            Ok((outcomes, gradients, training.weights()?))
        };
        let expected = run(emulator.clone())?;
        // Where a unit is at the bend of its ReLU, the last bits of the weights decide on its gradient.
        let mut most = 1e-5f64;
        for seed in 0..3 {
            let near = problem.nearly(seed);
            let mut training = near.training(emulator.clone())?;
            training.start(&near.batches(1))?;
            most = most.max(2.0 * worst(&training.gradients()?, &expected.1));
        }
        let gpu = || Gpu::new(0, &constants, Precision::Fp32, None);
        let found = run(Arc::new(gpu()?))?;
        let again = run(Arc::new(gpu()?))?;
        let (gradient, weights) = (worst(&found.1, &expected.1), worst(&found.2, &expected.2));
        println!(
            "{}{}: relative errors: gradient {gradient:.1e}, at most {most:.1e}; weights after 4 steps {weights:.1e}",
            core.name(),
            if muon { ", Muon" } else { "" }
        );
        if gradient > most || most > 1e-3 {
            return Err(format!(
                "gradient: {gradient:.1e} apart, expected at most {most:.1e} and 1e-3"
            )
            .into());
        }
        if weights > 1e-2 {
            return Err(format!("weights: {weights:.1e} apart, expected at most 1e-2").into());
        }
        if found != again {
            return Err("two runs with the same settings differ".into());
        }
    }
    Ok(())
}

/// Steps of these cores; `muon` and a number of windows change them.
fn time(arguments: &[String]) -> Result<()> {
    let muon = arguments.iter().any(|argument| argument == MUON);
    let windows = arguments.iter().find_map(|argument| argument.parse().ok()).unwrap_or(16);
    for core in cores(arguments) {
        for unroll in [2, 6, 14, 24] {
            let settings = Settings { muon, ..settings(windows, WARM_UP, unroll) };
            let problem = Problem::new(core, usual(), 25, settings);
            let constants = TrainingConstants::of(&problem.description)?;
            let cache = Some("/tmp/kernels".as_ref());
            let gpu = Arc::new(Gpu::new(0, &constants, Precision::Fp32, cache)?);
            let mut training = problem.training(gpu.clone())?;
            let batches = problem.batches(GROUP);
            training.start(&batches[..2])?;
            let mut times = Vec::new();
            for _ in 0..5 {
                let mut outcome = Ok(());
                let time = gpu.time(|| {
                    outcome = training.start(&batches);
                    Ok(())
                })?;
                outcome?;
                times.push(time / GROUP as f32);
            }
            times.sort_by(f32::total_cmp);
            let loss = training.outcomes(GROUP)?[GROUP - 1].loss;
            println!(
                "{}: {windows} windows of 2,500 particles, {WARM_UP} observed and {unroll} free frames: {:.3} ms/step (loss {loss:.5})",
                core.name(),
                times[2]
            );
        }
    }
    Ok(())
}

fn once() -> Result<()> {
    let problem = Problem::new(Core::MinGru, usual(), 25, settings(16, WARM_UP, 6));
    let constants = TrainingConstants::of(&problem.description)?;
    let gpu = Arc::new(Gpu::new(0, &constants, Precision::Fp32, None)?);
    let mut training = problem.training(gpu)?;
    training.start(&problem.batches(1))?;
    println!("{:?}", training.outcomes(1)?);
    Ok(())
}

/// Launches of each kernel with so many blocks, and their time (ms).
type Times = BTreeMap<(&'static str, usize), (usize, f32)>;

/// A GPU that measures the time of each launch. It does not record steps as CUDA graphs, so every step launches every kernel.
struct Timed {
    gpu: Gpu,
    times: Mutex<Times>,
}

impl Device for Timed {
    fn allocate(&self, bytes: usize) -> DeviceResult<Buffer> {
        self.gpu.allocate(bytes)
    }

    fn allocate_host(&self, bytes: usize) -> DeviceResult<HostBuffer> {
        self.gpu.allocate_host(bytes)
    }

    fn rounds_to_tf32(&self) -> bool {
        self.gpu.rounds_to_tf32()
    }

    fn free_memory(&self) -> DeviceResult<u64> {
        self.gpu.free_memory()
    }

    fn write(&self, to: &Buffer, offset: usize, bytes: &[u8]) -> DeviceResult<()> {
        self.gpu.write(to, offset, bytes)
    }

    fn read(&self, from: &Buffer, offset: usize, bytes: &mut [u8]) -> DeviceResult<()> {
        self.gpu.read(from, offset, bytes)
    }

    fn copy(&self, to: &Buffer, from: &Buffer) -> DeviceResult<()> {
        self.gpu.copy(to, from)
    }

    fn clear(&self, queue: Queue, buffer: &Buffer) -> DeviceResult<()> {
        self.gpu.clear(queue, buffer)
    }

    unsafe fn launch_named(
        &self,
        queue: Queue,
        kernel: &'static str,
        shape: Shape,
        arguments: &mut [*mut c_void],
    ) -> DeviceResult<()> {
        // SAFETY: guaranteed by the caller.
        let launch = || unsafe { self.gpu.launch_named(queue, kernel, shape, arguments) };
        let time = self.gpu.time(launch)?;
        let mut times = self.times.lock().expect("no launch panics");
        let blocks = shape.grid.iter().product();
        let (launches, total) = times.entry((kernel, blocks)).or_default();
        (*launches, *total) = (*launches + 1, *total + time);
        Ok(())
    }

    unsafe fn multiply(&self, queue: Queue, product: &Product) -> DeviceResult<()> {
        // SAFETY: guaranteed by the caller.
        unsafe { self.gpu.multiply(queue, product) }
    }

    unsafe fn average(&self, queue: Queue, at: Pointer<f32>, numbers: usize) -> DeviceResult<()> {
        // SAFETY: guaranteed by the caller.
        unsafe { self.gpu.average(queue, at, numbers) }
    }

    fn finish(&self) -> DeviceResult<()> {
        self.gpu.finish()
    }
}

fn profile() -> Result<()> {
    for unroll in [2, 14] {
        let problem = Problem::new(Core::MinGru, usual(), 25, settings(16, WARM_UP, unroll));
        let constants = TrainingConstants::of(&problem.description)?;
        let gpu = Gpu::new(0, &constants, Precision::Fp32, None)?;
        let timed = Arc::new(Timed { gpu, times: Mutex::default() });
        let mut training = problem.training(timed.clone())?;
        training.start(&problem.batches(2))?;
        timed.times.lock().expect("no launch panics").clear();
        training.start(&problem.batches(10))?;
        let times = timed.times.lock().expect("no launch panics");
        let mut kernels: Vec<_> = times.iter().collect();
        kernels.sort_by(|(_, (_, a)), (_, (_, b))| b.total_cmp(a));
        println!("a step with {unroll} free frames: kernel, blocks, launches, ms, us a launch");
        for ((kernel, blocks), (launches, time)) in kernels {
            let each = 1e3 * time / *launches as f32;
            println!("{kernel:24} {blocks:6} {:4} {:7.3} {each:7.1}", launches / 10, time / 10.0);
        }
    }
    Ok(())
}
