//! Dropout after each layer of the core, in training only.

use burn::tensor::{Tensor, TensorData};
use rand::{Rng as _, RngExt as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

/// Dropout with its own random numbers: a seed gives the same masks whatever else is computed on the device.
#[derive(Clone)]
pub(crate) struct Dropout {
    /// Share of the values set to zero, and the generator of the masks.
    training: Option<(f32, ChaCha8Rng)>,
}

impl Dropout {
    /// Leaves all values unchanged.
    pub(crate) fn none() -> Self {
        Self { training: None }
    }

    /// Sets the share `rate` of all values to zero.
    pub(crate) fn new(rate: f32, random: ChaCha8Rng) -> Self {
        Self { training: (rate > 0.0).then_some((rate, random)) }
    }

    /// An independent dropout with the same rate.
    pub(crate) fn fork(&mut self) -> Self {
        let fork = |(rate, random): &mut (f32, ChaCha8Rng)| {
            (*rate, ChaCha8Rng::seed_from_u64(random.next_u64()))
        };
        Self { training: self.training.as_mut().map(fork) }
    }

    /// The generator of the masks, if any.
    pub(crate) fn random(&self) -> Option<&ChaCha8Rng> {
        self.training.as_ref().map(|(_, random)| random)
    }

    /// The remaining values, scaled to keep their expected value.
    pub(crate) fn apply<const D: usize>(&mut self, signal: Tensor<D>) -> Tensor<D> {
        let Some((rate, random)) = &mut self.training else {
            return signal;
        };
        let kept = 1.0 / (1.0 - *rate);
        let shape = signal.dims();
        let mask: Vec<f32> = (0..shape.iter().product())
            .map(|_| if random.random::<f32>() < *rate { 0.0 } else { kept })
            .collect();
        let device = signal.device();
        signal * Tensor::from_data(TensorData::new(mask, shape), &device)
    }
}
