//! The Moving Least Squares Material Point Method (MLS-MPM) in two dimensions.
//!
//! From a seed or a file to frames:
//!
//! 1. [`scene`]: initial conditions and settings: bodies ([`body`], [`shape`]), emitters and drains ([`flow`]), checked for
//!    overlaps ([`placement`]).
//! 2. [`generate`]: random scenes from a seed and an id, of a [`preset`] and an [`extent`] (number of particles);
//!    [`manipulation`]: those in which a tool moves.
//! 3. [`simulation`]: chooses stable substeps ([`stability`]), runs them and yields frames; an [`attractor`] acts before
//!    the first frame. A frame whose substeps were too long ([`bound`]) or whose matter is not sound ([`collapse`]) is run again with
//!    more of them, or ends the scene.
//!
//! One substep ([`solver`]):
//!
//! 1. Clear the [`grid`].
//! 2. [`p2g`]: update deformation and stress of each [`particle`] ([`constitutive`] and [`water`], with [`polar`] and
//!    [`matrix`], parameters from [`material`]); scatter mass and momentum to 3x3 nodes ([`spline`]).
//! 3. [`grid`]: convert momentum to velocity; apply gravity and walls.
//! 4. [`g2p`]: gather velocities and their gradients; advance positions.
//!
//! Tools ([`tool`]) separate particles from nodes behind them. [`fast`] does the same vectorised and on several threads; an [`accelerator`] does it for many solvers at once; [`energy`] computes the total energy, [`state`]
//! pressure and energy of every particle.
//!
//! Method: Hu et al., "A Moving Least Squares Material Point Method with Displacement Discontinuity
//! and Two-Way Rigid Body Coupling", ACM TOG 37(4), 2018; the constitutive law and its parameters as in Taichi's
//! `mpm99` and `mpm128`. Lengths are domain lengths (the side of the presets' unit square), density is 1.

mod accelerator;
mod attractor;
mod body;
mod bound;
mod collapse;
mod constitutive;
mod energy;
mod error;
mod extent;
mod fast;
mod flow;
mod g2p;
mod generate;
mod grid;
mod manipulation;
mod material;
mod matrix;
mod order;
mod p2g;
mod particle;
mod placement;
mod polar;
mod preset;
mod sand;
mod scene;
mod shape;
mod simulation;
mod solver;
mod spline;
mod stability;
mod state;
mod step;
mod tool;
mod water;

pub use accelerator::{Accelerator, CONSTANTS, Interval};
pub use attractor::Attractor;
pub use body::Body;
pub use energy::Energy;
pub use error::{Collapse, Limit, MpmError};
pub use extent::{Extent, ExtentOptions};
pub use flow::{Drain, Emitter};
pub use grid::GridShape;
pub use material::{Lame, Law, Materials, Moduli};
pub use matrix::Matrix2;
pub use order::ParticleOrder;
pub use particle::Particle;
pub use preset::Preset;
pub use scene::{Frames, Scene, SolverChoices};
pub use shape::Shape;
pub use simulation::{Advance, Settings, Simulation};
pub use solver::{Solver, SolverSettings, Stop};
pub use stability::minimum_substeps;
pub use state::ParticleState;
pub use step::Step;
pub use tool::{Contact, Keyframe, MAX_TOOLS, Motion, Outline, Pose, Tool, ToolLoad};
pub use water::Settling;

/// Time between two frames (s).
pub const FRAME_INTERVAL: f32 = 0.016;

/// Acceleration along y, negative is down (domain lengths per s^2).
pub const GRAVITY: f32 = -9.8;

/// Compiles and runs the example of the README.
#[cfg(doctest)]
#[doc = include_str!("../README.md")]
struct Readme;
