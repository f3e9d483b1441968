//! The features of all particles of some frames, and the gradients by what they are computed from.

use pulp::{Arch, Simd, WithSimd};
use rayon::prelude::*;

use super::{MATERIAL, ParticleFeatures, ParticleInputs, SHAPE, STATE_COLUMNS, WALLS};
use crate::{
    engine::scales::{BODY_SCALE, CONTACT_SCALE},
    kernels::rest_shape::{RestShape, SHAPE_FEATURES},
};

/// Particles of a block, a multiple of the longest vector.
const BLOCK: usize = 64;

/// The particles of B windows in T frames: R rows a frame, window by window.
#[derive(Clone, Copy, Debug)]
pub struct Trajectories<'a> {
    /// Domain lengths, `[T R]`.
    pub position: &'a [[f32; 2]],
    /// Domain lengths per second, `[T R]`.
    pub velocity: &'a [[f32; 2]],
    /// The velocities that the ballistic step expected of each frame one frame before it, `[T R]`.
    pub expected: &'a [[f32; 2]],
    /// Numbers of the materials, `[R]`.
    pub material: &'a [u8],
    /// The rest shape, of R particles.
    pub rest: &'a RestShape,
    /// The feature of each window's stiffness, `[B]`, if the network is conditioned on it.
    pub stiffness: Option<&'a [f32]>,
    /// B.
    pub windows: usize,
}

/// Gradients by positions, velocities and expected velocities, `[T R]` each.
#[derive(Clone, Debug)]
pub struct Gradients {
    /// By the positions.
    pub position: Vec<[f32; 2]>,
    /// By the velocities.
    pub velocity: Vec<[f32; 2]>,
    /// By the expected velocities.
    pub expected: Vec<[f32; 2]>,
}

impl Trajectories<'_> {
    /// N.
    fn particles(&self) -> usize {
        self.material.len() / self.windows
    }
}

impl ParticleFeatures {
    /// `[T R, F]`.
    pub fn forward(&self, bodies: &Trajectories) -> Vec<f32> {
        let (count, particles) = (self.count, bodies.particles());
        let mut features = vec![0.0; bodies.position.len() * count];
        let windows = features.par_chunks_mut(particles * count).enumerate();
        windows.for_each(|(window, rows)| {
            let blocks = rows.par_chunks_mut(BLOCK * count).enumerate();
            blocks.for_each(|(block, rows)| {
                Arch::new().dispatch(Block { features: self, bodies, window, block, rows });
            });
        });
        features
    }

    /// The gradients from `gradient`, that by the `features`, `[T R, F]`.
    pub fn backward(&self, bodies: &Trajectories, features: &[f32], gradient: &[f32]) -> Gradients {
        let (rows, count) = (bodies.position.len(), self.count);
        let unit = 1.0 / self.velocity_unit;
        let [mut position, mut velocity, mut expected] = [(); 3].map(|()| vec![[0.0; 2]; rows]);
        let mut shape = vec![[0.0; SHAPE_FEATURES]; rows];
        let states = bodies.position.par_iter().zip(bodies.velocity);
        let above = features.par_chunks_exact(count).zip(gradient.par_chunks_exact(count));
        let below = position.par_iter_mut().zip(&mut velocity).zip(&mut expected).zip(&mut shape);
        let all = states.zip(above).zip(below).with_min_len(BLOCK);
        all.for_each(|(((x, v), (features, by)), (((position, velocity), expected), shape))| {
            let moving = self.ballistic.moving(*x, *v);
            for axis in 0..2 {
                let wall_impulse = if moving[axis] { 0.0 } else { by[4 + axis] };
                velocity[axis] = unit * (by[axis] + by[2 + axis] - wall_impulse);
                expected[axis] = -unit * by[2 + axis];
                // Proximity decreases with the distance, which increases with x and y for the first two walls.
                let low = x[axis] - self.ballistic.lower[axis];
                let high = self.ballistic.upper[axis] - x[axis];
                for (wall, distance, side) in [(axis, low, -1.0), (2 + axis, high, 1.0)] {
                    if distance > 0.0 {
                        let slope = |place: usize, scale: f32| by[place] * features[place] / scale;
                        position[axis] += side
                            * (slope(WALLS + wall, CONTACT_SCALE)
                                + slope(WALLS + 4 + wall, BODY_SCALE));
                    }
                }
            }
            shape.copy_from_slice(&by[SHAPE..MATERIAL]);
        });
        let by_shape = bodies.rest.backward(bodies.position, shape.as_flattened());
        for (by, more) in position.as_flattened_mut().iter_mut().zip(by_shape) {
            *by += more;
        }
        Gradients { position, velocity, expected }
    }
}

/// A block of a window's particles.
struct Block<'a> {
    features: &'a ParticleFeatures,
    bodies: &'a Trajectories<'a>,
    /// From 0 to T B.
    window: usize,
    block: usize,
    /// `[.., F]`.
    rows: &'a mut [f32],
}

