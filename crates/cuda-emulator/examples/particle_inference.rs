//! The particle model on NVIDIA GPUs: `check` compares predictions with those of the processor, alone and beside other
//! streams, in two runs; `time` measures frames from the memory of the host to the memory of the host; `growth` measures large streams, and
//! fails if a particle of 400,000 costs twice as much as one of 100,000; `once FOLDER N FRAMES` steps a stream of N x N x 2,500 particles so
//! often, for profilers. FOLDER is that of a checkpoint.

#[path = "problem/mod.rs"]
#[expect(dead_code, reason = "the example of the training uses more of it")]
mod problem;

use std::{
    hash::{DefaultHasher, Hasher},
    path::Path,
    sync::Arc,
};

use eddy_cuda::{
    gpu::{Gpu, Precision},
    particle::{Constants, Inference, Streams},
};
use eddy_frames::{Domain, Frame, Material, Stamp, clock::Clock};
use eddy_inference::{
    checkpoint::{Architecture, Checkpoint, Core, Description, Rules, Sizes, initial_weights},
    engine::{HiddenState, StepRequest, Stepper, Surrogate},
};
use problem::{Noise, Result};

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        ["check", folder] => check(&load(folder)?),
        ["time", folder] => time(&load(folder)?),
        ["growth", folder] => growth(&load(folder)?),
        ["once", folder, scenes, frames] => once(&load(folder)?, scenes.parse()?, frames.parse()?),
        _ => {
            Err("expected check FOLDER, time FOLDER, growth FOLDER or once FOLDER N FRAMES".into())
        }
    }
}

/// A checkpoint with one set of weights.
fn load(folder: &str) -> Result<Checkpoint> {
    Ok(Checkpoint::load(Path::new(folder))?.at_stiffness(1e3))
}

/// A checkpoint's network on the GPU.
fn on_gpu(checkpoint: &Checkpoint) -> Result<Surrogate> {
    let Checkpoint { description, tensors, .. } = checkpoint;
    let gpu = Gpu::new(0, &Constants::of(description)?, Precision::Fp32, None)?;
    let inference = Inference::new(Arc::new(gpu), description, tensors)?;
    Ok(Surrogate::on_device(checkpoint, Arc::new(Streams::new(inference)))?)
}

/// The same without rules.
fn without_rules(checkpoint: &Checkpoint) -> Checkpoint {
    let description = Description { rules: Rules::default(), ..checkpoint.description.clone() };
    Checkpoint { description, ..checkpoint.clone() }
}

/// The same without the rule `elastic`.
fn without_elastic(checkpoint: &Checkpoint) -> Checkpoint {
    let mut without = checkpoint.clone();
    without.description.rules.elastic = None;
    without
}

/// A network of the shipped one's widths with another core and random weights.
fn random(shipped: &Description, core: Core) -> Checkpoint {
    let sizes = Sizes { encoder: 16, hidden: 24, layers: 2, particles: None };
    let description = Description {
        core,
        normalization: shipped.normalization.clone(),
        ..Description::untrained(Architecture::Particle, core, sizes)
    };
    let mut noise = Noise(1);
    let mut tensors = initial_weights(&description, 5);
    for weight in tensors.get_mut("decoder.weight").into_iter().flat_map(|w| &mut w.values) {
        *weight = 0.1 * noise.next();
    }
    Checkpoint::new(description, tensors)
}

/// Scenes side by side, each with four blocks of 25 x 25 particles, one of each material, at rest distance. In every other scene jelly falls
/// from higher up, where nothing is close to it.
fn scenes(stream: u64, [across, up]: [usize; 2]) -> Frame {
    let mut noise = Noise(stream + 9);
    let (mut position, mut velocity, mut material) = (Vec::new(), Vec::new(), Vec::new());
    for scene in 0..across * up {
        let corner = [(scene % across) as f32, (scene / across) as f32];
        for (number, kind) in Material::ALL.into_iter().enumerate() {
            let high = if kind == Material::Jelly && scene % 2 == 1 { 0.5 } else { 0.0 };
            let (left, low) = (0.08 + 0.22 * number as f32, high + 0.1 + 0.1 * noise.next().abs());
            let speed = [0.5 * noise.next(), -1.0 + 0.5 * noise.next()];
            for k in 0..625 {
                let [x, y] = [k % 25, k / 25].map(|step| step as f32 / 128.0);
                position.push([corner[0] + left + x, corner[1] + low + y]);
                velocity.push(speed);
                material.push(kind);
            }
        }
    }
    Frame {
        stream,
        sequence: 0,
        stamp: Stamp(0),
        dt: 0.016,
        domain: Domain { lower: [0.0; 2], upper: [across as f32, up as f32] },
        position,
        velocity,
        material,
    }
}

