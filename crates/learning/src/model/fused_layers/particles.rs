//! The particle model's features, and the predicted motion from its decoder.

use std::sync::Arc;

use burn::tensor::Tensor;
use pulp::Arch;
use rayon::prelude::*;

use crate::model::fused::{Operation, apply, input};
use eddy_inference::{
    engine::{
        Ballistic,
        scales::{BODY_SCALE, CONTACT_SCALE},
    },
    kernels::{
        activation::Exponentials,
        rest_shape::{RestShape, SHAPE_FEATURES},
    },
    ops::decoder::ResidualStep,
};

/// Rows per task.
const ROWS: usize = 1 << 10;
/// Proximity to four walls at two scales.
const PROXIMITIES: usize = 8;
/// Number of features before the shape.
const BEFORE: usize = 6 + PROXIMITIES;

/// [`strain::shape`](crate::model::strain::shape): positions `[T R, 2]` to `[T R, 5]`.
pub(crate) fn shape(rest: Arc<RestShape>, position: Tensor<2>) -> Tensor<2> {
    let shape = [position.dims()[0], SHAPE_FEATURES];
    apply(Shape(rest), [input(position)], shape)
}

#[derive(Clone, Debug)]
struct Shape(Arc<RestShape>);

impl Operation<1> for Shape {
    type Kept = ();

    fn forward(&self, [position]: [&[f32]; 1]) -> (Vec<f32>, ()) {
        (self.0.shape(position.as_chunks().0), ())
    }

    fn backward(
        &self,
        [position]: [&[f32]; 1],
        _shape: &[f32],
        (): (),
        gradient: &[f32],
        _wanted: [bool; 1],
    ) -> [Vec<f32>; 1] {
        [self.0.backward(position.as_chunks().0, gradient)]
    }
}

/// The velocities that the ballistic step expects, `[R, 2]`, from positions and velocities, `[R, 2]` each.
pub(crate) fn expected_velocities(
    ballistic: Ballistic,
    position: Tensor<2>,
    velocity: Tensor<2>,
) -> Tensor<2> {
    let shape = velocity.dims();
    apply(ExpectedVelocities(ballistic), [input(position), input(velocity)], shape)
}

#[derive(Clone, Debug)]
struct ExpectedVelocities(Ballistic);

impl Operation<2> for ExpectedVelocities {
    type Kept = ();

    fn forward(&self, [position, velocity]: [&[f32]; 2]) -> (Vec<f32>, ()) {
        let (x, v) = (pairs(position).par_iter(), pairs(velocity));
        let expected_velocity: Vec<_> = x.zip(v).map(|(x, v)| self.0.step(*x, *v).1).collect();
        (expected_velocity.into_flattened(), ())
    }

    fn backward(
        &self,
        [position, velocity]: [&[f32]; 2],
        _expected: &[f32],
        (): (),
        gradient: &[f32],
        _wanted: [bool; 2],
    ) -> [Vec<f32>; 2] {
        let rows = pairs(position).par_iter().zip(pairs(velocity)).zip(pairs(gradient));
        let by: Vec<_> = rows
            .map(|((x, v), g)| {
                let moving = self.0.moving(*x, *v);
                [0, 1].map(|axis| if moving[axis] { g[axis] } else { 0.0 })
            })
            .collect();
        [vec![0.0; position.len()], by.into_flattened()]
    }
}

/// [`Scaling::particle`](crate::model::features::Scaling::particle): positions, velocities and expected velocities, `[R, 2]`,
/// and shapes, `[R, 5]`, to features, `[R, F]`. `constants` are those of
/// [`StaticInputs`](crate::model::state::StaticInputs), `[R', width]`, and their width; they repeat every R' rows.
pub(crate) fn features(
    ballistic: Ballistic,
    velocity_unit: f32,
    (constants, width): (Arc<Vec<f32>>, usize),
    [position, velocity, expected_velocity, shape]: [Tensor<2>; 4],
) -> Tensor<2> {
    let operation = Features { ballistic, velocity_unit, constants, width };
    let size = [position.dims()[0], operation.count()];
    let inputs = [input(position), input(velocity), input(expected_velocity), input(shape)];
    apply(operation, inputs, size)
}

