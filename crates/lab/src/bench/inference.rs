//! Time per predicted frame of one stream.

use std::num::NonZeroUsize;

use serde::Serialize;

use super::particles::frame_for;
use eddy_frames::{Frame, clock::Clock};
use eddy_inference::{
    checkpoint::{
        Architecture, Checkpoint, CheckpointError, Core, Description, Sizes, initial_weights,
    },
    engine::{ModelError, Surrogate},
};
use eddy_learning::model::{DeviceKind, Reference};

/// Untimed warm-up frames.
const WARM_UP: usize = 5;
/// Minimum number of timed frames, for the 99th percentile.
const MIN_SAMPLES: usize = 100;

/// A network and an observed frame.
pub struct Case {
    /// The network.
    pub checkpoint: Checkpoint,
    frame: Frame,
}

/// Implementation of the network.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Engine {
    /// The streaming [`engine`](eddy_inference::engine) on a number of threads.
    Own(NonZeroUsize),
    /// The burn implementation used for training.
    Burn(DeviceKind),
}

/// Time per frame.
#[derive(Clone, Debug, Serialize)]
pub struct Timing {
    /// Architecture: `frame` or `particle`.
    pub architecture: Architecture,
    /// Its core.
    pub core: Core,
    /// Particles of a frame.
    pub particles: usize,
    /// Size of its weights (bytes).
    pub weights: usize,
    /// `engine`, or burn's device: `flex` or `ndarray`.
    pub engine: String,
    /// Threads of the engine; `None` for burn, which uses all.
    pub threads: Option<usize>,
    /// Median time per frame (ms).
    pub p50: f64,
    /// 99th percentile (ms).
    pub p99: f64,
    /// Frames timed.
    pub frames: usize,
}

/// Stiffness of streams for a network that is conditioned on it; times do not depend on it.
const STIFFNESS: f32 = 1e3;

/// [`STIFFNESS`], if this network is conditioned on it.
pub(super) fn stiffness(description: &Description) -> Option<f32> {
    description.stiffness.then_some(STIFFNESS)
}

impl Case {
    /// The paper's frame model with initial weights.
    pub fn frame(core: Core, particles: usize) -> Self {
        let sizes = Sizes { encoder: 256, hidden: 1250, layers: 2, particles: Some(particles) };
        let description = Description::untrained(Architecture::Frame, core, sizes);
        let frame = frame_for(&description, particles);
        Self {
            checkpoint: Checkpoint::new(description.clone(), initial_weights(&description, 1)),
            frame,
        }
    }

    /// The shipped particle model.
    ///
    /// # Errors
    /// As [`Checkpoint::shipped`].
    pub fn shipped(particles: usize) -> Result<Self, CheckpointError> {
        // With one set of weights, as a frame reads.
        let checkpoint = Checkpoint::shipped()?.at_stiffness(STIFFNESS);
        let frame = frame_for(&checkpoint.description, particles);
        Ok(Self { checkpoint, frame })
    }

    /// Size of the weights (bytes), which are read once per frame.
    pub fn weights(&self) -> usize {
        self.checkpoint.parameters() * size_of::<f32>()
    }

    /// Times frames for about `seconds`, at least a hundred.
    ///
    /// # Errors
    /// [`ModelError`] when the network does not support the frame.
    pub fn time(&self, engine: Engine, seconds: f64) -> Result<Timing, ModelError> {
        let stiffness = stiffness(&self.checkpoint.description);
        let times = match engine {
            Engine::Own(threads) => {
                let surrogate = Surrogate::load(&self.checkpoint, Some(threads))?;
                let (mut stepper, mut memory) =
                    (surrogate.stepper(), surrogate.start_with_stiffness(&self.frame, stiffness)?);
                let mut next = self.frame.clone();
                time(seconds, || stepper.step_into(&mut memory, &self.frame, &mut next))
            }
            Engine::Burn(device) => {
                let reference = Reference::load(&self.checkpoint, device)?;
                let mut memory = reference.start(&self.frame, stiffness);
                time(seconds, || {
                    reference.step(&mut memory, &self.frame);
                })
            }
        };
        let Description { architecture, core, .. } = self.checkpoint.description;
        Ok(Timing {
            architecture,
            core,
            particles: self.frame.len(),
            weights: self.weights(),
            engine: match engine {
                Engine::Own(_) => "engine".to_owned(),
                Engine::Burn(device) => device.name().to_owned(),
            },
            threads: match engine {
                Engine::Own(threads) => Some(threads.get()),
                Engine::Burn(_) => None,
            },
            p50: 1e3 * times[times.len() / 2],
            p99: 1e3 * times[(times.len() * 99).div_ceil(100) - 1],
            frames: times.len(),
        })
    }
}

/// Times of steps (s), ascending.
fn time(seconds: f64, mut step: impl FnMut()) -> Vec<f64> {
    for _ in 0..WARM_UP {
        step();
    }
    let total = Clock::start();
    let mut times = Vec::new();
    while times.len() < MIN_SAMPLES || total.now().as_secs_f64() < seconds {
        let clock = Clock::start();
        step();
        times.push(clock.now().as_secs_f64());
    }
    times.sort_by(f64::total_cmp);
    times
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_learning::train::step_benchmark::PARTICLES;

    #[test]
    fn both_networks_are_timed_with_all_implementations() {
        let cases = [Case::shipped(50).unwrap(), Case::frame(Core::MinGru, 10)];
        for case in cases {
            for engine in [Engine::Own(NonZeroUsize::MIN), Engine::Burn(DeviceKind::Flex)] {
                let timing = case.time(engine, 0.0).unwrap();
                assert!(0.0 < timing.p50 && timing.p50 <= timing.p99, "{timing:?}");
                assert_eq!(timing.frames, MIN_SAMPLES);
            }
        }
    }

    #[test]
    fn the_timed_networks_are_the_papers() {
        // Millions of parameters, with PyTorch's two biases in GRU and LSTM.
        let cores = [Core::MinGru, Core::MinLstm, Core::Gru, Core::Lstm];
        for (core, expected) in cores.into_iter().zip([14.40, 17.52, 26.91, 33.16]) {
            let found = Case::frame(core, PARTICLES).checkpoint.parameters() as f64 * 1e-6;
            assert!((found - expected).abs() < 0.01, "{core:?}: {found}");
        }
    }
}