/// One frame of every stream.
fn step(
    stepper: &mut Stepper,
    hidden: &mut [HiddenState],
    frames: &[Frame],
    next: &mut [Frame],
) -> Result<()> {
    let mut requests: Vec<_> = hidden
        .iter_mut()
        .zip(frames)
        .zip(next)
        .map(|((hidden, frame), next)| StepRequest { hidden, frame: frame.into(), next })
        .collect();
    stepper.step_all(&mut requests);
    Ok(stepper.check()?)
}

/// The streams after some frames of their own predictions.
fn roll(surrogate: &Surrogate, frames: &[Frame], count: usize) -> Result<Vec<Frame>> {
    let (mut stepper, mut frames) = (surrogate.stepper(), frames.to_vec());
    let mut hidden = start(surrogate, &frames)?;
    let mut next = frames.clone();
    for _ in 0..count {
        step(&mut stepper, &mut hidden, &frames, &mut next)?;
        std::mem::swap(&mut frames, &mut next);
    }
    Ok(frames)
}

fn start(surrogate: &Surrogate, frames: &[Frame]) -> Result<Vec<HiddenState>> {
    let states = frames.iter().map(|frame| surrogate.start(frame));
    Ok(states.collect::<std::result::Result<_, _>>()?)
}

/// The largest difference of positions and of velocities.
fn apart(a: &Frame, b: &Frame) -> [f32; 2] {
    [[&a.position, &b.position], [&a.velocity, &b.velocity]].map(|[a, b]| {
        let pairs = a.as_flattened().iter().zip(b.as_flattened());
        pairs.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    })
}

fn check(shipped: &Checkpoint) -> Result<()> {
    let cores = Core::ALL.map(|core| (core.name(), random(&shipped.description, core)));
    let all = [("shipped", shipped.clone()), ("shipped, no rules", without_rules(shipped))];
    for (name, checkpoint) in all.into_iter().chain(cores) {
        let (gpu, cpu) = (on_gpu(&checkpoint)?, Surrogate::load(&checkpoint, None)?);
        let sizes = [[1, 1], [2, 1], [3, 3]];
        let streams: Vec<_> =
            (0..64).map(|stream| scenes(stream, sizes[stream as usize % 3])).collect();
        let together = roll(&gpu, &streams, 4)?;
        let mut most = [0f32; 2];
        for (stream, expected) in streams.iter().zip(&together).take(8) {
            let stream = std::slice::from_ref(stream);
            if roll(&gpu, stream, 4)? != [expected.clone()] {
                return Err(format!("{name}: other bits alone than beside others").into());
            }
            expected.check()?; // all numbers are finite
            let [mut found] = [stream.to_vec()];
            let (mut steppers, mut states) =
                ([&gpu, &cpu].map(Surrogate::stepper), [&gpu, &cpu].map(|s| start(s, &found)));
            for _ in 0..4 {
                let mut next = [found.clone(), found.clone()];
                for side in 0..2 {
                    let hidden = states[side].as_mut().map_err(|error| error.to_string())?;
                    step(&mut steppers[side], hidden, &found, &mut next[side])?;
                }
                let [by_gpu, by_cpu] = next;
                // Larger coordinates have fewer digits, and the rules divide shifts by dt.
                let largest = found[0].domain.upper.into_iter().fold(1.0, f32::max);
                for (most, own) in most.iter_mut().zip(apart(&by_gpu[0], &by_cpu[0])) {
                    *most = most.max(own / largest);
                }
                found = by_cpu;
            }
        }
        println!(
            "{name}: positions {:.1e}, velocities {:.1e} from the processor's",
            most[0], most[1]
        );
        // The rule `elastic` makes a velocity of 4e-4 of a position's rounding, 6e-8, in elements .027 wide.
        let elastic = checkpoint.description.rules.elastic.map_or(0.0, |_| 4e-4);
        if most[0] > 4e-5 || most[1] > 4e-5 + elastic {
            return Err("more than 1e-5 a frame".into());
        }
    }
    let gpu = on_gpu(shipped)?;
    let large = [scenes(1, [20, 20])];
    if roll(&gpu, &large, 3)? != roll(&gpu, &large, 3)? {
        return Err("1,000,000 particles: other bits in a second run".into());
    }
    println!("1,000,000 particles: the same bits in two runs");
    let gpu = on_gpu(&without_rules(shipped))?;
    let mut heap = scenes(1, [1, 1]);
    heap.position.fill([0.5; 2]);
    let heap = [heap];
    let [by_gpu, by_cpu] =
        [roll(&gpu, &heap, 1)?, roll(&Surrogate::load(&without_rules(shipped), None)?, &heap, 1)?];
    let [position, velocity] = apart(&by_gpu[0], &by_cpu[0]);
    println!("2,500 particles in one place: {position:.1e}, {velocity:.1e}");
    // Sums of 2,500 particles on few nodes, in another order; a velocity has the digits of a position divided by dt.
    if position > 1e-6 || velocity > 4e-5 {
        return Err("more than 1e-6 or 4e-5".into());
    }
    Ok(())
}

