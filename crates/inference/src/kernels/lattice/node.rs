//! The motion of a lattice's node within a frame.

use super::Elasticity;

/// A node within a frame.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Node {
    /// Domain lengths.
    pub(super) position: [f32; 2],
    /// Domain lengths per second.
    pub(super) velocity: [f32; 2],
    /// In units of a particle's mass (domain lengths per second squared).
    pub(super) force: [f32; 2],
}

impl Node {
    /// Position and velocity of a particle.
    #[inline(always)]
    pub(super) fn of((position, velocity): (&[[f32; 2]], &[[f32; 2]]), row: usize) -> Self {
        Self { position: position[row], velocity: velocity[row], force: [0.0; 2] }
    }

    /// Adds a multiple of another node's position and velocity.
    #[inline(always)]
    pub(super) fn add(&mut self, factor: f32, other: &Self) {
        add_scaled(&mut self.position, factor, other.position);
        add_scaled(&mut self.velocity, factor, other.velocity);
    }

    /// Its position after a frame of free fall.
    pub(super) fn fallen(&self, Elasticity { dt, gravity, .. }: &Elasticity) -> [f32; 2] {
        [0, 1]
            .map(|axis| self.position[axis] + (self.velocity[axis] + 0.5 * gravity[axis] * dt) * dt)
    }

    #[inline(always)]
    pub(super) fn scale(&mut self, factor: f32) {
        self.position = self.position.map(|x| factor * x);
        self.velocity = self.velocity.map(|v| factor * v);
    }

    /// A step of symplectic Euler, after which no force acts.
    #[inline(always)]
    pub(super) fn advance(&mut self, step: f32, inverse_mass: f32, fall: [f32; 2]) {
        add_scaled(&mut self.velocity, step * inverse_mass, self.force);
        add_scaled(&mut self.velocity, 1.0, fall);
        add_scaled(&mut self.position, step, self.velocity);
        self.force = [0.0; 2];
    }
}

pub(super) fn squared_distance(one: [f32; 2], other: [f32; 2]) -> f32 {
    let [x, y] = [one[0] - other[0], one[1] - other[1]];
    x * x + y * y
}

/// Adds a multiple of a vector.
#[inline(always)]
pub(super) fn add_scaled(sum: &mut [f32; 2], factor: f32, other: [f32; 2]) {
    for (sum, other) in sum.iter_mut().zip(other) {
        *sum += factor * other;
    }
}
