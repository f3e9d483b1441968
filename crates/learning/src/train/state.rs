//! The state of a run between two batches.

use std::{collections::BTreeMap, time::Duration};

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    Epoch, Outcome, TrainConfig, loss_weights::TrivialErrors, movement::Movement,
    optimizer::Optimizer, schedule, validate::Score,
};
use crate::model::{DeviceKind, dropout::Dropout, layers::Layers, network::Network};
use burn::tensor::Device;
use eddy_inference::checkpoint::{
    Checkpoint, Description, Weights, initial_weights, mix, tensors_of_knot, tensors_of_knots,
};

/// The state of a run between two batches.
#[derive(Clone)]
pub(super) struct RunState {
    /// With the weights of a step, if there are some for several stiffnesses.
    pub(super) network: Network,
    /// The weights for several stiffnesses, `[knots x tensors]`; empty if the network has the only ones.
    pub(super) of_knots: Vec<Vec<f32>>,
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

/// The weights before the first step of a run: those of the checkpoint that it starts from, or random ones; the same for all stiffnesses, if
/// they are to have weights of their own and the checkpoint has one set.
pub(super) fn weights_at_start(
    config: &TrainConfig,
    description: &Description,
    start: Option<&Checkpoint>,
) -> BTreeMap<String, Weights> {
    let [.., weights] = seeds(config);
    let (tensors, knots) = match start {
        None => (initial_weights(description, weights), 0),
        Some(start) => (start.tensors.clone(), start.description.stiffness_knots.len()),
    };
    match (knots, description.stiffness_knots.len()) {
        (0, wanted) if wanted > 0 => tensors_of_knots(&vec![tensors; wanted]),
        // A start with weights for several stiffnesses has those of the settings (`TrainConfig::check_start`).
        _ => tensors,
    }
}

/// A network, and the weights for several stiffnesses as in [`RunState::of_knots`].
pub(super) type NetworkWithKnots = (Network, Vec<Vec<f32>>);

/// The network of a run with these weights, and those for several stiffnesses, if there are some.
pub(super) fn network(
    description: &Description,
    tensors: &BTreeMap<String, Weights>,
    device: DeviceKind,
) -> NetworkWithKnots {
    let device = device.device().autodiff();
    if description.stiffness_knots.is_empty() {
        return (Network::new(description, tensors, &device), Vec::new());
    }
    let first = Network::new(description, &tensors_of_knot(tensors, 0), &device);
    let of_knots = in_order(description, tensors, &device);
    (first, of_knots)
}

/// Tensors in the order of the optimizer, those of all knots if there are several.
pub(super) fn in_order(
    description: &Description,
    tensors: &BTreeMap<String, Weights>,
    device: &Device,
) -> Vec<Vec<f32>> {
    let mut all = Vec::new();
    let mut list = |tensors: &BTreeMap<String, Weights>| {
        let mut layers = Layers::new(description, tensors, device);
        layers.exchange(|_, values| all.push(values.to_vec()));
    };
    match description.stiffness_knots.len() {
        0 => list(tensors),
        knots => (0..knots).for_each(|knot| list(&tensors_of_knot(tensors, knot))),
    }
    all
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
        let (network, of_knots) = network(description, &initial, device);
        Self {
            network,
            of_knots,
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
        self.by_name(description, |tensor| {
            let moments = self.optimizer.moments.get(tensor)?;
            Some(moments.average.as_slice()).filter(|average| !average.is_empty())
        })
    }

    /// The weights without an average, by name.
    pub(super) fn weights(&self, description: &Description) -> BTreeMap<String, Weights> {
        self.by_name(description, |_| None)
    }

    /// The weights by name, but for tensors, by number, that have other `values`.
    fn by_name<'a>(
        &'a self,
        description: &Description,
        values: impl Fn(usize) -> Option<&'a [f32]>,
    ) -> BTreeMap<String, Weights> {
        let mut layers = self.network.layers().clone();
        let tensors = layers.count();
        let mut of_knot = |knot: usize| {
            layers.exchange(|tensor, current| {
                let tensor = knot * tensors + tensor;
                let own = || self.of_knots.get(tensor).map(Vec::as_slice);
                if let Some(values) = values(tensor).or_else(own) {
                    current.copy_from_slice(values);
                }
            });
            layers.tensors(description)
        };
        match description.stiffness_knots.len() {
            0 => of_knot(0),
            knots => tensors_of_knots(&(0..knots).map(of_knot).collect::<Vec<_>>()),
        }
    }

