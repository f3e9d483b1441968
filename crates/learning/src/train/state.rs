//! The state of a run between two batches.

use std::{collections::BTreeMap, sync::Arc, time::Duration};

use rand::{Rng as _, SeedableRng as _};
use rand_chacha::ChaCha8Rng;

use super::{
    Epoch, Outcome, TrainConfig, loss_weights::TrivialErrors, movement::Movement,
    optimizer::Optimizer, schedule, validate::Score,
};
use crate::model::dropout::Dropout;
use eddy_inference::checkpoint::{
    Checkpoint, Description, Weights, initial_weights, layout::particle_features, mix, plan::Plan,
    tensors_of_knot, tensors_of_knots,
};

/// The state of a run between two batches.
#[derive(Clone)]
pub(super) struct RunState {
    /// The weights, [`in_order`].
    pub(super) weights: Arc<Vec<Vec<f32>>>,
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
/// they are to have weights of their own and the checkpoint has one set, and 0 for materials and the stiffness that the checkpoint does not know.
pub(super) fn weights_at_start(
    config: &TrainConfig,
    description: &Description,
    start: Option<&Checkpoint>,
) -> BTreeMap<String, Weights> {
    let [.., weights] = seeds(config);
    let (mut tensors, knots) = match start {
        None => (initial_weights(description, weights), 0),
        Some(start) => (start.tensors.clone(), start.description.stiffness_knots.len()),
    };
    let new = start.map_or(Vec::new(), |start| new_inputs(&start.description, description));
    for layer in Plan::new(description).layers {
        if let Some(matrix) = tensors.get_mut(&layer.weight)
            && matrix.shape.last().is_some_and(|&width| width < layer.input)
        {
            new.iter().for_each(|&place| add_input(matrix, place));
        }
    }
    match (knots, description.stiffness_knots.len()) {
        (0, wanted) if wanted > 0 => tensors_of_knots(&vec![tensors; wanted]),
        // A start with weights for several stiffnesses has those of the settings (`TrainConfig::check_start`).
        _ => tensors,
    }
}

/// The features of a particle that a network has and the one that it starts from has not, from the first on.
fn new_inputs(start: &Description, description: &Description) -> Vec<usize> {
    // Before the materials stands what every network has; the stiffness stands last.
    let [first, end] = [start, description]
        .map(|network| particle_features(network) - usize::from(network.stiffness));
    let stiffness = (start.stiffness != description.stiffness).then_some(end);
    (first..end).chain(stiffness).collect()
}

/// Inserts a column of zeros into matrices `[.., output, input]`.
fn add_input(matrix: &mut Weights, place: usize) {
    let Some(columns) = matrix.shape.last_mut() else { return };
    let row = |row: &[f32]| [&row[..place], &[0.0], &row[place..]].concat();
    matrix.values = matrix.values.chunks(*columns).flat_map(row).collect();
    *columns += 1;
}

/// Weights in the order of the optimizer: that of the plan, those of each knot one after the other if there are several.
pub(super) fn in_order(
    description: &Description,
    tensors: &BTreeMap<String, Weights>,
) -> Vec<Vec<f32>> {
    let plan = Plan::new(description);
    match description.stiffness_knots.len() {
        0 => plan.in_order(tensors),
        knots => {
            (0..knots).flat_map(|knot| plan.in_order(&tensors_of_knot(tensors, knot))).collect()
        }
    }
}

/// The inverse of [`in_order`].
pub(super) fn by_name<W: AsRef<[f32]>>(
    description: &Description,
    weights: &[W],
) -> BTreeMap<String, Weights> {
    let plan = Plan::new(description);
    let mut sets: Vec<_> =
        weights.chunks(2 * plan.layers.len()).map(|set| plan.by_name(set)).collect();
    match description.stiffness_knots.len() {
        0 => sets.remove(0),
        _ => tensors_of_knots(&sets),
    }
}

impl RunState {
    /// The state before the first batch.
    pub(super) fn new(
        config: &TrainConfig,
        description: &Description,
        start: Option<&Checkpoint>,
    ) -> Self {
        let [order, dropout, _] = seeds(config);
        let initial = weights_at_start(config, description, start);
        let [order, dropout] = [order, dropout].map(ChaCha8Rng::seed_from_u64);
        Self {
            weights: in_order(description, &initial).into(),
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
        let average = |tensor: usize| {
            let moments = self.optimizer.moments.get(tensor)?;
            Some(&moments.average).filter(|average| !average.is_empty())
        };
        let weights = self.weights.iter().enumerate();
        let weights = weights.map(|(tensor, own)| average(tensor).unwrap_or(own));
        by_name(description, &weights.collect::<Vec<_>>())
    }

    /// The weights of a step: the mean of those of the knots, if there are several, with these shares.
    pub(super) fn weights_of_step(&self, knots: &[f32], shares: &[f32]) -> Arc<Vec<Vec<f32>>> {
        if knots.is_empty() {
            return Arc::clone(&self.weights);
        }
        let tensors = self.weights.len() / knots.len();
        let mixed = (0..tensors).map(|tensor| {
            let mut values = vec![0.0; self.weights[tensor].len()];
            let of_knots = self.weights.iter().skip(tensor).step_by(tensors);
            mix(&mut values, of_knots.map(Vec::as_slice), shares);
            values
        });
        Arc::new(mixed.collect())
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
    use eddy_frames::{Domain, Frame, Material, Stamp};
    use eddy_inference::{
        checkpoint::{Architecture, Core, Sizes},
        engine::Surrogate,
    };

    fn frame() -> Frame {
        let place = |k: usize| [0.4 + 0.008 * (k % 5) as f32, 0.1 + 0.009 * (k / 5) as f32];
        Frame {
            stream: 0,
            sequence: 0,
            stamp: Stamp(0),
            dt: 0.016,
            domain: Domain::UNIT,
            position: (0..20).map(place).collect(),
            velocity: (0..20).map(|k| [0.1 * k as f32, -0.5]).collect(),
            material: vec![Material::Snow; 20],
        }
    }

    /// The velocities after two frames; `stiffness` for a network that is conditioned on it.
    fn predicted(checkpoint: &Checkpoint, stiffness: Option<f32>) -> Vec<[f32; 2]> {
        let surrogate = Surrogate::load(checkpoint, None).unwrap();
        let mut frame = frame();
        let mut hidden = surrogate.start_with_stiffness(&frame, stiffness).unwrap();
        for _ in 0..2 {
            let state = surrogate.stepper().step(&mut hidden, &frame);
            (frame.position, frame.velocity) = (state.position, state.velocity);
        }
        frame.velocity
    }

    #[test]
    fn a_network_that_learns_of_the_stiffness_begins_as_the_one_without() {
        let sizes = Sizes { encoder: 5, hidden: 6, layers: 1, particles: None };
        let plain = Description::untrained(Architecture::Particle, Core::MinGru, sizes);
        let mut tensors = initial_weights(&plain, 7);
        // A decoder of zeros would hide everything.
        let decoder = &mut tensors.get_mut("decoder.weight").unwrap().values;
        decoder.iter_mut().enumerate().for_each(|(k, weight)| *weight = 0.1 * (k % 7) as f32);
        let start = Checkpoint::new(plain.clone(), tensors);
        let expected = predicted(&start, None);
        assert_ne!(expected, frame().velocity, "the network says something");
        for knots in [vec![], vec![1e3, 1e5]] {
            let mut config = TrainConfig::defaults(Architecture::Particle);
            config.network = config.network.with_layers_of(&plain);
            (config.network.stiffness, config.network.stiffness_knots) = (true, knots.clone());
            config.check_start(&plain).unwrap();
            let description =
                Description { stiffness: true, stiffness_knots: knots, ..plain.clone() };
            let tensors = weights_at_start(&config, &description, Some(&start));
            let checkpoint = Checkpoint::new(description, tensors);
            for stiffness in [1e3, 2e4] {
                let found = predicted(&checkpoint, Some(stiffness));
                for (found, expected) in found.as_flattened().iter().zip(expected.as_flattened()) {
                    assert!((found - expected).abs() < 1e-5, "{stiffness}: {found}, {expected}");
                }
            }
        }
    }

    #[test]
    fn a_network_that_learns_of_sand_begins_as_the_one_without() {
        let start = Checkpoint::shipped().unwrap();
        let config = TrainConfig::defaults(Architecture::Particle);
        let description = Description { material_inputs: 5, ..start.description.clone() };
        let tensors = weights_at_start(&config, &description, Some(&start));
        for stiffness in [1e3, 1e4] {
            let expected = predicted(&start, Some(stiffness));
            let checkpoint = Checkpoint::new(description.clone(), tensors.clone());
            let found = predicted(&checkpoint, Some(stiffness));
            for (found, expected) in found.as_flattened().iter().zip(expected.as_flattened()) {
                assert!((found - expected).abs() < 1e-5, "{stiffness}: {found}, {expected}");
            }
        }
    }

    #[test]
    fn one_set_of_weights_is_the_start_of_those_of_every_stiffness() {
        let config = TrainConfig::defaults(Architecture::Particle);
        let start = Checkpoint::shipped().unwrap().at_stiffness(1e3);
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
