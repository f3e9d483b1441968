//! The state of a run between two batches.

use std::collections::BTreeMap;

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    Epoch, TrainConfig,
    loss_weights::TrivialErrors,
    optimizer::{Moments, Optimizer},
    schedule,
};
use crate::model::{DeviceKind, dropout::Dropout, network::Network};
use eddy_inference::checkpoint::{Checkpoint, Description, Weights, initial_weights};

/// The state of a run between two batches.
pub(super) struct RunState {
    pub(super) network: Network,
    pub(super) optimizer: Optimizer,
    /// Draws the windows.
    pub(super) order: ChaCha8Rng,
    pub(super) dropout: Dropout,
    /// Freely predicted frames per window in the current stage; 0 before the first.
    pub(super) unroll: usize,
    /// Errors of the best trivial predictor over many windows of that length.
    pub(super) common: TrivialErrors,
    /// Training windows.
    pub(super) samples: u64,
    /// Completed epochs.
    pub(super) epochs: Vec<Epoch>,
    /// The checkpoint with the smallest validation loss.
    pub(super) best: Option<Checkpoint>,
    /// Epochs since the best one.
    pub(super) since_best: u32,
    /// Training time in earlier processes (s).
    pub(super) seconds: f64,
}

/// Seeds of the order of the windows, of dropout and of the initial weights.
fn seeds(config: &TrainConfig) -> [u64; 3] {
    let mut seeds = ChaCha8Rng::seed_from_u64(config.seed);
    [(); 3].map(|()| seeds.next_u64())
}

/// The weights before the first step of a run: those of the checkpoint that it starts from, or random ones.
pub(super) fn weights_at_start(
    config: &TrainConfig,
    description: &Description,
    start: Option<&Checkpoint>,
) -> BTreeMap<String, Weights> {
    let [.., weights] = seeds(config);
    start.map_or_else(|| initial_weights(description, weights), |start| start.tensors.clone())
}

impl RunState {
    /// The state before the first batch.
    pub(super) fn new(
        config: &TrainConfig,
        description: &Description,
        start: Option<&Checkpoint>,
        device: DeviceKind,
    ) -> Self {
        let [order, dropout, _] = seeds(config);
        let initial = weights_at_start(config, description, start);
        let [order, dropout] = [order, dropout].map(ChaCha8Rng::seed_from_u64);
        Self {
            network: Network::new(description, &initial, &device.device().autodiff()),
            optimizer: Optimizer::new(config, description),
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

    /// The weights to validate and save, by name: their running average, if there is one.
    pub(super) fn tensors(&self, description: &Description) -> BTreeMap<String, Weights> {
        let mut layers = self.network.layers().clone();
        layers.exchange(|tensor, values| match self.optimizer.moments.get(tensor) {
            Some(Moments { average, .. }) if !average.is_empty() => values.copy_from_slice(average),
            _ => {}
        });
        layers.tensors(description)
    }

    /// Number of completed epochs.
    pub(super) fn epoch(&self) -> u32 {
        self.epochs.len() as u32
    }

    /// The smallest validation loss so far.
    pub(super) fn best_loss(&self) -> Option<f64> {
        Some(self.epochs.iter().rfind(|epoch| epoch.best)?.validation_loss)
    }

    /// Whether all epochs are done, or the validation loss has not improved for too long.
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
