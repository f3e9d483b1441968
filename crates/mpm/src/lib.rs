//! Ground truth: the Moving Least Squares Material Point Method in two dimensions.
//!
//! From a seed, or a file, to frames:
//!
//! 1. [`scene`]: everything that a simulation starts from: bodies ([`body`], [`shape`]), what comes
//!    in and goes out ([`flow`]), checked so that nothing overlaps ([`placement`]).
//! 2. [`generate`]: random scenes from a seed and an id, of the kinds in [`preset`] and as wide as
//!    their particles are many ([`extent`]).
//! 3. [`simulation`]: a scene made stable ([`stability`]), substeps run, frames handed out;
//!    [`attractor`] pulls before the first of them.
//!
//! One substep ([`solver`]), in the order of the method:
//!
//! 1. [`grid`] is cleared.
//! 2. [`p2g`]: each [`particle`] deforms and is stressed ([`constitutive`] and [`water`], with
//!    [`polar`] and [`matrix`], numbers from [`material`]); its mass and momentum go to 3x3 nodes ([`spline`]).
//! 3. [`grid`]: momentum becomes velocity; gravity and walls act.
//! 4. [`g2p`]: velocity and its gradient return to the particles, which move.
//!
//! [`energy`] adds up what there is.
//!
//! Method: Hu et al., "A Moving Least Squares Material Point Method with Displacement Discontinuity
//! and Two-Way Rigid Body Coupling", ACM TOG 37(4), 2018; the law and its numbers as in Taichi's
//! `mpm99` and `mpm128`. Lengths are domain lengths (the side of the presets' unit square), density is 1.

mod attractor;
mod body;
mod constitutive;
mod energy;
mod error;
mod extent;
mod fast;
mod flow;
mod g2p;
mod generate;
mod grid;
mod material;
mod matrix;
mod p2g;
mod particle;
mod placement;
mod polar;
mod preset;
mod scene;
mod shape;
mod simulation;
mod solver;
mod spline;
mod stability;
mod water;

pub use attractor::Attractor;
pub use body::Body;
pub use energy::Energy;
pub use error::{Limit, MpmError};
pub use extent::Extent;
pub use fast::multiply_and_add;
pub use flow::{Drain, Emitter};
pub use grid::GridShape;
pub use material::{Law, Materials};
pub use matrix::Matrix2;
pub use particle::Particle;
pub use preset::Preset;
pub use scene::{Frames, Scene, SolverChoices};
pub use shape::Shape;
pub use simulation::{Settings, Simulation};
pub use solver::{Solver, SolverSettings};
pub use stability::minimum_substeps;

/// Time between two frames (s).
pub const FRAME_INTERVAL: f32 = 0.016;

/// Acceleration in -y (domain lengths per s^2).
pub const GRAVITY: f32 = 9.8;

/// The example of the README, which a test runs.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
