//! The particle model: one hidden state for each particle, weights shared, any number of particles.
//!
//! features (F) -> Linear -> ReLU -> Linear (C0) -> grid (`grid`) -> context (C0);
//! features, context -> Linear -> ReLU -> recurrent layers (H) -> mixer -> ReLU -> decoder (4).
//! The decoder gives a velocity and a position residual on the ballistic step, in units of the
//! training velocities' deviation u:
//! v' = v_b + u (o_1, o_2), x' = x_b + u dt (o_3, o_4). The position has a residual of its own because
//! a frame spans many substeps: what happens early in it moves a particle further than what happens late.
//! v' is clamped to the training range widened by a quarter on each side, x' to the walls in effect,
//! so that a rollout stays finite. A zero decoder is the ballistic step.

use burn::tensor::{Device, Tensor};

use super::{
    Bodies, Matter, Track,
    ballistic::BallisticTensors,
    features::Scaling,
    fused,
    grid::Ground,
    layers::Layers,
    network::{Dropout, Hidden},
    pairs, strain, training,
};
use eddy_frames::Domain;
use eddy_inference::{
    checkpoint::{Description, GridOptions},
    engine::{Ballistic, scales::velocity_limits},
};

/// The particle model with its scales.
#[derive(Clone, Debug)]
pub(crate) struct ParticleModel {
    pub(crate) layers: Layers,
    grid: GridOptions,
    domain: Domain,
    scaling: Scaling,
    ballistic: BallisticTensors,
    /// The smallest and the largest velocities (domain lengths per second).
    limits: [[f32; 2]; 2],
}

impl ParticleModel {
    pub(crate) fn new(description: &Description, layers: Layers, device: &Device) -> Self {
        let scale = &description.normalization;
        let (slowest, fastest) = velocity_limits(scale);
        let grid = description.grid;
        Self {
            layers,
            grid: grid.expect("a description that was checked has them"),
            domain: description.domain,
            scaling: Scaling::new(scale, device),
            ballistic: BallisticTensors::new(Ballistic::new(description), device),
            limits: [slowest, fastest],
        }
    }

    /// Observes T consecutive frames at once. Gives the frame predicted after each, and the state
    /// after the last.
    pub(crate) fn observe(
        &self,
        track: &Track,
        matter: &Matter,
        hidden: Hidden,
        dropout: &mut Dropout,
    ) -> (Track, Hidden) {
        let [frames, rows, _] = track.position.dims();
        let flat = |t: &Tensor<3>| t.clone().reshape([frames * rows, 2]);
        let bodies = Bodies { position: flat(&track.position), velocity: flat(&track.velocity) };

        // What each frame was foretold to be by the one before it; the first one what it is.
        let coming = self.foretell(&bodies); // [T R, 2]
        let first = hidden.foretold.clone().unwrap_or_else(|| track.at(0).velocity);
        let before = coming.clone().slice([0..(frames - 1) * rows, 0..2]);
        let foretold = if frames == 1 { first } else { Tensor::cat(vec![first, before], 0) };
        let last = coming.slice([(frames - 1) * rows..frames * rows, 0..2]);

        let input = self.perceive(&bodies, foretold, matter);
        let [_, width] = input.dims();
        let mut signal = input.reshape([frames, rows, width]); // [T, R, H]
        let mut states = Vec::with_capacity(self.layers.core.len());
        for (layer, carried) in self.layers.core.iter().zip(hidden.carried(&self.layers)) {
            let (output, state) = layer.observe(signal, carried);
            states.push(state);
            signal = dropout.apply(output);
        }
        let next = self.decode(signal.reshape([frames * rows, width]), &bodies);
        let cube = |t: Tensor<2>| t.reshape([frames, rows, 2]);
        let predicted = Track { position: cube(next.position), velocity: cube(next.velocity) };
        (predicted, Hidden { states, foretold: Some(last) })
    }

    /// Observes one frame, predicts the next.
    pub(crate) fn step(
        &self,
        bodies: &Bodies,
        matter: &Matter,
        hidden: Hidden,
        dropout: &mut Dropout,
    ) -> (Bodies, Hidden) {
        let foretold = hidden.foretold.clone().unwrap_or_else(|| bodies.velocity.clone());
        let mut signal = self.perceive(bodies, foretold, matter); // [R, H]
        let mut states = Vec::with_capacity(self.layers.core.len());
        for (layer, carried) in self.layers.core.iter().zip(hidden.carried(&self.layers)) {
            let state = layer.step(signal, carried);
            signal = dropout.apply(state.hidden.clone());
            states.push(state);
        }
        let hidden = Hidden { states, foretold: Some(self.foretell(bodies)) };
        (self.decode(signal, bodies), hidden)
    }

