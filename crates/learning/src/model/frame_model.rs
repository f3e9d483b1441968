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
//! Table 1 pools after the encoder's second Linear. A mean commutes with a linear map, so pooling
//! goes first here: the same numbers for a fortieth of the work (a test compares the two orders). A
//! maximum does not, and keeps the literal order. Both together are `[B, 2500]`, mean first.
//! The table does not say whether the "MLP(1250 -> 1250)" has an activation; without one it would
//! fold into the decoder, so it has the encoder's (ELU if nothing else is chosen).
//! The decoder's output is dv in domain lengths per second: v' = v + dv, x' = x + v' dt.

use burn::tensor::{Device, Tensor};

use super::{
    Bodies, Matter, Track,
    features::Scaling,
    fused,
    layers::{Layers, Linear},
    mlp::activate,
    network::{Dropout, Hidden},
    training,
};
use eddy_inference::checkpoint::{Description, FrameOptions, Pooling};

/// The frame model with its scales.
#[derive(Clone, Debug)]
pub(crate) struct FrameModel {
    pub(crate) layers: Layers,
    pub(crate) scaling: Scaling,
    options: FrameOptions,
    /// N.
    particles: usize,
    /// Time between two frames (s).
    dt: f32,
}

impl FrameModel {
    pub(crate) fn new(description: &Description, layers: Layers, device: &Device) -> Self {
        Self {
            scaling: Scaling::new(&description.normalization, device),
            options: description.frame,
            particles: layers.decoder.weight.dims()[1] / 2,
            layers,
            dt: description.dt,
        }
    }

    /// As [`ParticleModel::observe`](super::particle_model::ParticleModel::observe).
    pub(crate) fn observe(
        &self,
        track: &Track,
        matter: &Matter,
        hidden: Hidden,
        dropout: &mut Dropout,
    ) -> (Track, Hidden) {
        let [frames, rows, _] = track.position.dims();
        let encoded = (0..frames).map(|t| self.encode(&track.at(t), &matter.material)).collect();
        let mut signal: Tensor<3> = Tensor::stack(encoded, 0); // [T, B, H]
        let mut states = Vec::with_capacity(self.layers.core.len());
        for (layer, carried) in self.layers.core.iter().zip(hidden.carried(&self.layers)) {
            let (output, state) = layer.observe(signal, carried);
            states.push(state);
            signal = dropout.apply(output);
        }
        let change = self.decode(signal.flatten(0, 1)).reshape([frames, rows, 2]);
        let velocity = track.velocity.clone() + change;
        let position = track.position.clone() + velocity.clone().mul_scalar(self.dt);
        (Track { position, velocity }, Hidden { states, foretold: None })
    }

    /// As [`ParticleModel::step`](super::particle_model::ParticleModel::step).
    pub(crate) fn step(
        &self,
        bodies: &Bodies,
        matter: &Matter,
        hidden: Hidden,
        dropout: &mut Dropout,
    ) -> (Bodies, Hidden) {
        let mut signal = self.encode(bodies, &matter.material);
        let mut states = Vec::with_capacity(self.layers.core.len());
        for (layer, carried) in self.layers.core.iter().zip(hidden.carried(&self.layers)) {
            let state = layer.step(signal, carried);
            signal = dropout.apply(state.hidden.clone());
            states.push(state);
        }
        let velocity = bodies.velocity.clone() + self.decode(signal);
        let position = bodies.position.clone() + velocity.clone().mul_scalar(self.dt);
        (Bodies { position, velocity }, Hidden { states, foretold: None })
    }

    /// One frame of B windows, `[B N, ..]`, to `[B, H]` (`[B, 2 H]` with both poolings).
    pub(crate) fn encode(&self, bodies: &Bodies, material: &Tensor<2>) -> Tensor<2> {
        let points = self.scaling.frame(&self.options, bodies, material.clone()); // [B N, F]
        let [first, second] = &self.layers.encoder;
        if self.options.pooling == Pooling::Mean && fused::runs_on(&first.weight.device()) {
            let Linear { weight, bias } = first.clone();
            let kind = self.options.activation;
            return second.forward(training::encode(kind, self.particles, points, weight, bias));
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

    /// `[B, H]` to dv, `[B N, 2]`.
    fn decode(&self, signal: Tensor<2>) -> Tensor<2> {
        let mixed = activate(self.options.activation, self.layers.mixer.forward(signal));
        let change = self.layers.decoder.forward(mixed); // [B, 2 N]
        let [windows, _] = change.dims();
        change.reshape([windows * self.particles, 2])
    }
}
