//! The MPM solver on a device: the substeps of many scenes side by side ([`eddy_mpm::Accelerator`]).
//!
//! 1. `layout`: the constants of its kernels, the table of scenes, and where each one's particles, tiles and nodes are.
//! 2. `particles`: the particles in the memory of the host, between the solvers' lists and the device.
//! 3. `solvers`: loads them, and runs substeps.

mod layout;
mod particles;
mod solvers;

pub use layout::Constants;
pub use solvers::Solvers;
