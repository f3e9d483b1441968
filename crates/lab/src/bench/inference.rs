//! How long the prediction of a frame takes, one stream, one frame after the other.

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

/// Frames before the clock starts.
const WARM_UP: usize = 5;
/// Fewest frames that are timed, for the 99th percentile to be one.
const FEWEST: usize = 100;

/// A network with a frame to observe.
pub struct Case {
    /// The network.
    pub checkpoint: Checkpoint,
    frame: Frame,
}

/// What predicts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Engine {
    /// [`engine`](eddy_inference::engine) on so many threads: what streams.
    Own(NonZeroUsize),
    /// The network as it is trained, in burn.
    Burn(DeviceKind),
}

/// The time of a frame.
#[derive(Clone, Debug, Serialize)]
pub struct Timing {
    /// Which network: `frame` or `particle`.
    pub architecture: Architecture,
    /// Its core.
    pub core: Core,
    /// Particles of a frame.
    pub particles: usize,
    /// Bytes of its weights.
    pub weights: usize,
    /// What predicts: `engine`, or burn's device, `flex` or `ndarray`.
    pub engine: String,
    /// Threads of the engine; burn takes what there is.
    pub threads: Option<usize>,
    /// Median time of a frame (ms).
    pub p50: f64,
    /// 99th percentile of it (ms).
    pub p99: f64,
    /// Frames timed.
    pub frames: usize,
}

impl Case {
    /// The paper's frame model for so many particles, with initial weights.
    pub fn frame(core: Core, particles: usize) -> Self {
        let sizes = Sizes { encoder: 256, hidden: 1250, layers: 2, particles: Some(particles) };
        let description = Description::untrained(Architecture::Frame, core, sizes);
        let frame = frame_for(&description, particles);
        Self {
            checkpoint: Checkpoint { tensors: initial_weights(&description, 1), description },
            frame,
        }
    }

    /// The shipped particle model, on so many particles.
    ///
    /// # Errors
    /// As [`Checkpoint::shipped`].
    pub fn shipped(particles: usize) -> Result<Self, CheckpointError> {
        let checkpoint = Checkpoint::shipped()?;
        let frame = frame_for(&checkpoint.description, particles);
        Ok(Self { checkpoint, frame })
    }

    /// Bytes of the weights; each is read once a frame.
    pub fn weights(&self) -> usize {
        self.checkpoint.parameters() * size_of::<f32>()
    }

    /// Times frames for about so long (s), a hundred at least.
    ///
    /// # Errors
    /// [`ModelError`] when the network cannot take the frame.
    pub fn time(&self, engine: Engine, seconds: f64) -> Result<Timing, ModelError> {
        let times = match engine {
            Engine::Own(threads) => {
                let surrogate = Surrogate::load(&self.checkpoint, Some(threads))?;
                let (mut stepper, mut memory) =
                    (surrogate.stepper(), surrogate.start(&self.frame)?);
                let mut next = self.frame.clone();
                time(seconds, || stepper.step_into(&mut memory, &self.frame, &mut next))
            }
            Engine::Burn(device) => {
                let reference = Reference::load(&self.checkpoint, device)?;
                let mut memory = reference.start(&self.frame);
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

/// The time of each step (s), the shortest first.
fn time(seconds: f64, mut step: impl FnMut()) -> Vec<f64> {
    for _ in 0..WARM_UP {
        step();
    }
    let total = Clock::start();
    let mut times = Vec::new();
    while times.len() < FEWEST || total.now().as_secs_f64() < seconds {
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
    fn both_networks_are_timed_by_everything_that_predicts() {
        let cases = [Case::shipped(50).unwrap(), Case::frame(Core::MinGru, 10)];
        for case in cases {
            for engine in [Engine::Own(NonZeroUsize::MIN), Engine::Burn(DeviceKind::Flex)] {
                let timing = case.time(engine, 0.0).unwrap();
                assert!(0.0 < timing.p50 && timing.p50 <= timing.p99, "{timing:?}");
                assert_eq!(timing.frames, FEWEST);
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