/// Times of frames (microseconds), ascending, and a digest of the last prediction's bits.
struct Measured {
    times: Vec<f64>,
    digest: u64,
}

impl Measured {
    /// Of so many frames, after five, each the prediction of the last.
    fn new(gpu: &Surrogate, frames: &[Frame], count: usize) -> Result<Self> {
        let mut hidden = start(gpu, frames)?;
        let (mut stepper, mut now, mut next) = (gpu.stepper(), frames.to_vec(), frames.to_vec());
        let mut times = Vec::new();
        for number in 0..count + 5 {
            let clock = Clock::start();
            step(&mut stepper, &mut hidden, &now, &mut next)?;
            if number >= 5 {
                times.push(1e6 * clock.now().as_secs_f64());
            }
            std::mem::swap(&mut now, &mut next);
        }
        times.sort_by(f64::total_cmp);
        let mut hasher = DefaultHasher::new();
        for Frame { position, velocity, .. } in &now {
            let numbers = [position, velocity].map(|of| of.as_flattened());
            numbers.concat().iter().for_each(|number| hasher.write_u32(number.to_bits()));
        }
        Ok(Self { times, digest: hasher.finish() })
    }

    fn median(&self) -> f64 {
        self.times[self.times.len() / 2]
    }

    fn print(&self, name: &str, frames: &[Frame]) {
        let Self { times, digest } = self;
        println!(
            "{name}: {} streams of {}: {:.1} us a frame of all, 99th percentile {:.1}; last frame {digest:016x}",
            frames.len(),
            frames[0].len(),
            self.median(),
            times[times.len() * 99 / 100]
        );
    }
}

/// The checkpoint with fewer and fewer rules.
fn with_fewer_rules(shipped: &Checkpoint) -> [(&'static str, Checkpoint); 3] {
    [
        ("rules", shipped.clone()),
        ("no elastic", without_elastic(shipped)),
        ("no rules", without_rules(shipped)),
    ]
}

/// Scenes along both axes of streams of 100,000, 400,000 and 1,000,000 particles.
const LARGE: [[usize; 2]; 3] = [[8, 5], [16, 10], [20, 20]];

fn time(shipped: &Checkpoint) -> Result<()> {
    let small = [1, 8, 64].map(|count| (count, [1, 1]));
    for (name, checkpoint) in with_fewer_rules(shipped) {
        let gpu = on_gpu(&checkpoint)?;
        for (count, size) in small.into_iter().chain(LARGE.map(|size| (1, size))) {
            let frames: Vec<_> = (0..count).map(|stream| scenes(stream, size)).collect();
            let particles = frames[0].len() * frames.len();
            let count = (50_000_000 / particles).clamp(20, 1000);
            Measured::new(&gpu, &frames, count)?.print(name, &frames);
        }
    }
    Ok(())
}

fn growth(shipped: &Checkpoint) -> Result<()> {
    for (name, checkpoint) in with_fewer_rules(shipped) {
        let gpu = on_gpu(&checkpoint)?;
        let mut each = Vec::new();
        for size in LARGE {
            let frames = [scenes(0, size)];
            let measured = Measured::new(&gpu, &frames, 60)?;
            measured.print(name, &frames);
            each.push(1e3 * measured.median() / frames[0].len() as f64);
        }
        let [few, many] = [each[0], each[1]];
        if many > 2.0 * few {
            let found = format!("{many:.1} ns a particle of 400,000, {few:.1} of 100,000");
            return Err(format!("{name}: {found}, expected at most twice as much").into());
        }
    }
    Ok(())
}

fn once(shipped: &Checkpoint, scenes_across: usize, count: usize) -> Result<()> {
    let gpu = on_gpu(shipped)?;
    let frames = [scenes(1, [scenes_across; 2])];
    roll(&gpu, &frames, count)?;
    Ok(())
}