impl WithSimd for Block<'_> {
    type Output = ();

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) {
        let Self { features, bodies, window, block, rows } = self;
        let Trajectories { position, velocity, expected, material, rest, .. } = *bodies;
        let (particles, count) = (bodies.particles(), features.count);
        let frame = window / bodies.windows * material.len();
        let window = window % bodies.windows;
        let first = (window * particles + block * BLOCK) as u32;
        let numbers: [u32; BLOCK] = std::array::from_fn(|place| first + place as u32);
        let numbers = &numbers[..rows.len() / count];
        let inputs = ParticleInputs {
            position: &position[frame..frame + material.len()],
            velocity: &velocity[frame..frame + material.len()],
            ballistic: features.ballistic,
            material,
            rest,
            stiffness: bodies.stiffness.map(|windows| windows[window]),
        };
        let mut states = [0.0; STATE_COLUMNS * BLOCK];
        let mut columns = vec![0.0; count * BLOCK];
        features.fill(
            simd,
            &inputs,
            numbers,
            #[inline(always)]
            |particle| expected[frame + particle],
            (&mut states, BLOCK),
            &mut columns,
        );
        for (place, row) in rows.chunks_exact_mut(count).enumerate() {
            for (feature, number) in row.iter_mut().enumerate() {
                *number = columns[feature * BLOCK + place];
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::checkpoint::{Architecture, Core, Description, Sizes};
    use eddy_frames::Material;

    /// Particles of a frame: a liquid, then jelly.
    const KINDS: [Material; 9] = [
        Material::Liquid,
        Material::Liquid,
        Material::Jelly,
        Material::Jelly,
        Material::Jelly,
        Material::Jelly,
        Material::Jelly,
        Material::Jelly,
        Material::Jelly,
    ];

    proptest! {
        #[test]
        fn gradients_are_differences(seed in 0u32..10_000) {
            const H: f32 = 1e-3;
            let sizes = Sizes { encoder: 2, hidden: 2, layers: 1, particles: None };
            let description = Description::untrained(Architecture::Particle, Core::Mlp, sizes);
            let features = ParticleFeatures::new(&description);
            let mut state = seed;
            let mut number = |low: f32, high: f32| {
                state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                low + (high - low) * (state >> 8) as f32 / (1 << 24) as f32
            };
            // Two windows side by side, whose jelly is a block of particles at a distance of 0.1.
            let material: Vec<Material> = [KINDS, KINDS].concat();
            let rest: Vec<[f32; 2]> = (0..material.len())
                .map(|p| [0.3 + 0.1 * (p % 9 % 3) as f32, 0.3 + 0.1 * (p % 9 / 3) as f32])
                .collect();
            let shape = RestShape::new(&rest, &material, 2, 0.1);
            let numbers: Vec<u8> = material.iter().map(|&kind| kind as u8).collect();
            let position: Vec<_> = rest.iter().map(|x| x.map(|x| x + number(-0.002, 0.002))).collect();
            let mut speeds = || rest.iter().map(|_| [(); 2].map(|()| number(-1.0, 1.0))).collect();
            let (velocity, expected): (Vec<[f32; 2]>, Vec<[f32; 2]>) = (speeds(), speeds());
            let bodies = |position: &[[f32; 2]], velocity: &[[f32; 2]], expected: &[[f32; 2]]| {
                let material = numbers.as_slice();
                features.forward(&Trajectories {
                    position, velocity, expected, material, rest: &shape, stiffness: None, windows: 2,
                })
            };
            let found = bodies(&position, &velocity, &expected);
            let weights: Vec<f32> = found.iter().map(|_| number(-1.0, 1.0)).collect();
            let sum = |found: &[f32]| -> f64 {
                found.iter().zip(&weights).map(|(x, by)| f64::from(x * by)).sum()
            };
            let by = features.backward(
                &Trajectories {
                    position: &position, velocity: &velocity, expected: &expected,
                    material: &numbers, rest: &shape, stiffness: None, windows: 2,
                },
                &found,
                &weights,
            );
            for particle in [0, 1, 2, 6, 10, 17] {
                for axis in 0..2 {
                    let slope = |part: usize| {
                        let at = |step: f32| {
                            let mut lists = [position.clone(), velocity.clone(), expected.clone()];
                            lists[part][particle][axis] += step;
                            sum(&bodies(&lists[0], &lists[1], &lists[2]))
                        };
                        (at(H) - at(-H)) / f64::from(2.0 * H)
                    };
                    let own = [&by.position, &by.velocity, &by.expected];
                    for (part, own) in own.into_iter().enumerate() {
                        let (found, expected) = (f64::from(own[particle][axis]), slope(part));
                        let most = 0.05 + 0.01 * expected.abs();
                        prop_assert!((found - expected).abs() < most, "{part}: {found}, {expected}");
                    }
                }
            }
        }
    }
}
