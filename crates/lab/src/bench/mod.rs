//! Benchmarks of this machine.
//!
//! 1. [`solver`]: time per substep, by particles and threads.
//! 2. [`training`]: time per training step, by core and window length.
//! 3. [`inference`]: time per predicted frame by core, in the engine and in burn.
//! 4. [`bag`]: write and read rates of bags, message loss of a live recording.
//! 5. [`transport`]: latency from publisher to subscriber.
//! 6. [`node`]: overhead of a node over its model, and number of streams.
//! 7. [`group`]: nodes that share streams.
//! 8. [`replay`]: delay of replayed messages.
//! 9. [`view`]: overhead of the live page.
//! 10. [`limit`]: peak rates of processor and memory.

pub mod bag;
pub mod group;
pub mod inference;
pub mod limit;
pub mod node;
mod particles;
pub mod replay;
pub mod solver;
mod spread;
pub mod training;
pub mod transport;
pub mod view;

pub use spread::{Spread, Tail};
