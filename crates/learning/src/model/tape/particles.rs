//! Operations on particles: features, the frame model's pooling, and the step to the next frame.

use rayon::prelude::*;

use super::{Backward, Kept, Operate, exactly};
use crate::model::{described::Model, state::StaticInputs};
use eddy_inference::{
    checkpoint::{Activation, Architecture},
    kernels::encoder::{Encoder, Means},
    ops::{
        ballistic::Ballistic,
        decoder::StepGradient,
        features::{FrameFeatures, ParticleFeatures, Trajectories},
        linear::Linear,
    },
};

/// Particles of a task.
const TASK: usize = 1 << 10;

/// Pairs along x and y.
fn pairs(list: &[f32]) -> &[[f32; 2]] {
    list.as_chunks().0
}

/// The velocities that the ballistic step expects.
pub(super) struct Expect<'a>(pub(super) &'a Ballistic);

impl Operate for Expect<'_> {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let [position, velocity] = exactly(read).map(pairs);
        let states = position.iter().zip(velocity);
        let expected: Vec<_> = states.map(|(x, v)| self.0.step(*x, *v).1).collect();
        (expected.into_flattened(), Kept::NOTHING)
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, gradient, .. } = of;
        let [position, velocity] = exactly(read).map(pairs);
        let rows = position.iter().zip(velocity).zip(pairs(gradient));
        let by: Vec<_> = rows
            .map(|((x, v), by)| {
                let moving = self.0.moving(*x, *v);
                [0, 1].map(|axis| if moving[axis] { by[axis] } else { 0.0 })
            })
            .collect();
        vec![Vec::new(), by.into_flattened()]
    }
}

/// The features of the particle model.
pub(super) struct FeaturesOfParticles<'a> {
    pub(super) features: &'a ParticleFeatures,
    pub(super) fixed: &'a StaticInputs,
}

impl FeaturesOfParticles<'_> {
    /// Calls `work` with the particles. Each frame's velocities are compared with those expected one frame earlier.
    fn with<T>(&self, read: &[&[f32]], work: impl FnOnce(&Trajectories<'_>) -> T) -> T {
        let [position, velocity, first, coming] = exactly(read);
        let expected = [first, &coming[..coming.len() - first.len()]].concat();
        let StaticInputs { material, rest, stiffness, windows } = self.fixed;
        work(&Trajectories {
            position: pairs(position),
            velocity: pairs(velocity),
            expected: pairs(&expected),
            material,
            rest,
            stiffness: stiffness.as_deref(),
            windows: *windows,
        })
    }
}

impl Operate for FeaturesOfParticles<'_> {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        (self.with(read, |bodies| self.features.forward(bodies)), Kept::NOTHING)
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, written: features, gradient, .. } = of;
        let by = self.with(read, |bodies| self.features.backward(bodies, features, gradient));
        let [_, _, first, coming] = exactly(read);
        let mut by_coming = by.expected.into_flattened();
        let by_first = by_coming.drain(..first.len()).collect();
        by_coming.resize(coming.len(), 0.0);
        vec![by.position.into_flattened(), by.velocity.into_flattened(), by_first, by_coming]
    }
}

/// The features of the frame model.
pub(super) struct FeaturesOfFrames<'a> {
    pub(super) features: &'a FrameFeatures,
    pub(super) fixed: &'a StaticInputs,
}

impl Operate for FeaturesOfFrames<'_> {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let [position, velocity] = exactly(read).map(pairs);
        (self.features.forward(position, velocity, &self.fixed.material), Kept::NOTHING)
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { gradient, .. } = of;
        self.features.backward(gradient).map(Vec::into_flattened).into()
    }
}

/// The mean over the particles of a frame of a linear layer with an activation; keeps sums of slopes for the usual numbers of features,
/// otherwise all activations.
pub(super) struct MeanOfLinear {
    pub(super) activation: Activation,
    /// N.
    pub(super) particles: usize,
}

impl MeanOfLinear {
    /// Its layer of F features, without a list of all particles' activations.
    fn encoder<'a, const F: usize>(&self, [weight, bias]: [&'a [f32]; 2]) -> Encoder<'a, F> {
        Encoder { weight, bias, particles: self.particles }
    }

    /// Its layer of any number of features.
    fn linear<'a>(&self, [weight, bias]: [&'a [f32]; 2]) -> Linear<'a> {
        Linear { weight, bias, activation: Some(self.activation) }
    }
}