    /// Velocities that the ballistic step foretells, `[rows, 2]`.
    fn foretell(&self, bodies: &Bodies) -> Tensor<2> {
        let Bodies { position, velocity } = bodies.clone();
        if self.fused() {
            return training::foretell(self.ballistic.plain, position, velocity);
        }
        self.ballistic.step(position, velocity).velocity
    }

    /// What the core gets to know of particles, `[T R, H]`, whose velocities were foretold, `[T R, 2]`.
    fn perceive(&self, bodies: &Bodies, foretold: Tensor<2>, matter: &Matter) -> Tensor<2> {
        let Layers { encoder: [first, second], grid, .. } = &self.layers;
        let grid = grid.as_ref().expect("the particle model's layers have a grid");
        let shape = strain::shape(&bodies.position, &matter.rest);
        let features = self.features(bodies, foretold, shape, matter); // [T R, F]
        let encoded = second.forward(first.rectified(features.clone())); // [T R, C0]
        let position = pairs(bodies.position.clone());
        let windows = position.len() / matter.particles();
        let ground =
            Ground::new(&self.grid, &self.ballistic.plain, self.domain, &position, windows);
        let context = grid.look_around(&ground, encoded, &bodies.position); // [T R, C0]
        grid.context.beside(features, context)
    }

    fn features(
        &self,
        bodies: &Bodies,
        foretold: Tensor<2>,
        shape: Tensor<2>,
        matter: &Matter,
    ) -> Tensor<2> {
        let Bodies { position, velocity } = bodies.clone();
        if self.fused() {
            let (ballistic, unit) = (self.ballistic.plain, self.scaling.velocity_unit);
            let inputs = [position, velocity, foretold, shape];
            return training::perceive(ballistic, unit, matter.one_hot.clone(), inputs);
        }
        let fallen = self.ballistic.step(position, velocity.clone());
        let [rows, _] = shape.dims();
        let material = matter.material.clone();
        let material = material.repeat(&[rows / matter.rest.len(), 1]);
        let push = velocity - foretold;
        self.scaling.particle(bodies, push, &fallen, &self.ballistic, shape, material)
    }

    /// `[rows, H]` and where particles are to where they will be.
    fn decode(&self, signal: Tensor<2>, bodies: &Bodies) -> Bodies {
        let output = self.layers.decoder.forward(self.layers.mixer.rectified(signal)); // [rows, 4]
        let [rows, _] = output.dims();
        let halves = |t: Tensor<2>| [0, 2].map(|k| t.clone().slice([0..rows, k..k + 2]));
        let Bodies { position, velocity } = bodies.clone();
        if self.fused() {
            let (ballistic, unit) = (self.ballistic.plain, self.scaling.velocity_unit);
            let inputs = [position, velocity, output];
            let next = training::move_on(ballistic, unit, self.limits, inputs); // [2 rows, 2]
            let half = |first: usize| next.clone().slice([first..first + rows, 0..2]);
            return Bodies { position: half(0), velocity: half(rows) };
        }
        let fallen = self.ballistic.step(position, velocity);
        let [faster, farther] = halves(output.mul_scalar(self.scaling.velocity_unit));
        let farther = farther.mul_scalar(self.ballistic.plain.dt);
        let device = faster.device();
        let [slowest, fastest] =
            self.limits.map(|limit| Tensor::<1>::from_floats(limit, &device).unsqueeze::<2>());
        let between =
            |x: Tensor<2>, low: Tensor<2>, high: Tensor<2>| x.max_pair(low).min_pair(high);
        let BallisticTensors { lower, upper, .. } = self.ballistic.clone();
        Bodies {
            position: between(fallen.position + farther, lower, upper),
            velocity: between(fallen.velocity + faster, slowest, fastest),
        }
    }

    /// Whether kernels compute what tensor operations would.
    fn fused(&self) -> bool {
        fused::runs_on(&self.layers.decoder.weight.device())
    }
}
