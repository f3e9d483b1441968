//! The particle model: one hidden state per particle, shared weights, any number of particles.
//!
//! features (F) -> Linear -> ReLU -> Linear (C0) -> grid -> gathered (C0);
//! features, gathered -> Linear -> ReLU -> recurrent layers (H) -> mixer -> ReLU -> decoder (4).
//! The decoder gives a velocity and a position residual on the ballistic step ([`ResidualStep`]); a zero decoder gives that step.

use burn::tensor::{Device, Tensor};

use super::{
    ballistic::BallisticTensors,
    dropout::Dropout,
    features::Scaling,
    fused, fused_layers,
    grid_context::GridContext,
    layers::Layers,
    state::{ParticleState, RecurrentState, StaticInputs, TrajectoryBatch, pairs},
    strain,
};
use eddy_frames::Domain;
use eddy_inference::{
    checkpoint::{Description, GridOptions},
    engine::Ballistic,
    ops::decoder::ResidualStep,
};

/// The particle model with its normalisation.
#[derive(Clone, Debug)]
pub(crate) struct ParticleModel {
    pub(crate) layers: Layers,
    grid: GridOptions,
    domain: Domain,
    scaling: Scaling,
    ballistic: BallisticTensors,
    residual: ResidualStep,
}

impl ParticleModel {
    pub(crate) fn new(description: &Description, layers: Layers, device: &Device) -> Self {
        let scale = &description.normalization;
        let grid = description.grid.clone();
        Self {
            layers,
            grid: grid.expect("checked descriptions of particle models have one"),
            domain: description.domain,
            scaling: Scaling::new(scale, device),
            ballistic: BallisticTensors::new(Ballistic::new(description), device),
            residual: ResidualStep::new(description),
        }
    }

    /// As [`Network::observe`](super::network::Network::observe).
    pub(crate) fn observe(
        &self,
        trajectory: &TrajectoryBatch,
        fixed: &StaticInputs,
        hidden: RecurrentState,
        dropout: &mut Dropout,
    ) -> (TrajectoryBatch, RecurrentState) {
        let [frames, rows, _] = trajectory.position.dims();
        let flat = |t: &Tensor<3>| t.clone().reshape([frames * rows, 2]);
        let state = ParticleState {
            position: flat(&trajectory.position),
            velocity: flat(&trajectory.velocity),
        };

        // Each frame's velocities are compared with those expected one frame earlier, the first frame's with themselves.
        let coming = self.expected_velocities(&state); // [T R, 2]
        let first = hidden.expected_velocity.clone().unwrap_or_else(|| trajectory.at(0).velocity);
        let before = coming.clone().slice([0..(frames - 1) * rows, 0..2]);
        let expected = if frames == 1 { first } else { Tensor::cat(vec![first, before], 0) };
        let last = coming.slice([(frames - 1) * rows..frames * rows, 0..2]);

        let input = self.encode(&state, expected, fixed);
        let [_, width] = input.dims();
        let signal = input.reshape([frames, rows, width]); // [T, R, H]
        let (signal, layers) = self.layers.observe_core(signal, &hidden.layers, dropout);
        let next = self.decode(signal.reshape([frames * rows, width]), &state);
        let cube = |t: Tensor<2>| t.reshape([frames, rows, 2]);
        let predicted =
            TrajectoryBatch { position: cube(next.position), velocity: cube(next.velocity) };
        (predicted, RecurrentState { layers, expected_velocity: Some(last) })
    }

    /// As [`Network::step`](super::network::Network::step).
    pub(crate) fn step(
        &self,
        state: &ParticleState,
        fixed: &StaticInputs,
        hidden: RecurrentState,
        dropout: &mut Dropout,
    ) -> (ParticleState, RecurrentState) {
        let expected = hidden.expected_velocity.unwrap_or_else(|| state.velocity.clone());
        let signal = self.encode(state, expected, fixed); // [R, H]
        let (signal, layers) = self.layers.step_core(signal, &hidden.layers, dropout);
        let expected_velocity = Some(self.expected_velocities(state));
        (self.decode(signal, state), RecurrentState { layers, expected_velocity })
    }