    /// The weights without an average, in the order of the optimizer.
    #[cfg(feature = "cuda")]
    pub(super) fn in_order(&self) -> Vec<Vec<f32>> {
        if !self.of_knots.is_empty() {
            return self.of_knots.clone();
        }
        let mut all = Vec::new();
        self.network.layers().clone().exchange(|_, values| all.push(values.to_vec()));
        all
    }

    /// Replaces the weights by those of a list of all tensors.
    #[cfg(feature = "cuda")]
    pub(super) fn set_weights(&mut self, weights: Vec<Vec<f32>>) {
        if self.of_knots.is_empty() {
            let layers = self.network.layers_mut();
            layers.exchange(|tensor, values| values.copy_from_slice(&weights[tensor]));
        } else {
            self.of_knots = weights;
        }
    }

    /// Gives the network the weights between those of the knots, if there are several.
    pub(super) fn mix(&mut self, shares: &[f32]) {
        if self.of_knots.is_empty() {
            return;
        }
        let Self { network, of_knots, .. } = self;
        let layers = network.layers_mut();
        let tensors = layers.count();
        layers.exchange(|tensor, values| {
            let of_knots = of_knots.iter().skip(tensor).step_by(tensors);
            mix(values, of_knots.map(Vec::as_slice), shares);
        });
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
        schedule::in_last_stage(config, epoch) && self.since_best >= config.patience
    }

    /// Appends an epoch with the means of its batches and the results of its validation.
    pub(super) fn end_epoch(
        &mut self,
        training_loss: f64,
        learning_rate: f64,
        score: &Score,
        movement: &Movement,
    ) -> Epoch {
        let epoch = Epoch {
            epoch: self.epoch() + 1,
            samples: self.samples,
            unroll: self.unroll,
            training_loss,
            validation_loss: score.loss,
            first_skill: score.first_skill,
            last_skill: score.last_skill,
            learning_rate,
            weight_distance: movement.distance,
            epsilon_share: movement.epsilon_share,
            best: self.best_loss().is_none_or(|best| score.loss < best),
        };
        self.epochs.push(epoch);
        self.since_best = if epoch.best { 0 } else { self.since_best + 1 };
        epoch
    }

    /// The outcome of a run that ends after so much time in this process.
    pub(super) fn outcome(self, interrupted: bool, elapsed: Duration) -> Outcome {
        let Self { epochs, best, seconds, samples, .. } = self;
        Outcome { epochs, best, interrupted, seconds: seconds + elapsed.as_secs_f64(), samples }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use eddy_inference::checkpoint::Architecture;

    #[test]
    fn one_set_of_weights_is_the_start_of_those_of_every_stiffness() {
        let config = TrainConfig::defaults(Architecture::Particle);
        let start = Checkpoint::shipped().unwrap();
        let mut description = start.description.clone();
        description.stiffness_knots = vec![1e3, 1e4, 1e5];
        let all = weights_at_start(&config, &description, Some(&start));
        for knot in 0..3 {
            assert_eq!(tensors_of_knot(&all, knot), start.tensors);
        }
        let several = Checkpoint::new(description.clone(), all.clone());
        assert_eq!(weights_at_start(&config, &description, Some(&several)), all);
        let random = weights_at_start(&config, &description, None);
        assert_eq!(tensors_of_knot(&random, 0), tensors_of_knot(&random, 2));
    }
}
