//! The frame model: the paper's network (Table 1), one hidden state for the whole frame.
//!
//! | step | shape |
//! |---|---|
//! | features of each particle | `[B, N, 8]` |
//! | pointwise Linear, activation | `[B, N, 256]` |
//! | mean over the particles | `[B, 256]` |
//! | Linear | `[B, 1250]` |
//! | two layers of the core, dropout after each | `[B, 1250]` |
//! | mixer: Linear, activation | `[B, 1250]` |
//! | decoder: one Linear | `[B, N, 2]` |
//!
//! Table 1 pools after the encoder's second Linear. A mean commutes with a linear map, so that pooling first gives the same
//! values for a fortieth of the work (a test compares the two orders). A maximum does not commute and keeps the order of the
//! table. Both poolings together are `[B, 2500]`, mean first. The table does not say whether the "MLP(1250 -> 1250)" has an
//! activation; without one it would be redundant before the decoder, so it has that of the encoder (ELU by default). What
//! the decoder's output means is a choice of the network's ([`FrameOutput`]).

use burn::tensor::{Device, Tensor};

use super::{
    ballistic::BallisticTensors,
    core::activate,
    dropout::Dropout,
    features::Scaling,
    fused, fused_layers,
    layers::Layers,
    linear::Linear,
    state::{ParticleState, RecurrentState, StaticInputs, TrajectoryBatch},
};
use eddy_inference::{
    checkpoint::{Description, FrameOptions, FrameOutput, Pooling},
    engine::Ballistic,
};

/// The frame model with its normalisation.
#[derive(Clone, Debug)]
pub(crate) struct FrameModel {
    pub(crate) layers: Layers,
    pub(crate) scaling: Scaling,
    options: FrameOptions,
    /// N.
    particles: usize,
    /// The step to which a residual is added.
    ballistic: BallisticTensors,
}

impl FrameModel {
    pub(crate) fn new(description: &Description, layers: Layers, device: &Device) -> Self {
        Self {
            scaling: Scaling::new(&description.normalization, device),
            options: description.frame,
            particles: layers.decoder.weight.dims()[1] / 2,
            layers,
            ballistic: BallisticTensors::new(Ballistic::new(description), device),
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
        let encoded = (0..frames).map(|t| self.encode(&trajectory.at(t), &fixed.constants));
        let signal = Tensor::stack(encoded.collect(), 0); // [T, B, H]
        let (signal, layers) = self.layers.observe_core(signal, &hidden.layers, dropout);
        let flat = |t: &Tensor<3>| t.clone().reshape([frames * rows, 2]);
        let state = ParticleState {
            position: flat(&trajectory.position),
            velocity: flat(&trajectory.velocity),
        };
        let ParticleState { position, velocity } = self.decode(signal.flatten(0, 1), &state);
        let cube = |t: Tensor<2>| t.reshape([frames, rows, 2]);
        let predicted = TrajectoryBatch { position: cube(position), velocity: cube(velocity) };
        (predicted, RecurrentState { layers, expected_velocity: None })
    }

    /// As [`Network::step`](super::network::Network::step).
    pub(crate) fn step(
        &self,
        state: &ParticleState,
        fixed: &StaticInputs,
        hidden: RecurrentState,
        dropout: &mut Dropout,
    ) -> (ParticleState, RecurrentState) {
        let signal = self.encode(state, &fixed.constants);
        let (signal, layers) = self.layers.step_core(signal, &hidden.layers, dropout);
        let hidden = RecurrentState { layers, expected_velocity: None };
        (self.decode(signal, state), hidden)
    }

    /// One frame of B windows, `[B N, ..]`, to `[B, H]` (`[B, 2 H]` with both poolings).
    pub(crate) fn encode(&self, state: &ParticleState, material: &Tensor<2>) -> Tensor<2> {
        let points = self.scaling.frame(&self.options, state, material.clone()); // [B N, F]
        let [first, second] = &self.layers.encoder;
        if self.options.pooling == Pooling::Mean && fused::runs_on(&first.weight.device()) {
            let Linear { weight, bias } = first.clone();
            let kind = self.options.activation;
            return second.forward(fused_layers::encode(
                kind,
                self.particles,
                points,
                weight,
                bias,
            ));
        }
        let points = activate(self.options.activation, first.forward(points)); // [B N, E]
        let windows = |points: Tensor<2>| {
            let [rows, width] = points.dims();
            points.reshape([rows / self.particles, self.particles, width])
        };
        let mean = |points| second.forward(windows(points).mean_dim(1).squeeze_dim::<2>(1));
        let max = |points| windows(second.forward(points)).max_dim(1).squeeze_dim::<2>(1);
        match self.options.pooling {
            Pooling::Mean => mean(points),
            Pooling::Max => max(points),
            Pooling::MeanMax => Tensor::cat(vec![mean(points.clone()), max(points)], 1),
        }
    }

    /// The state after this one, from the core's output `[B, H]`.
    fn decode(&self, signal: Tensor<2>, state: &ParticleState) -> ParticleState {
        let mixed = activate(self.options.activation, self.layers.mixer.forward(signal));
        let output = self.layers.decoder.forward(mixed); // [B, 2 N]
        let [windows, _] = output.dims();
        let output = output.reshape([windows * self.particles, 2]);
        let ParticleState { position, velocity } = state.clone();
        let dt = self.ballistic.plain.dt;
        match self.options.output {
            FrameOutput::Displacement => {
                let velocity = velocity + output;
                ParticleState { position: position + velocity.clone().mul_scalar(dt), velocity }
            }
            FrameOutput::Residual => {
                let motion = self.ballistic.step(position, velocity);
                ParticleState {
                    position: motion.position + output.clone().mul_scalar(0.5 * dt),
                    velocity: motion.velocity + output,
                }
            }
            FrameOutput::Position => {
                let next = self.scaling.position(output);
                let velocity = (next.clone() - position).div_scalar(dt);
                ParticleState { position: next, velocity }
            }
        }
    }
}
