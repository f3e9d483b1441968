//! Dropout after each layer of the core, in training only.

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

    /// The factors of the next `layers` outputs of `count` numbers each: zero, or what keeps their expected value; none if there is
    /// no dropout.
    pub(crate) fn masks(&mut self, layers: usize, count: usize) -> Vec<Vec<f32>> {
        let Some((rate, random)) = &mut self.training else { return Vec::new() };
        let kept = 1.0 / (1.0 - *rate);
        let mut factor = || if random.random::<f32>() < *rate { 0.0 } else { kept };
        (0..layers).map(|_| (0..count).map(|_| factor()).collect()).collect()
    }
}
