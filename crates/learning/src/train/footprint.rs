//! The memory and disk space that a run needs, estimated before it starts: a lower bound, so that a rejected run would
//! certainly have failed.

use super::{Machine, Run, TrainConfig, TrainError};
use crate::model::DeviceKind;
use eddy_inference::checkpoint::{
    Architecture, Description, Pooling, layout::particle_features, tensor_shapes,
};

/// Numbers of a particle's state: x, y, vx, vy.
const STATE: usize = 4;
/// Size of a value (bytes).
const NUMBER: usize = 4;

/// Copies of the weights in memory: network, gradient, the optimizer's two moments, best checkpoint. At the end of an epoch, the
/// gradient is replaced by the new checkpoint, its network for validation, and its serialised bytes.
const IN_TRAINING: usize = 5;
const IN_VALIDATION: usize = 7;

/// Copies of the weights on disk: the best checkpoint, the last one with the moments, and its successor before the last one is
/// deleted. In a resumed run, all but the successor exist already.
const ON_DISK: usize = 7;
const ON_DISK_RESUMED: usize = 3;

/// Rejects a run that exceeds the available resources. `particles` is the smallest number of particles of a stream.
pub(super) fn check(
    config: &TrainConfig,
    description: &Description,
    particles: usize,
    run: &Run,
) -> Result<(), TrainError> {
    let Machine { memory: free, disk: found } = run.machine;
    let numbers: usize =
        tensor_shapes(description).values().map(|shape| shape.iter().product::<usize>()).sum();
    let bytes = |numbers: usize| (numbers as u64).saturating_mul(NUMBER as u64);
    // On an NVIDIA GPU, the batch is in the memory of the GPU.
    let here = !run.device.is_cuda();
    // eddy's kernels take the mean of the encoder's points without keeping them.
    let keeps_points = run.device != DeviceKind::Flex || description.frame.pooling != Pooling::Mean;
    // Gradients of its lists are freed on the way back.
    let kept = if run.device == DeviceKind::Flex { 1 } else { 2 };
    let numbers_of_batch = || batch_numbers(config, description, particles, keeps_points, kept);
    let batch = if here { bytes(numbers_of_batch()) } else { 0 };
    // Of weights for several stiffnesses, network and gradient have one set, but all sets are kept beside.
    let in_training = match description.stiffness_knots.len() {
        0 => IN_TRAINING * numbers,
        knots => (IN_TRAINING - 1) * numbers + 2 * (numbers / knots),
    };
    let (training, validation) = (bytes(in_training), bytes(IN_VALIDATION * numbers));
    let batch = if training.saturating_add(batch) < validation { 0 } else { batch };
    let weights = if batch == 0 { validation } else { training };
    if weights.saturating_add(batch) > free {
        return Err(TrainError::Memory { weights, batch, free });
    }
    let copies = if run.resumes() { ON_DISK_RESUMED } else { ON_DISK };
    let expected = bytes(copies * numbers);
    if found < expected {
        return Err(TrainError::Disk { output: run.output.to_owned(), found, expected });
    }
    Ok(())
}

/// The windows of a batch, and the output of every layer `kept` times: alone, or with its gradient; of the frame model's points, if
/// they are not kept, the inputs.
fn batch_numbers(
    config: &TrainConfig,
    description: &Description,
    particles: usize,
    keeps_points: bool,
    kept: usize,
) -> usize {
    let sizes = &description.sizes;
    let (encoder, hidden) = (sizes.encoder, sizes.hidden);
    let gates: usize = tensor_shapes(description)
        .iter()
        .filter(|(name, _)| name.starts_with("core.") && name.contains("bias"))
        .filter_map(|(_, shape)| shape.last())
        .sum();
    let unroll = config.unroll.iter().map(|stage| stage.frames).max().unwrap_or(1);
    let frames = config.windows.warm_up + unroll;
    let batch = config.windows.batch;
    // Values per frame: per particle and per window.
    let (particles, of_particle, of_window) = match description.architecture {
        Architecture::Frame => {
            let pooled = match description.frame.pooling {
                Pooling::Mean => 0,
                Pooling::Max | Pooling::MeanMax => hidden,
            };
            let points = if keeps_points { encoder } else { STATE };
            (particles, points + pooled, 2 * hidden + gates + 2 * particles)
        }
        // Without nodes: there are fewer than particles.
        Architecture::Particle => {
            let features = particle_features(description);
            (particles, features + encoder + 2 * hidden + gates, 0)
        }
    };
    let window = 2 * 4 * particles; // truth and weights of x, y, vx, vy
    // Of truth and prediction: a map, and the two factors of which it is the product.
    let grid = config.loss.density_grid;
    let maps = if config.loss.density_weight > 0.0 { 2 * grid * (grid + 2 * particles) } else { 0 };
    let computed = kept * (particles * of_particle + of_window);
    batch.saturating_mul(frames).saturating_mul(window + computed + maps)
}
