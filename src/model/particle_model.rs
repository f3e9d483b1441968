//! The particle model: one hidden state for each particle, weights shared, any number of particles.
//!
//! features (F) -> Linear -> ReLU -> Linear (C0) -> grid (`surroundings`) -> context (C0);
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
    ballistic::{Ballistic, BallisticTensors, Fallen},
    features::Scaling,
    layers::Layers,
    network::{Dropout, Hidden},
    pairs, strain,
    surroundings::Ground,
};
use crate::{
    checkpoint::{Description, Normalization, Surroundings},
    frame::Domain,
};

/// How far v' may leave the range of training velocities, as a share of that range.
const VELOCITY_MARGIN: f32 = 0.25;

/// The smallest and the largest velocities that are predicted, by axis (domain lengths per second).
pub(crate) fn velocity_limits(scale: &Normalization) -> ([f32; 2], [f32; 2]) {
    let bound = |side: f32, of: [f32; 4]| {
        [2, 3].map(|axis| {
            of[axis] + side * VELOCITY_MARGIN * (scale.maximum[axis] - scale.minimum[axis])
        })
    };
    (bound(-1.0, scale.minimum), bound(1.0, scale.maximum))
}

/// The particle model with its scales.
#[derive(Clone, Debug)]
pub(crate) struct ParticleModel {
    pub(crate) layers: Layers,
    surroundings: Surroundings,
    domain: Domain,
    scaling: Scaling,
    ballistic: BallisticTensors,
    slowest: Tensor<2>,
    fastest: Tensor<2>,
}

impl ParticleModel {
    pub(crate) fn new(description: &Description, layers: Layers, device: &Device) -> Self {
        let scale = &description.normalization;
        let row = |values: [f32; 2]| Tensor::<1>::from_floats(values, device).unsqueeze::<2>();
        let (slowest, fastest) = velocity_limits(scale);
        let surroundings = description.surroundings;
        Self {
            layers,
            surroundings: surroundings.expect("a description that was checked has them"),
            domain: description.domain,
            scaling: Scaling::new(scale, device),
            ballistic: BallisticTensors::new(Ballistic::of(description), device),
            slowest: row(slowest),
            fastest: row(fastest),
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
        let fallen = self.ballistic.step(bodies.position.clone(), bodies.velocity.clone());

        // What each frame was foretold to be by the one before it.
        let foretold = fallen.velocity.clone().reshape([frames, rows, 2]);
        let first =
            hidden.foretold.clone().unwrap_or_else(|| track.at(0).velocity).unsqueeze::<3>();
        let last = foretold.clone().slice([frames - 1..frames, 0..rows, 0..2]).reshape([rows, 2]);
        let foretold = match frames {
            1 => first,
            _ => Tensor::cat(vec![first, foretold.slice([0..frames - 1, 0..rows, 0..2])], 0),
        };
        let push = (track.velocity.clone() - foretold).reshape([frames * rows, 2]);

        let input = self.perceive(&bodies, push, &fallen, matter, frames);
        let [_, width] = input.dims();
        let mut signal = input.reshape([frames, rows, width]); // [T, R, H]
        let mut states = Vec::with_capacity(self.layers.core.len());
        for (layer, carried) in self.layers.core.iter().zip(hidden.carried(&self.layers)) {
            let (output, state) = layer.observe(signal, carried);
            states.push(state);
            signal = dropout.apply(output);
        }
        let next = self.decode(signal.reshape([frames * rows, width]), fallen);
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
        let fallen = self.ballistic.step(bodies.position.clone(), bodies.velocity.clone());
        let foretold = Some(fallen.velocity.clone());
        let push = match hidden.foretold.clone() {
            None => bodies.velocity.zeros_like(),
            Some(foretold) => bodies.velocity.clone() - foretold,
        };
        let mut signal = self.perceive(bodies, push, &fallen, matter, 1); // [R, H]
        let mut states = Vec::with_capacity(self.layers.core.len());
        for (layer, carried) in self.layers.core.iter().zip(hidden.carried(&self.layers)) {
            let state = layer.step(signal, carried);
            signal = dropout.apply(state.hidden.clone());
            states.push(state);
        }
        (self.decode(signal, fallen), Hidden { states, foretold })
    }

    /// What the core gets to know of the particles of T frames one below the other, `[T R, H]`.
    fn perceive(
        &self,
        bodies: &Bodies,
        push: Tensor<2>,
        fallen: &Fallen,
        matter: &Matter,
        frames: usize,
    ) -> Tensor<2> {
        let Layers { encoder: [first, second], grid, .. } = &self.layers;
        let grid = grid.as_ref().expect("the particle model's layers have a grid");
        let shape = strain::shape(&bodies.position, &matter.rest);
        let material = matter.material.clone().repeat(&[frames, 1]);
        let features =
            self.scaling.particle(bodies, push, fallen, &self.ballistic, shape, material); // [T R, F]
        let encoded = second.forward(first.rectified(features.clone())); // [T R, C0]
        let position = pairs(bodies.position.clone());
        let windows = frames * matter.windows;
        let ground =
            Ground::new(&self.surroundings, &self.ballistic.plain, self.domain, &position, windows);
        let context = grid.look_around(&ground, encoded, &bodies.position); // [T R, C0]
        grid.context.rectified(Tensor::cat(vec![features, context], 1))
    }

    /// `[rows, H]` and the ballistic step to the next bodies.
    fn decode(&self, signal: Tensor<2>, fallen: Fallen) -> Bodies {
        let output = self.layers.decoder.forward(self.layers.mixer.rectified(signal));
        let [rows, _] = output.dims();
        let output = output.mul_scalar(self.scaling.velocity_unit); // [rows, 4]
        let faster = output.clone().slice([0..rows, 0..2]);
        let farther = output.slice([0..rows, 2..4]).mul_scalar(self.ballistic.plain.dt);
        let between = |x: Tensor<2>, low: &Tensor<2>, high: &Tensor<2>| {
            x.max_pair(low.clone()).min_pair(high.clone())
        };
        Bodies {
            position: between(
                fallen.position + farther,
                &self.ballistic.lower,
                &self.ballistic.upper,
            ),
            velocity: between(fallen.velocity + faster, &self.slowest, &self.fastest),
        }
    }
}
