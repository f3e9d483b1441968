//! Everything a run carries from batch to batch.

use std::collections::BTreeMap;

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    Epoch, TrainConfig,
    adam::{Adam, Moments},
    schedule,
    weigh::TrivialErrors,
};
use crate::model::{
    DeviceKind,
    network::{Dropout, Network},
};
use eddy_inference::checkpoint::{Checkpoint, Description, Weights, initial_weights};

/// A run between two batches.
pub(super) struct State {
    pub(super) network: Network,
    pub(super) adam: Adam,
    /// Which windows come next.
    pub(super) order: ChaCha8Rng,
    pub(super) dropout: Dropout,
    /// Free frames a window in the stage at hand; 0 before the first.
    pub(super) unroll: usize,
    /// Trivial errors over many windows of that length.
    pub(super) common: TrivialErrors,
    /// Windows seen.
    pub(super) samples: u64,
    /// Epochs done.
    pub(super) epochs: Vec<Epoch>,
    /// The checkpoint with the smallest validation loss.
    pub(super) best: Option<Checkpoint>,
    /// Epochs since then.
    pub(super) since_best: u32,
    /// Time spent on it (s), by earlier processes.
    pub(super) seconds: f64,
}

impl State {
    /// Before the first batch.
    pub(super) fn new(config: &TrainConfig, description: &Description, device: DeviceKind) -> Self {
        let mut seeds = ChaCha8Rng::seed_from_u64(config.seed);
        let order = ChaCha8Rng::seed_from_u64(seeds.next_u64());
        let dropout = ChaCha8Rng::seed_from_u64(seeds.next_u64());
        let initial = initial_weights(description, seeds.next_u64());
        Self {
            network: Network::new(description, &initial, &device.device().autodiff()),
            adam: Adam::default(),
            order,
            dropout: Dropout::new(config.network.dropout, dropout),
            unroll: 0,
            common: Vec::new(),
            samples: 0,
            epochs: Vec::new(),
            best: None,
            since_best: 0,
            seconds: 0.0,
        }
    }

    /// What is judged and saved, by name: the average of the weights where there is one.
    pub(super) fn tensors(&self, description: &Description) -> BTreeMap<String, Weights> {
        let mut layers = self.network.layers().clone();
        layers.exchange(|tensor, values| match self.adam.moments.get(tensor) {
            Some(Moments { average, .. }) if !average.is_empty() => values.copy_from_slice(average),
            _ => {}
        });
        layers.tensors(description)
    }

    /// The epochs done.
    pub(super) fn epoch(&self) -> u32 {
        self.epochs.len() as u32
    }

    /// The smallest validation loss so far.
    pub(super) fn best_loss(&self) -> Option<f64> {
        Some(self.epochs.iter().rfind(|epoch| epoch.best)?.validation_loss)
    }

    /// Whether all epochs are done, or validation has not become better for too long.
    pub(super) fn is_over(&self, config: &TrainConfig) -> bool {
        let epoch = self.epoch();
        if epoch == 0 || epoch >= config.epochs {
            return epoch >= config.epochs;
        }
        let progress = schedule::progress(config, epoch, config.batches());
        let last_stage = schedule::stage(&config.unroll, progress) + 1 == config.unroll.len();
        last_stage && self.since_best >= config.patience
    }
}
