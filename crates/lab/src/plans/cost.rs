//! Estimated costs of tasks, from measured rates. A batch system needs them for its limits; what a task took is recorded when it
//! is done.

use eddy_dataset::simulate::Planned;
use eddy_learning::train::{TrainConfig, step_benchmark::PARTICLES};
use eddy_mpm::MpmError;
use eddy_plan::Cost;

use crate::{bench::training::products, dense::DenseConfig};

/// Time per particle and substep on one thread (s): `eddy-lab bench solver`, see the page "Numbers".
const PARTICLE_UPDATE: f64 = 20e-9;
/// Multiply-adds per second and core of a training step: 263 ms for 16 windows of two frames on two cores of an AMD EPYC that other
/// programs used too (`eddy-lab bench training --step frame:mingru:2`).
const CORE_RATE: f64 = 4e9;
/// Multiply-adds per second of training on an NVIDIA GPU: each network of `eddy-lab study cores --paper` took about 55 s for at least
/// 600 steps, four at once, see the page "The paper's study".
const GPU_RATE: f64 = 9e12;
/// Memory of a process before it has data (MiB).
const PROCESS: u64 = 128;
/// Bytes of a MiB.
const MIB: u64 = 1 << 20;

/// Of scenes that are simulated one after the other, or side by side on a GPU.
pub(super) fn simulation(scenes: &[Planned], gpu: bool) -> Result<Cost, MpmError> {
    let updates: f64 = scenes.iter().map(Planned::particle_updates).sum();
    let sizes = scenes.iter().map(|planned| planned.start.scene.memory());
    let sizes: Vec<u64> = sizes.collect::<Result<_, _>>()?;
    // On a GPU, all are in memory at the same time.
    let bytes = if gpu { sizes.iter().sum() } else { sizes.into_iter().max().unwrap_or(0) };
    let memory = PROCESS + bytes.div_ceil(MIB);
    Ok(Cost { seconds: round(updates * PARTICLE_UPDATE), cores: 1, memory, gpus: gpu.into() })
}

/// Of reading and writing small files.
pub(super) fn files() -> Cost {
    Cost { seconds: 1.0, cores: 1, memory: PROCESS, gpus: 0 }
}

/// Of training a network on so many frames of data.
pub(super) fn training(config: &TrainConfig, frames: f64, gpu: bool) -> Cost {
    let unroll = config.unroll.iter().map(|stage| stage.frames).max().unwrap_or(1);
    let window = (config.windows.warm_up + unroll) as f64;
    let windows = config.windows.per_epoch as f64 * f64::from(config.epochs);
    // Forward, and twice as much for the gradients.
    let products = 3.0 * forward(config) * window * windows;
    let rate = if gpu { GPU_RATE } else { CORE_RATE * f64::from(cores()) };
    Cost {
        seconds: round(products / rate),
        cores: cores(),
        memory: data_memory(frames),
        gpus: gpu.into(),
    }
}

/// Of a learning curve of the dense network, which reads all particles of a frame and predicts those of the next.
pub(super) fn curve(config: &DenseConfig, frames: f64, gpu: bool) -> Cost {
    let (width, layers) = (config.width as f64, config.layers as f64);
    let sample = 8.0 * PARTICLES as f64 * width + layers * width * width;
    let products = sample * config.per_epoch as f64 * f64::from(config.epochs);
    let rate = if gpu { GPU_RATE } else { CORE_RATE * f64::from(cores()) };
    Cost {
        seconds: round(3.0 * products / rate),
        cores: cores(),
        memory: data_memory(frames),
        gpus: gpu.into(),
    }
}

/// Of so many predicted frames by networks of this kind.
pub(super) fn evaluation(config: &TrainConfig, predictions: f64, frames: f64, gpu: bool) -> Cost {
    let rate = if gpu { GPU_RATE } else { CORE_RATE * f64::from(cores()) };
    let seconds = round(forward(config) * predictions / rate);
    Cost { seconds, cores: cores(), memory: data_memory(frames), gpus: gpu.into() }
}

/// Of measurements that take so long.
pub(super) fn measurement(seconds: f64, gpu: bool) -> Cost {
    Cost { seconds: round(seconds), cores: cores(), memory: data_memory(0.0), gpus: gpu.into() }
}

/// Multiply-adds for a frame of the paper's network: encoder of each particle, core, decoder of four numbers per particle.
fn forward(config: &TrainConfig) -> f64 {
    let network = &config.network;
    let (encoder, hidden) = (network.encoder as f64, network.hidden as f64);
    let particles = PARTICLES as f64;
    let core = network.layers as f64 * products(config.core) * hidden * hidden;
    particles * 5.0 * encoder + encoder * hidden + core + 4.0 * particles * hidden
}

/// Cores that a task with parallel parts uses.
fn cores() -> u32 {
    2
}

/// Memory for data and a network (MiB).
fn data_memory(frames: f64) -> u64 {
    // x, y, vx, vy and the material of each particle.
    let data = frames * PARTICLES as f64 * 17.0;
    1024 + (data / MIB as f64) as u64
}

/// Two digits are more than an estimate has.
fn round(seconds: f64) -> f64 {
    let unit = 10f64.powf(seconds.max(0.01).log10().floor() - 1.0);
    ((seconds / unit).round() * unit * 1e6).round() / 1e6
}