#[derive(Clone, Debug)]
struct Features {
    ballistic: Ballistic,
    velocity_unit: f32,
    constants: Arc<Vec<f32>>,
    /// Of the constants.
    width: usize,
}

impl Features {
    /// F.
    fn count(&self) -> usize {
        BEFORE + SHAPE_FEATURES + self.width
    }

    /// Distances from the left, lower, right and upper wall, negative beyond them.
    fn distances(&self, [x, y]: [f32; 2]) -> [f32; 4] {
        let Ballistic { lower, upper, .. } = self.ballistic;
        [x - lower[0], y - lower[1], upper[0] - x, upper[1] - y]
    }
}

impl Operation<4> for Features {
    type Kept = ();

    fn forward(
        &self,
        [position, velocity, expected_velocity, shape]: [&[f32]; 4],
    ) -> (Vec<f32>, ()) {
        let (position, velocity, expected_velocity) =
            (pairs(position), pairs(velocity), pairs(expected_velocity));
        let (shape, _) = shape.as_chunks::<SHAPE_FEATURES>();
        let (count, width) = (self.count(), self.width);
        let mut features = vec![0.0; position.len() * count];
        features.par_chunks_mut(ROWS * count).enumerate().for_each(|(part, rows)| {
            let first = part * ROWS;
            let mut proximity = vec![[0.0; PROXIMITIES]; rows.len() / count];
            for (proximity, x) in proximity.iter_mut().zip(&position[first..]) {
                for (wall, distance) in self.distances(*x).into_iter().enumerate() {
                    proximity[wall] = distance.max(0.0) * (-1.0 / CONTACT_SCALE);
                    proximity[4 + wall] = distance.max(0.0) * (-1.0 / BODY_SCALE);
                }
            }
            Arch::new().dispatch(Exponentials(proximity.as_flattened_mut()));
            for (row, features) in rows.chunks_exact_mut(count).enumerate() {
                let (at, v) = (first + row, velocity[first + row]);
                let free = self.ballistic.free(position[at], v).1;
                let stopped = self.ballistic.step(position[at], v).1;
                for axis in 0..2 {
                    features[axis] = v[axis] / self.velocity_unit;
                    features[2 + axis] =
                        (v[axis] - expected_velocity[at][axis]) / self.velocity_unit;
                    features[4 + axis] = (stopped[axis] - free[axis]) / self.velocity_unit;
                }
                features[6..BEFORE].copy_from_slice(&proximity[row]);
                features[BEFORE..BEFORE + SHAPE_FEATURES].copy_from_slice(&shape[at]);
                let constants = at * width % self.constants.len();
                features[BEFORE + SHAPE_FEATURES..]
                    .copy_from_slice(&self.constants[constants..constants + width]);
            }
        });
        (features, ())
    }