impl Operate for MeanOfLinear {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let [points, layer @ ..] = exactly::<_, 3>(read);
        let width = layer[1].len();
        let Means { means, slopes } = match layer[0].len() / width {
            5 => self.encoder::<5>(layer).forward(self.activation, points),
            8 => self.encoder::<8>(layer).forward(self.activation, points),
            _ => {
                let all = self.linear(layer).forward(points);
                let windows = all.chunks_exact(self.particles * width);
                let share = 1.0 / self.particles as f32;
                let mean = |window: &[f32], unit| {
                    share * window.iter().skip(unit).step_by(width).sum::<f32>()
                };
                let means = windows
                    .flat_map(|window| (0..width).map(move |unit| mean(window, unit)))
                    .collect();
                Means { means, slopes: all }
            }
        };
        (means, Kept::Numbers(slopes))
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, kept, gradient, wanted, .. } = of;
        let [points, layer @ ..] = exactly::<_, 3>(read);
        let (activation, kept, wanted) = (self.activation, kept.numbers(), wanted[0]);
        let width = layer[1].len();
        let by = match layer[0].len() / width {
            5 => self.encoder::<5>(layer).backward(activation, points, kept, gradient, wanted),
            8 => self.encoder::<8>(layer).backward(activation, points, kept, gradient, wanted),
            _ => {
                let share = 1.0 / self.particles as f32;
                let of_window = |by: &[f32]| {
                    by.iter().map(|by| share * by).collect::<Vec<_>>().repeat(self.particles)
                };
                let by_all: Vec<f32> = gradient.chunks_exact(width).flat_map(of_window).collect();
                let by = self.linear(layer).backward(points, kept, &by_all, wanted, true);
                return vec![by.input, by.weight, by.bias];
            }
        };
        vec![by.points, by.weight, by.bias]
    }
}

/// The largest numbers over the particles of a frame.
pub(super) struct Max {
    /// N.
    pub(super) particles: usize,
    /// Numbers of a particle.
    pub(super) width: usize,
}

impl Operate for Max {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let [points] = exactly(read);
        let largest = points.par_chunks(self.particles * self.width).flat_map_iter(|points| {
            let mut largest = points[..self.width].to_vec();
            for point in points.chunks_exact(self.width) {
                largest.iter_mut().zip(point).for_each(|(largest, x)| *largest = largest.max(*x));
            }
            largest
        });
        (largest.collect(), Kept::NOTHING)
    }

    /// To the first particle that has the largest number.
    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, written: largest, gradient, .. } = of;
        let [points] = exactly(read);
        let mut by = vec![0.0; points.len()];
        let window = self.particles * self.width;
        let frames = largest.par_chunks(self.width).zip(gradient.par_chunks(self.width));
        let frames = by.par_chunks_mut(window).zip(points.par_chunks(window)).zip(frames);
        frames.for_each(|((by, points), (largest, gradient))| {
            for (column, (largest, gradient)) in largest.iter().zip(gradient).enumerate() {
                let mut column_of = points.iter().skip(column).step_by(self.width);
                if let Some(particle) = column_of.position(|x| x == largest) {
                    by[particle * self.width + column] = *gradient;
                }
            }
        });
        vec![by]
    }
}

/// The next positions and velocities, `[T R, 4]`.
pub(super) struct Advance<'a>(pub(super) &'a Model);

impl Operate for Advance<'_> {
    fn forward(&self, read: &[&[f32]]) -> (Vec<f32>, Kept) {
        let [position, velocity, output] = exactly(read);
        let Model { step, decoded, description, .. } = self.0;
        let states = pairs(position).par_iter().zip(pairs(velocity)).with_min_len(TASK);
        let next: Vec<_> = match description.architecture {
            Architecture::Frame => {
                let rows = states.zip(output.as_chunks::<2>().0);
                rows.map(|((x, v), o)| decoded.next(*x, *v, *o)).map(joined).collect()
            }
            Architecture::Particle => {
                let rows = states.zip(output.as_chunks::<4>().0);
                rows.map(|((x, v), o)| step.next_in_training(*x, *v, o)).map(joined).collect()
            }
        };
        (next.into_flattened(), Kept::NOTHING)
    }

    fn backward(&self, of: &Backward<'_>) -> Vec<Vec<f32>> {
        let &Backward { read, gradient, .. } = of;
        let [position, velocity, output] = exactly(read);
        let Model { step, decoded, description, .. } = self.0;
        let states = pairs(position).par_iter().zip(pairs(velocity));
        let rows = states.zip(pairs(gradient).par_chunks_exact(2)).with_min_len(TASK);
        match description.architecture {
            Architecture::Frame => {
                split(rows.map(|((x, v), by)| decoded.gradient(*x, *v, (&by[0], &by[1]))))
            }
            Architecture::Particle => {
                let rows = rows.zip(output.as_chunks::<4>().0);
                split(rows.map(|(((x, v), by), o)| step.gradient(*x, *v, o, (&by[0], &by[1]))))
            }
        }
    }
}

/// A position and a velocity side by side.
fn joined(([x, y], [vx, vy]): ([f32; 2], [f32; 2])) -> [f32; 4] {
    [x, y, vx, vy]
}

/// The gradients of all particles by position, velocity and outputs.
fn split<const O: usize>(
    all: impl IndexedParallelIterator<Item = StepGradient<O>>,
) -> Vec<Vec<f32>> {
    let all: Vec<_> = all.collect();
    let part = |of: fn(&StepGradient<O>) -> &[f32]| all.iter().flat_map(of).copied().collect();
    vec![part(|by| &by.position), part(|by| &by.velocity), part(|by| &by.output)]
}