    /// The velocities that the ballistic step expects in the next frame, `[rows, 2]`.
    fn expected_velocities(&self, state: &ParticleState) -> Tensor<2> {
        let ParticleState { position, velocity } = state.clone();
        if self.fused() {
            return fused_layers::expected_velocities(self.ballistic.plain, position, velocity);
        }
        self.ballistic.step(position, velocity).velocity
    }

    /// The core's input, `[T R, H]`, from particles and their expected velocities, `[T R, 2]`.
    fn encode(
        &self,
        state: &ParticleState,
        expected_velocity: Tensor<2>,
        fixed: &StaticInputs,
    ) -> Tensor<2> {
        let Layers { encoder: [first, second], grid, .. } = &self.layers;
        let grid = grid.as_ref().expect("the particle model's layers have a grid");
        let shape = strain::shape(&state.position, &fixed.rest);
        let features = self.features(state, expected_velocity, shape, fixed); // [T R, F]
        let encoded = second.forward(first.rectified(features.clone())); // [T R, C0]
        let position = pairs(state.position.clone());
        let windows = position.len() / fixed.particles();
        let ballistic = &self.ballistic.plain;
        let context = GridContext::new(&self.grid, ballistic, self.domain, &position, windows);
        let gathered = grid.forward(&context, encoded, &state.position); // [T R, C0]
        grid.context.concatenated(features, gathered)
    }

    fn features(
        &self,
        state: &ParticleState,
        expected_velocity: Tensor<2>,
        shape: Tensor<2>,
        fixed: &StaticInputs,
    ) -> Tensor<2> {
        let ParticleState { position, velocity } = state.clone();
        if self.fused() {
            let (ballistic, unit) = (self.ballistic.plain, self.scaling.velocity_unit);
            let inputs = [position, velocity, expected_velocity, shape];
            let [_, width] = fixed.constants.dims();
            let constants = (fixed.constant_list.clone(), width);
            return fused_layers::features(ballistic, unit, constants, inputs);
        }
        let motion = self.ballistic.step(position, velocity.clone());
        let [rows, _] = shape.dims();
        let constants = fixed.constants.clone().repeat(&[rows / fixed.rest.len(), 1]);
        let residual = velocity - expected_velocity;
        self.scaling.particle(state, residual, &motion, &self.ballistic, shape, constants)
    }

    /// The predicted state from the core's output, `[rows, H]`, and the current state.
    fn decode(&self, signal: Tensor<2>, state: &ParticleState) -> ParticleState {
        let output = self.layers.decoder.forward(self.layers.mixer.rectified(signal)); // [rows, 4]
        let [rows, _] = output.dims();
        let halves = |t: Tensor<2>| [0, 2].map(|k| t.clone().slice([0..rows, k..k + 2]));
        let ParticleState { position, velocity } = state.clone();
        if self.fused() {
            let next = fused_layers::advance(self.residual, [position, velocity, output]); // [2 rows, 2]
            let half = |first: usize| next.clone().slice([first..first + rows, 0..2]);
            return ParticleState { position: half(0), velocity: half(rows) };
        }
        let motion = self.ballistic.step(position, velocity);
        let [faster, farther] = halves(output.mul_scalar(self.scaling.velocity_unit));
        let farther = farther.mul_scalar(self.ballistic.plain.dt);
        let device = faster.device();
        let [slowest, fastest] = [self.residual.slowest, self.residual.fastest]
            .map(|limit| Tensor::<1>::from_floats(limit, &device).unsqueeze::<2>());
        let between =
            |x: Tensor<2>, low: Tensor<2>, high: Tensor<2>| x.max_pair(low).min_pair(high);
        let BallisticTensors { lower, upper, .. } = self.ballistic.clone();
        ParticleState {
            position: between(motion.position + farther, lower, upper),
            velocity: between(motion.velocity + faster, slowest, fastest),
        }
    }

    /// Whether kernels replace tensor operations.
    fn fused(&self) -> bool {
        fused::runs_on(&self.layers.decoder.weight.device())
    }
}