    fn backward(
        &self,
        [position, velocity, _, shape]: [&[f32]; 4],
        features: &[f32],
        (): (),
        gradient: &[f32],
        _wanted: [bool; 4],
    ) -> [Vec<f32>; 4] {
        let (rows, count) = (position.len() / 2, self.count());
        let unit = 1.0 / self.velocity_unit;
        let mut by_position = vec![[0.0; 2]; rows];
        let mut by_velocity = vec![[0.0; 2]; rows];
        let mut by_expected = vec![[0.0; 2]; rows];
        let mut by_shape = vec![[0.0; SHAPE_FEATURES]; shape.len() / SHAPE_FEATURES];
        let states = pairs(position).par_iter().zip(pairs(velocity));
        let above =
            states.zip(features.par_chunks_exact(count).zip(gradient.par_chunks_exact(count)));
        let below = by_position.par_iter_mut().zip(&mut by_velocity);
        let below = below.zip(by_expected.par_iter_mut().zip(&mut by_shape));
        let all = above.zip(below).with_min_len(ROWS);
        all.for_each(
            |(((x, v), (features, g)), ((position, velocity), (expected_velocity, shape)))| {
                let moving = self.ballistic.moving(*x, *v);
                for axis in 0..2 {
                    let wall_impulse = if moving[axis] { 0.0 } else { g[4 + axis] };
                    velocity[axis] = unit * (g[axis] + g[2 + axis] - wall_impulse);
                    expected_velocity[axis] = -unit * g[2 + axis];
                }
                for (wall, distance) in self.distances(*x).into_iter().enumerate() {
                    // The features decrease with the distance, which decreases with x and y for the right and upper wall.
                    let side = if wall < 2 { -1.0 } else { 1.0 };
                    if distance > 0.0 {
                        position[wall % 2] += side
                            * (g[6 + wall] * features[6 + wall] / CONTACT_SCALE
                                + g[10 + wall] * features[10 + wall] / BODY_SCALE);
                    }
                }
                shape.copy_from_slice(&g[BEFORE..BEFORE + SHAPE_FEATURES]);
            },
        );
        [
            by_position.into_flattened(),
            by_velocity.into_flattened(),
            by_expected.into_flattened(),
            by_shape.into_flattened(),
        ]
    }
}

/// The predicted positions, followed by the predicted velocities, `[2 R, 2]`, from the current ones and the decoder's output,
/// `[R, 4]`.
pub(crate) fn advance(
    step: ResidualStep,
    [position, velocity, output]: [Tensor<2>; 3],
) -> Tensor<2> {
    let [rows, _] = output.dims();
    apply(Advance(step), [input(position), input(velocity), input(output)], [2 * rows, 2])
}

#[derive(Clone, Debug)]
struct Advance(ResidualStep);

impl Operation<3> for Advance {
    type Kept = ();

    fn forward(&self, [position, velocity, output]: [&[f32]; 3]) -> (Vec<f32>, ()) {
        let mut next = vec![[0.0; 2]; position.len()];
        let (to_position, to_velocity) = next.split_at_mut(position.len() / 2);
        let states = pairs(position).par_iter().zip(pairs(velocity)).zip(output.as_chunks::<4>().0);
        let all = states.zip(to_position.par_iter_mut().zip(to_velocity)).with_min_len(ROWS);
        all.for_each(|(((x, v), o), (position, velocity))| {
            (*position, *velocity) = self.0.next_in_training(*x, *v, o);
        });
        (next.into_flattened(), ())
    }

    fn backward(
        &self,
        [position, velocity, output]: [&[f32]; 3],
        _next: &[f32],
        (): (),
        gradient: &[f32],
        _wanted: [bool; 3],
    ) -> [Vec<f32>; 3] {
        let mut by_position = vec![[0.0; 2]; position.len() / 2];
        let mut by_velocity = vec![[0.0; 2]; position.len() / 2];
        let mut by_output = vec![[0.0; 4]; position.len() / 2];
        let states = pairs(position).par_iter().zip(pairs(velocity));
        let (by_next, by_fallen) = pairs(gradient).split_at(position.len() / 2);
        let above = by_next.par_iter().zip(by_fallen);
        let above = states.zip(output.as_chunks::<4>().0.par_iter().zip(above));
        let below = by_position.par_iter_mut().zip(&mut by_velocity).zip(&mut by_output);
        let all = above.zip(below).with_min_len(ROWS);
        all.for_each(|(((x, v), (o, by_next)), ((position, velocity), output))| {
            let by = self.0.gradient(*x, *v, o, by_next);
            (*position, *velocity, *output) = (by.position, by.velocity, by.output);
        });
        [by_position.into_flattened(), by_velocity.into_flattened(), by_output.into_flattened()]
    }
}

/// `[R, 2]` as pairs.
fn pairs(values: &[f32]) -> &[[f32; 2]] {
    values.as_chunks().0
}
